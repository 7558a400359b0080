/* Generated from quad_bridge/gains/table.py by tools/gain_tables.py. SI units. */
#ifndef QUAD_PARAMETER_TABLE_H
#define QUAD_PARAMETER_TABLE_H

/* Gains of each axis, roll pitch yaw. */
enum {
    QUAD_ANGLE_KP, /* rate reference per angle error, 1/s */
    QUAD_ANGLE_RATE_LIMIT, /* largest rate reference, rad/s */
    QUAD_RATE_KP, /* command per rate error, s/rad */
    QUAD_RATE_KI, /* command per integral of the rate error, 1/rad */
    QUAD_RATE_KD, /* command per change of the measured rate, s^2/rad */
    QUAD_RATE_D_FILTER_HZ, /* first-order filter before rate.kd, Hz */
    QUAD_RATE_INTEGRATOR_LIMIT, /* largest command of the integral */
    QUAD_RATE_OUTPUT_LIMIT, /* largest command of the axis */
    QUAD_PER_AXIS,
    QUAD_LQR_SHARE = QUAD_PER_AXIS, /* state feedback 1, cascade 0 */
    QUAD_LQR_K_ANGLE, /* command per angle error, 1/rad */
    QUAD_LQR_K_RATE, /* command per rate, s/rad */
    QUAD_LQR_K_DRIVE, /* command per angular acceleration, s^2/rad */
    QUAD_LQR_K_INTEGRAL, /* command per integral of the angle error, 1/(rad s) */
    QUAD_LQR_GAIN, /* model's angular acceleration per command, rad/s^2 */
    QUAD_LQR_LAG_S, /* model's lag of the motors, s */
    QUAD_LQR_DELAY_S, /* model's delay, s */
    QUAD_LQR_DAMPING, /* model's damping of the rate, 1/s */
    QUAD_LQR_OBSERVER, /* share of a rate's innovation that is believed */
    QUAD_SAG_EXPONENT, /* commands times (reference / voltage) to this power */
    QUAD_SAG_REFERENCE_V, /* voltage at which commands stay as they are, V */
    QUAD_OF_AXIS
};

/* In a set: first group of each axis, shared, rest of each axis, mixer and notches,
 * height, set-up. */
