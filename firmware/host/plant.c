/* See plant.h. Body FRD, radians; U3, U4 and the mixer's signs as on the wire. */
#include "plant.h"

#include <math.h>
#include <string.h>

static const float authority[3] = {120.0f, 110.0f, 40.0f}; /* rad/s^2 per unit of command */
static const float damping[3] = {0.6f, 0.6f, 0.4f};        /* 1/s */
#define MOTOR_LAG_S 0.03f
#define GYRO_NOISE 0.004f /* rad/s, largest */
#define ANGLE_LIMIT 0.5236f
#define TWO_PI 6.2831853f

/* Rows: motors 1 rear left, 2 rear right, 3 front right, 4 front left; columns U1..U4, FRD. */
static const float mixer[4][4] = {
    {1, 1, -1, -1},
    {1, -1, -1, 1},
    {1, -1, 1, -1},
    {1, 1, 1, 1},
};

void plant_init(plant *p)
{
    memset(p, 0, sizeof *p);
    p->noise = 1;
}

static float clip(float value, float limit)
{
    return fmaxf(-limit, fminf(limit, value));
}

static float noise_of(plant *p)
{
    p->noise ^= p->noise << 13;
    p->noise ^= p->noise >> 17;
    p->noise ^= p->noise << 5;
    return GYRO_NOISE * ((float)(p->noise >> 8) / 8388608.0f - 1.0f);
}

static void measure(plant *p, quad_cycle *r)
{
    const float g = 9.81f;
    for (size_t i = 0; i < 3; i++) {
        r->gyro[i] = p->rate[i] + noise_of(p);
        r->attitude[i] = p->angle[i];
    }
    r->accel[0] = g * sinf(p->angle[1]);
    r->accel[1] = -g * sinf(p->angle[0]) * cosf(p->angle[1]);
    r->accel[2] = -g * cosf(p->angle[0]) * cosf(p->angle[1]);
    if (fabsf(p->angle[0]) > ANGLE_LIMIT || fabsf(p->angle[1]) > ANGLE_LIMIT) {
        r->flags |= QUAD_FLAG_ANGLE_LIMIT;
    }
}

/* What is added here at this place of the loop. */
static float added(const quad_cycle *r, uint8_t injection, size_t axis)
{
    return r->injection == injection ? r->excitation[axis] : 0.0f;
}

static float second_loop(plant *p, const quad_cycle *r, size_t axis, float period_s)
{
    const float *set = r->gains;
    const float error = r->rate_setpoint[axis] - r->gyro[axis];
    const float ki = quad_of_axis(set, axis, QUAD_RATE_KI);
    const float filter_hz = quad_of_axis(set, axis, QUAD_RATE_D_FILTER_HZ);
    p->integral[axis] = clip(p->integral[axis] + ki * error * period_s,
                             quad_of_axis(set, axis, QUAD_RATE_INTEGRATOR_LIMIT));
    const float share = period_s / (period_s + 1.0f / (TWO_PI * filter_hz));
    const float slope = (r->gyro[axis] - p->last_rate[axis]) / period_s;
    p->slope[axis] += share * (slope - p->slope[axis]);
    p->last_rate[axis] = r->gyro[axis];
    return clip(quad_of_axis(set, axis, QUAD_RATE_KP) * error + p->integral[axis] -
                    quad_of_axis(set, axis, QUAD_RATE_KD) * p->slope[axis],
                quad_of_axis(set, axis, QUAD_RATE_OUTPUT_LIMIT));
}

static void control(plant *p, quad_cycle *r, float throttle, float period_s)
{
    if ((r->flags & QUAD_FLAG_ARMED) == 0) {
        memset(p->integral, 0, sizeof p->integral);
        p->yaw_reference = r->attitude[2];
    }
    r->control[0] = throttle;
    for (size_t i = 0; i < 3; i++) {
        const float reference = i == 2 ? p->yaw_reference : 0.0f;
        r->attitude_setpoint[i] = reference + added(r, QUAD_INJECTION_ATTITUDE, i);
        const float kp = quad_of_axis(r->gains, i, QUAD_ANGLE_KP);
        const float limit = quad_of_axis(r->gains, i, QUAD_ANGLE_RATE_LIMIT);
        r->rate_setpoint[i] = clip(kp * (r->attitude_setpoint[i] - r->attitude[i]), limit) +
                              added(r, QUAD_INJECTION_RATE, i);
        r->control[i + 1] =
            second_loop(p, r, i, period_s) + added(r, QUAD_INJECTION_CONTROL, i);
    }
}

static void mix(quad_cycle *r)
{
    for (size_t motor = 0; motor < 4; motor++) {
        float sum = 0.0f;
        for (size_t u = 0; u < 4; u++) {
            sum += mixer[motor][u] * r->control[u];
        }
        const float cut = fmaxf(0.0f, fminf(1.0f, sum));
        if (cut != sum) {
            r->flags |= QUAD_FLAG_SATURATED;
        }
        r->motors[motor] = (r->flags & QUAD_FLAG_ARMED) != 0 ? cut : 0.0f;
    }
}

static void move(plant *p, const quad_cycle *r, float period_s)
{
    for (size_t i = 0; i < 3; i++) {
        float command = 0.0f;
        for (size_t motor = 0; motor < 4; motor++) {
            command += 0.25f * mixer[motor][i + 1] * r->motors[motor];
        }
        p->torque[i] += period_s / (period_s + MOTOR_LAG_S) * (command - p->torque[i]);
        p->rate[i] += period_s * (authority[i] * p->torque[i] - damping[i] * p->rate[i]);
        p->angle[i] += period_s * p->rate[i];
    }
    p->angle[2] -= TWO_PI * floorf(p->angle[2] / TWO_PI + 0.5f);
}

void plant_cycle(plant *p, quad_cycle *record, float throttle, float period_s)
{
    measure(p, record);
    control(p, record, throttle, period_s);
    mix(record);
    move(p, record, period_s);
}
