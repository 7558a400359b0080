/* See quad_attitude.h. */
#include "quad_attitude.h"

#include <math.h>
#include <string.h>

#include "quad_parameters.h"

#define TURN_F 6.28318531f
/* What no chip of the kind reports: such a sample is noise on its line. */
#define LARGEST_GYRO 70.0f   /* rad/s */
#define LARGEST_ACCEL 400.0f /* m/s^2 */
#define LARGEST_MAG 20.0f    /* gauss */
#define STEEP 0.5f /* cosine of a pitch of 60 deg */

float quad_wrapped(float angle)
{
    return angle - TURN_F * floorf(angle / TURN_F + 0.5f);
}

void quad_attitude_init(quad_attitude *attitude)
{
    memset(attitude, 0, sizeof *attitude);
    attitude->turn[0][0] = attitude->turn[1][1] = attitude->turn[2][2] = 1.0f;
}

void quad_to_board(const int8_t axes[3], const float chip[3], float board[3])
{
    for (size_t i = 0; i < 3; i++) {
        const int axis = axes[i];
        board[i] = axis > 0 ? chip[(axis - 1) % 3] : -chip[(-axis - 1) % 3];
    }
}

/* Whether each lies within +-limit; false for NaN as well. */
static bool within(const float v[3], float limit)
{
    return fabsf(v[0]) <= limit && fabsf(v[1]) <= limit && fabsf(v[2]) <= limit;
}

/* Roll, pitch as gravity shows them in the specific force. */
static void level(const float force[3], float *roll, float *pitch)
{
    *roll = atan2f(-force[1], -force[2]);
    *pitch = atan2f(force[0], sqrtf(force[1] * force[1] + force[2] * force[2]));
}

/* Yaw as the compass shows it on an aircraft with this roll and pitch. */
static float heading(const float mag[3], float roll, float pitch, float declination)
{
    const float sr = sinf(roll), cr = cosf(roll);
    const float x = mag[0] * cosf(pitch) + (mag[1] * sr + mag[2] * cr) * sinf(pitch);
    const float y = mag[1] * cr - mag[2] * sr;
    return declination - atan2f(y, x);
}

/* Forward, right and down of what is turned by roll, pitch, yaw: the columns, in the axes it is turned in. */
static void matrix_of(const float angle[3], float matrix[3][3])
{
    const float sr = sinf(angle[0]), cr = cosf(angle[0]), sp = sinf(angle[1]), cp = cosf(angle[1]);
    const float sy = sinf(angle[2]), cy = cosf(angle[2]);
    const float turned[3][3] = {{cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr},
                                {sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr},
                                {-sp, cp * sr, cp * cr}};
    memcpy(matrix, turned, sizeof turned);
}

/* Turn by the axes, where the angles' own rates have a pole: beyond it a nose that goes on up is one that comes down on
 * the other side. */
static void turn_steep(float angle[3], const float rate[3], float period_s)
{
    float m[3][3];
    matrix_of(angle, m);
    for (size_t i = 0; i < 3; i++) {
        const float x = m[i][0], y = m[i][1], z = m[i][2];
        m[i][0] += period_s * (y * rate[2] - z * rate[1]);
        m[i][1] += period_s * (z * rate[0] - x * rate[2]);
        m[i][2] += period_s * (x * rate[1] - y * rate[0]);
    }
    angle[0] = atan2f(m[2][1], m[2][2]);
    angle[1] = atan2f(-m[2][0], sqrtf(m[2][1] * m[2][1] + m[2][2] * m[2][2]));
    angle[2] = atan2f(m[1][0], m[0][0]);
}

static void turn(float angle[3], const float rate[3], float period_s)
{
    const float sr = sinf(angle[0]), cr = cosf(angle[0]), cp = cosf(angle[1]);
    if (cp < STEEP) {
        turn_steep(angle, rate, period_s);
        return;
    }
    const float yaw_rate = (rate[1] * sr + rate[2] * cr) / cp;
    angle[0] += period_s * (rate[0] + sinf(angle[1]) * yaw_rate);
    angle[1] += period_s * (rate[1] * cr - rate[2] * sr);
    angle[2] += period_s * yaw_rate;
}

/* The complementary filter: the gyro integrated, held by gravity and north. */
static void hold(quad_attitude *a, const quad_mounting *m, const float mag[3], float share)
{
    float roll, pitch;
    level(a->accel.out, &roll, &pitch);
    a->angle[0] += share * quad_wrapped(roll - a->angle[0]);
    a->angle[1] += share * (pitch - a->angle[1]);
    if (within(mag, LARGEST_MAG)) {
        const float yaw = heading(mag, a->angle[0], a->angle[1], m->declination);
        a->angle[2] += share * quad_wrapped(yaw - a->angle[2]);
    }
    a->angle[0] = quad_wrapped(a->angle[0]);
    a->angle[2] = quad_wrapped(a->angle[2]);
}

