/* Generated from quad_bridge/gains/table.py by tools/gain_tables.py. SI units. */
#ifndef QUAD_PARAMETER_TABLE_H
#define QUAD_PARAMETER_TABLE_H

/* Of each axis, roll pitch yaw. */
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

/* In a set: first group of each axis, shared, rest of each axis, mixer and notches. */
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
    {"D_NOTCH_BW", 1.0f, 100.0f, 20.0f}

#endif
