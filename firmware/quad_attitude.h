/* From sensor samples to rates, specific force and attitude: axes, calibration, low-pass filters, complementary
 * filter. Body FRD, earth NED, SI. No frames and no control here.
 *
 *     chip -> axes -> board (x forward, y right, z down of the board) -> offsets, scale -> turn -> body */
#ifndef QUAD_ATTITUDE_H
#define QUAD_ATTITUDE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "quad_filter.h"

#define QUAD_BLIND_S 0.1f /* without a sample of the gyro: the motors stop, the attitude begins anew */
#define QUAD_MOST_SAMPLES 20 /* samples of gyro and accelerometer in one control cycle */

/* What changes slowly; NaN where it is not measured. */
typedef struct {
    float battery_v; /* pack voltage; a board gives that at its pin, behind BAT_DIVIDER */
    float mag_gauss[3]; /* chip axes */
    float pressure_hpa;
    float temperature_c;
} quad_slow;

/* What the chips have measured since the last cycle, oldest first, in the axes of the chips. A
 * sample that is not finite, or larger than any chip's range, is left out. */
typedef struct {
    size_t samples;
    float gyro[QUAD_MOST_SAMPLES][3];  /* rad/s */
    float accel[QUAD_MOST_SAMPLES][3]; /* m/s^2, specific force */
    quad_slow slow;
} quad_sensors;

typedef struct {
    int8_t axes[3];         /* the board's x, y, z as +-1, +-2, +-3: that axis of the chip, with its sign */
    float gyro_bias[3];     /* rad/s, axes of the board, as measured at rest */
    float sample_s;         /* between two samples */
    float complementary_s;  /* time after which gravity and north outweigh the gyro */
    float declination;      /* rad, magnetic north east of true north */
} quad_mounting;

typedef struct {
    quad_low_pass gyro, accel;
    quad_notch notches[2]; /* notches on the gyro */
    float turned[3];       /* BOARD_ROLL, BOARD_PITCH, BOARD_YAW of `turn` */
    float turn[3][3];      /* from the board's axes to the body's */
    float mag[3];          /* gauss, body axes, less its offset; NaN where not measured */
    float angle[3]; /* roll, pitch, yaw */
    bool settled, started; /* a first sample has come; the attitude has begun */
    uint32_t silent;       /* cycles since a good sample */
} quad_attitude;

void quad_attitude_init(quad_attitude *attitude);

/* Take a cycle's samples; `gains` as in quad_parameters.h, for the filters. Writes rates, specific
 * force and attitude, (3) each. The first sample of all, and after QUAD_BLIND_S without one, is taken as one at
 * rest. */
void quad_attitude_cycle(quad_attitude *attitude, const quad_mounting *mounting,
                         const quad_sensors *sensors, const float *gains, float period_s,
                         float gyro[3], float accel[3], float angle[3]);

/* A vector (3) of the chips' axes in those of the board. */
void quad_to_board(const int8_t axes[3], const float chip[3], float board[3]);

/* `angle` in rad, brought into -pi..pi; it must not lie beyond some thousand turns. */
float quad_wrapped(float angle);

#endif