/* The board in the body: yaw, then pitch, then roll. */
static void tune_turn(quad_attitude *a, const float *gains)
{
    const float *angle = &gains[QUAD_BOARD_ROLL];
    if (memcmp(a->turned, angle, sizeof a->turned) == 0) {
        return;
    }
    memcpy(a->turned, angle, sizeof a->turned);
    matrix_of(angle, a->turn);
}

static void to_body(const quad_attitude *a, const float board[3], float body[3])
{
    for (size_t i = 0; i < 3; i++) {
        body[i] = a->turn[i][0] * board[0] + a->turn[i][1] * board[1] + a->turn[i][2] * board[2];
    }
}

static void take(quad_attitude *a, const quad_mounting *m, const float *gains, const float chip_gyro[3],
                 const float chip_accel[3])
{
    float gyro[3], accel[3], turning[3], force[3];
    if (!within(chip_gyro, LARGEST_GYRO) || !within(chip_accel, LARGEST_ACCEL)) {
        return;
    }
    a->silent = 0;
    quad_to_board(m->axes, chip_gyro, turning);
    quad_to_board(m->axes, chip_accel, force);
    for (size_t i = 0; i < 3; i++) {
        turning[i] -= m->gyro_bias[i];
        force[i] = (force[i] - gains[QUAD_ACCEL_OFFSET_X + i]) * gains[QUAD_ACCEL_SCALE_X + i];
    }
    to_body(a, turning, gyro);
    to_body(a, force, accel);
    if (!a->settled) {
        quad_notch_settle(&a->notches[0], gyro);
        quad_notch_settle(&a->notches[1], gyro);
        quad_low_pass_settle(&a->gyro, gyro);
        quad_low_pass_settle(&a->accel, accel);
        a->settled = true;
        return;
    }
    quad_notch_pass(&a->notches[0], gyro);
    quad_notch_pass(&a->notches[1], gyro);
    quad_low_pass_pass(&a->gyro, gyro);
    quad_low_pass_pass(&a->accel, accel);
}

void quad_attitude_cycle(quad_attitude *a, const quad_mounting *m, const quad_sensors *s,
                         const float *gains, float period_s, float gyro[3], float accel[3],
                         float angle[3])
{
    float mag[3];
    tune_turn(a, gains);
    quad_low_pass_tune(&a->gyro, gains[QUAD_SENSOR_GYRO_FILTER_HZ], m->sample_s);
    quad_low_pass_tune(&a->accel, gains[QUAD_SENSOR_ACCEL_FILTER_HZ], m->sample_s);
    quad_notch_tune(&a->notches[0], gains[QUAD_SENSOR_NOTCH_1_HZ],
                    gains[QUAD_SENSOR_NOTCH_1_BANDWIDTH_HZ], m->sample_s);
    quad_notch_tune(&a->notches[1], gains[QUAD_SENSOR_NOTCH_2_HZ],
                    gains[QUAD_SENSOR_NOTCH_2_BANDWIDTH_HZ], m->sample_s);
    a->silent++;
    for (size_t i = 0; i < s->samples && i < QUAD_MOST_SAMPLES; i++) {
        take(a, m, gains, s->gyro[i], s->accel[i]);
    }
    if ((float)a->silent * period_s > QUAD_BLIND_S) { /* the last rate says nothing any more */
        a->settled = a->started = false;
    }
    quad_to_board(m->axes, s->slow.mag_gauss, mag);
    for (size_t i = 0; i < 3; i++) {
        mag[i] -= gains[QUAD_COMPASS_OFFSET_X + i];
    }
    to_body(a, mag, a->mag);
    if (a->settled && !a->started) {
        level(a->accel.out, &a->angle[0], &a->angle[1]);
        a->angle[2] = within(a->mag, LARGEST_MAG) ? heading(a->mag, a->angle[0], a->angle[1], m->declination) : 0.0f;
        a->angle[2] = quad_wrapped(a->angle[2]);
        a->started = true;
    } else if (a->started) {
        turn(a->angle, a->gyro.out, period_s);
        hold(a, m, a->mag, period_s / m->complementary_s);
    }
    memcpy(gyro, a->gyro.out, sizeof a->gyro.out);
    memcpy(accel, a->accel.out, sizeof a->accel.out);
    memcpy(angle, a->angle, sizeof a->angle);
}