enum {
    QUAD_SENSOR_GYRO_FILTER_HZ = 3 * QUAD_PER_AXIS, /* cut-off of the gyro (2nd order), Hz */
    QUAD_SENSOR_ACCEL_FILTER_HZ, /* cut-off of the accelerometer, Hz */
    QUAD_LOOP_RATE_HZ, /* control cycles per second, Hz, read only */
    QUAD_OPTIONAL,
    QUAD_BEFORE_MIXER = QUAD_OPTIONAL + 3 * (QUAD_OF_AXIS - QUAD_PER_AXIS) - 1,
    QUAD_MIXER_IDLE, /* smallest command of a motor in flight */
    QUAD_MIXER_AIRMODE, /* stabilised at zero throttle in the air from 0.5 on */
    QUAD_SENSOR_NOTCH_1_HZ, /* first notch on the gyro, off at 0, Hz */
    QUAD_SENSOR_NOTCH_1_BANDWIDTH_HZ, /* its width at -3 dB, Hz */
    QUAD_SENSOR_NOTCH_2_HZ, /* second notch on the gyro, off at 0, Hz */
    QUAD_SENSOR_NOTCH_2_BANDWIDTH_HZ, /* its width at -3 dB, Hz */
    QUAD_RATE_D_NOTCH_HZ, /* notch before rate.kd of all axes, off at 0, Hz */
    QUAD_RATE_D_NOTCH_BANDWIDTH_HZ, /* its width at -3 dB, Hz */
    QUAD_CLIMB_HEIGHT_KP, /* climb reference per height error, 1/s */
    QUAD_CLIMB_HEIGHT_RATE_LIMIT, /* largest climb reference, m/s */
    QUAD_CLIMB_HEIGHT_CEILING, /* largest height above the take-off, m */
    QUAD_CLIMB_RATE_KP, /* command per error of the climb, s/m */
    QUAD_CLIMB_RATE_KI, /* command per integral of that error, 1/m */
    QUAD_CLIMB_RATE_KD, /* command per measured vertical acceleration, s^2/m */
    QUAD_CLIMB_RATE_INTEGRATOR_LIMIT, /* largest command of the integral */
    QUAD_CLIMB_RATE_OUTPUT_LIMIT, /* largest command beside the trim */
    QUAD_CLIMB_HOVER, /* throttle that carries the aircraft, at take-off */
    QUAD_CLIMB_FILTER_S, /* time constant of the barometer's correction, s */
    QUAD_SET_UP, /* from here on: how the aircraft is built */
    QUAD_RECEIVER_ROLL_CHANNEL = QUAD_SET_UP, /* the receiver's channel for it */
    QUAD_RECEIVER_PITCH_CHANNEL, /* the receiver's channel for it */
    QUAD_RECEIVER_THROTTLE_CHANNEL, /* the receiver's channel for it */
    QUAD_RECEIVER_YAW_CHANNEL, /* the receiver's channel for it */
    QUAD_RECEIVER_KILL_CHANNEL, /* the receiver's channel for it */
    QUAD_RECEIVER_ARM_CHANNEL, /* the receiver's channel for it, 0: none */
    QUAD_RECEIVER_HOLD_CHANNEL, /* the receiver's channel for it, 0: none */
    QUAD_RECEIVER_ROLL_MIN_US, /* its pulse at minimum, us */
    QUAD_RECEIVER_ROLL_CENTRE_US, /* its pulse in the middle, us */
    QUAD_RECEIVER_ROLL_MAX_US, /* its pulse at maximum, us */
    QUAD_RECEIVER_PITCH_MIN_US, /* its pulse at minimum, us */
    QUAD_RECEIVER_PITCH_CENTRE_US, /* its pulse in the middle, us */
    QUAD_RECEIVER_PITCH_MAX_US, /* its pulse at maximum, us */
    QUAD_RECEIVER_THROTTLE_MIN_US, /* its pulse at minimum, us */
    QUAD_RECEIVER_THROTTLE_MAX_US, /* its pulse at maximum, us */
    QUAD_RECEIVER_YAW_MIN_US, /* its pulse at minimum, us */
    QUAD_RECEIVER_YAW_CENTRE_US, /* its pulse in the middle, us */
    QUAD_RECEIVER_YAW_MAX_US, /* its pulse at maximum, us */
    QUAD_RECEIVER_DEADBAND_US, /* around the middle, without effect, us */
    QUAD_MOTORS_OUTPUT_1, /* the output that drives this motor */
    QUAD_MOTORS_OUTPUT_2, /* the output that drives this motor */
    QUAD_MOTORS_OUTPUT_3, /* the output that drives this motor */
    QUAD_MOTORS_OUTPUT_4, /* the output that drives this motor */
    QUAD_MOTORS_PULSE_MIN_US, /* pulse of a motor that stands, us */
    QUAD_MOTORS_PULSE_MAX_US, /* pulse of full throttle, us */
    QUAD_BOARD_ROLL, /* how the board is turned in the body, yaw first, rad */
    QUAD_BOARD_PITCH, /* how the board is turned in the body, yaw first, rad */
    QUAD_BOARD_YAW, /* how the board is turned in the body, yaw first, rad */
    QUAD_ACCEL_OFFSET_X, /* reading at zero acceleration, axis of the board, m/s^2 */
    QUAD_ACCEL_OFFSET_Y, /* reading at zero acceleration, axis of the board, m/s^2 */
    QUAD_ACCEL_OFFSET_Z, /* reading at zero acceleration, axis of the board, m/s^2 */
    QUAD_ACCEL_SCALE_X, /* factor after the offset */
    QUAD_ACCEL_SCALE_Y, /* factor after the offset */
    QUAD_ACCEL_SCALE_Z, /* factor after the offset */
    QUAD_COMPASS_OFFSET_X, /* reading in zero field, axis of the board, gauss */
    QUAD_COMPASS_OFFSET_Y, /* reading in zero field, axis of the board, gauss */
    QUAD_COMPASS_OFFSET_Z, /* reading in zero field, axis of the board, gauss */
    QUAD_BATTERY_DIVIDER, /* pack voltage over that at the pin */
    QUAD_PARAMETERS
};

/* Name, lowest, highest, start; nothing fits where lowest > highest. */
#define QUAD_PARAMETER_TABLE \
    {"ROLL_ANG_KP", 0.0f, 20.0f, 3.0f}, \
    {"ROLL_ANG_RLIM", 0.1f, 20.0f, 4.0f}, \
    {"ROLL_RATE_KP", 0.0f, 1.0f, 0.07448451f}, \
    {"ROLL_RATE_KI", 0.0f, 1.0f, 0.0005729578f}, \
    {"ROLL_RATE_KD", 0.0f, 0.05f, 0.0013178029f}, \
    {"ROLL_RATE_DFHZ", 1.0f, 120.0f, 30.0f}, \
    {"ROLL_RATE_ILIM", 0.0f, 1.0f, 0.1f}, \
    {"ROLL_RATE_ULIM", 0.01f, 1.0f, 0.3f}, \
    {"PITCH_ANG_KP", 0.0f, 20.0f, 3.0f}, \
    {"PITCH_ANG_RLIM", 0.1f, 20.0f, 4.0f}, \
    {"PITCH_RATE_KP", 0.0f, 1.0f, 0.07448451f}, \
    {"PITCH_RATE_KI", 0.0f, 1.0f, 0.0005729578f}, \
    {"PITCH_RATE_KD", 0.0f, 0.05f, 0.0013178029f}, \
    {"PITCH_RATE_DFHZ", 1.0f, 120.0f, 30.0f}, \
    {"PITCH_RATE_ILIM", 0.0f, 1.0f, 0.1f}, \
    {"PITCH_RATE_ULIM", 0.01f, 1.0f, 0.3f}, \
    {"YAW_ANG_KP", 0.0f, 20.0f, 2.0f}, \
    {"YAW_ANG_RLIM", 0.1f, 20.0f, 4.0f}, \
    {"YAW_RATE_KP", 0.0f, 1.0f, 0.17188734f}, \
    {"YAW_RATE_KI", 0.0f, 1.0f, 0.0011459156f}, \
    {"YAW_RATE_KD", 0.0f, 0.05f, 0.0f}, \
    {"YAW_RATE_DFHZ", 1.0f, 120.0f, 30.0f}, \
    {"YAW_RATE_ILIM", 0.0f, 1.0f, 0.1f}, \
    {"YAW_RATE_ULIM", 0.01f, 1.0f, 0.3f}, \
    {"GYRO_FILT_HZ", 5.0f, 200.0f, 42.0f}, \
    {"ACC_FILT_HZ", 5.0f, 200.0f, 42.0f}, \
    {"LOOP_RATE_HZ", 1.0f, 0.0f, 250.0f}, \
    {"ROLL_LQR_SHARE", 0.0f, 1.0f, 0.0f}, \
    {"ROLL_LQR_KANG", 0.0f, 5.0f, 0.0f}, \
    {"ROLL_LQR_KRATE", 0.0f, 1.0f, 0.0f}, \
    {"ROLL_LQR_KDRIVE", 0.0f, 0.1f, 0.0f}, \
    {"ROLL_LQR_KINT", 0.0f, 10.0f, 0.0f}, \
    {"ROLL_LQR_GAIN", 0.0f, 5000.0f, 0.0f}, \
    {"ROLL_LQR_LAG", 0.0f, 0.5f, 0.0f}, \
    {"ROLL_LQR_DELAY", 0.0f, 0.06f, 0.0f}, \
    {"ROLL_LQR_DAMP", -20.0f, 50.0f, 0.0f}, \
    {"ROLL_LQR_OBS", 0.0f, 1.0f, 0.0f}, \
    {"ROLL_SAG_EXP", 0.0f, 3.0f, 0.0f}, \
    {"ROLL_SAG_VREF", 0.0f, 100.0f, 0.0f}, \
    {"PITCH_LQR_SHARE", 0.0f, 1.0f, 0.0f}, \
    {"PITCH_LQR_KANG", 0.0f, 5.0f, 0.0f}, \
    {"PITCH_LQR_KRATE", 0.0f, 1.0f, 0.0f}, \
    {"PITCH_LQR_KDRIVE", 0.0f, 0.1f, 0.0f}, \
    {"PITCH_LQR_KINT", 0.0f, 10.0f, 0.0f}, \
    {"PITCH_LQR_GAIN", 0.0f, 5000.0f, 0.0f}, \
    {"PITCH_LQR_LAG", 0.0f, 0.5f, 0.0f}, \
    {"PITCH_LQR_DELAY", 0.0f, 0.06f, 0.0f}, \
    {"PITCH_LQR_DAMP", -20.0f, 50.0f, 0.0f}, \
    {"PITCH_LQR_OBS", 0.0f, 1.0f, 0.0f}, \
    {"PITCH_SAG_EXP", 0.0f, 3.0f, 0.0f}, \
    {"PITCH_SAG_VREF", 0.0f, 100.0f, 0.0f}, \
    {"YAW_LQR_SHARE", 0.0f, 1.0f, 0.0f}, \
    {"YAW_LQR_KANG", 0.0f, 5.0f, 0.0f}, \
    {"YAW_LQR_KRATE", 0.0f, 1.0f, 0.0f}, \
    {"YAW_LQR_KDRIVE", 0.0f, 0.1f, 0.0f}, \
    {"YAW_LQR_KINT", 0.0f, 10.0f, 0.0f}, \
    {"YAW_LQR_GAIN", 0.0f, 5000.0f, 0.0f}, \
    {"YAW_LQR_LAG", 0.0f, 0.5f, 0.0f}, \
    {"YAW_LQR_DELAY", 0.0f, 0.06f, 0.0f}, \
    {"YAW_LQR_DAMP", -20.0f, 50.0f, 0.0f}, \
    {"YAW_LQR_OBS", 0.0f, 1.0f, 0.0f}, \
    {"YAW_SAG_EXP", 0.0f, 3.0f, 0.0f}, \
    {"YAW_SAG_VREF", 0.0f, 100.0f, 0.0f}, \
    {"MIX_IDLE", 0.0f, 0.3f, 0.05f}, \
    {"MIX_AIRMODE", 0.0f, 1.0f, 0.0f}, \
    {"NOTCH_1_HZ", 0.0f, 400.0f, 0.0f}, \
    {"NOTCH_1_BW", 1.0f, 200.0f, 20.0f}, \
    {"NOTCH_2_HZ", 0.0f, 400.0f, 0.0f}, \
    {"NOTCH_2_BW", 1.0f, 200.0f, 20.0f}, \
    {"D_NOTCH_HZ", 0.0f, 110.0f, 0.0f}, \
    {"D_NOTCH_BW", 1.0f, 100.0f, 20.0f}, \
    {"CLIMB_HGT_KP", 0.0f, 5.0f, 1.0f}, \
    {"CLIMB_HGT_VLIM", 0.1f, 5.0f, 1.0f}, \
    {"CLIMB_HGT_CEIL", 1.0f, 500.0f, 30.0f}, \
    {"CLIMB_RATE_KP", 0.0f, 1.0f, 0.1f}, \
    {"CLIMB_RATE_KI", 0.0f, 1.0f, 0.05f}, \
    {"CLIMB_RATE_KD", 0.0f, 0.2f, 0.01f}, \
    {"CLIMB_RATE_ILIM", 0.0f, 0.5f, 0.2f}, \
    {"CLIMB_RATE_ULIM", 0.01f, 0.6f, 0.3f}, \
    {"CLIMB_HOVER", 0.1f, 0.8f, 0.35f}, \
    {"CLIMB_FILTER_S", 0.3f, 10.0f, 2.0f}, \
    {"RC_ROLL_CH", 1.0f, 9.0f, 1.0f}, \
    {"RC_PITCH_CH", 1.0f, 9.0f, 2.0f}, \
    {"RC_THROT_CH", 1.0f, 9.0f, 3.0f}, \
    {"RC_YAW_CH", 1.0f, 9.0f, 4.0f}, \
    {"RC_KILL_CH", 1.0f, 9.0f, 5.0f}, \
    {"RC_ARM_CH", 0.0f, 9.0f, 6.0f}, \
    {"RC_HOLD_CH", 0.0f, 9.0f, 0.0f}, \
    {"RC_ROLL_MIN", 800.0f, 2200.0f, 1000.0f}, \
    {"RC_ROLL_CEN", 800.0f, 2200.0f, 1500.0f}, \
    {"RC_ROLL_MAX", 800.0f, 2200.0f, 2000.0f}, \
    {"RC_PITCH_MIN", 800.0f, 2200.0f, 1000.0f}, \
    {"RC_PITCH_CEN", 800.0f, 2200.0f, 1500.0f}, \
    {"RC_PITCH_MAX", 800.0f, 2200.0f, 2000.0f}, \
    {"RC_THROT_MIN", 800.0f, 2200.0f, 1000.0f}, \
    {"RC_THROT_MAX", 800.0f, 2200.0f, 2000.0f}, \
    {"RC_YAW_MIN", 800.0f, 2200.0f, 1000.0f}, \
    {"RC_YAW_CEN", 800.0f, 2200.0f, 1500.0f}, \
    {"RC_YAW_MAX", 800.0f, 2200.0f, 2000.0f}, \
    {"RC_DEADBAND", 0.0f, 100.0f, 0.0f}, \
    {"MOT_OUTPUT_1", 1.0f, 4.0f, 1.0f}, \
    {"MOT_OUTPUT_2", 1.0f, 4.0f, 2.0f}, \
    {"MOT_OUTPUT_3", 1.0f, 4.0f, 3.0f}, \
    {"MOT_OUTPUT_4", 1.0f, 4.0f, 4.0f}, \
    {"MOT_PULSE_MIN", 800.0f, 2200.0f, 1000.0f}, \
    {"MOT_PULSE_MAX", 800.0f, 2200.0f, 2000.0f}, \
    {"BOARD_ROLL", -3.1416f, 3.1416f, 0.0f}, \
    {"BOARD_PITCH", -3.1416f, 3.1416f, 0.0f}, \
    {"BOARD_YAW", -3.1416f, 3.1416f, 0.0f}, \
    {"ACC_OFF_X", -5.0f, 5.0f, 0.0f}, \
    {"ACC_OFF_Y", -5.0f, 5.0f, 0.0f}, \
    {"ACC_OFF_Z", -5.0f, 5.0f, 0.0f}, \
    {"ACC_SCALE_X", 0.8f, 1.2f, 1.0f}, \
    {"ACC_SCALE_Y", 0.8f, 1.2f, 1.0f}, \
    {"ACC_SCALE_Z", 0.8f, 1.2f, 1.0f}, \
    {"MAG_OFF_X", -5.0f, 5.0f, 0.0f}, \
    {"MAG_OFF_Y", -5.0f, 5.0f, 0.0f}, \
    {"MAG_OFF_Z", -5.0f, 5.0f, 0.0f}, \
    {"BAT_DIVIDER", 1.0f, 40.0f, 11.0f}

#endif
