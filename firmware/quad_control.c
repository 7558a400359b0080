/* See quad_control.h. */
#include "quad_control.h"

#include <math.h>
#include <string.h>

#define TURN_F 6.28318531f
#define VOLTAGE_LAG_S 0.5f
#define LARGEST_LIFT 1.5f /* of the command, either way, whatever voltage is measured */
#define SHORTEST_LAG_S 1e-5f
#define LARGEST_RATE 140.0f      /* rad/s, of an observer: twice what any gyro reports */
#define LARGEST_YAW_LEAD 1.0472f /* rad, of its reference; a full stick leads by 0.8 at the paper's gain */

/* Rows: motors 1 rear left, 2 rear right, 3 front right, 4 front left; columns U1..U4, FRD. */
static const float mixer[4][4] = {
    {1, 1, -1, -1},
    {1, -1, -1, 1},
    {1, -1, 1, -1},
    {1, 1, 1, 1},
};

/* 0 for what is no number. */
static float clip(float value, float limit)
{
    return isnan(value) ? 0.0f : fmaxf(-limit, fminf(limit, value));
}

void quad_control_init(quad_control *control)
{
    memset(control, 0, sizeof *control);
}

/* What is added here at this place of the loop. */
static float added(const quad_cycle *r, uint8_t injection, size_t axis)
{
    return r->injection == injection ? r->excitation[axis] : 0.0f;
}

/* Whether an integral of this error would ask for more of what the motors did not give. */
static bool held_back(const quad_control *c, size_t axis, float error)
{
    return c->not_given[axis] * error > 0.0f;
}

static float second_loop(quad_control *c, const quad_cycle *r, size_t axis, float period_s)
{
    const float *set = r->gains;
    const float rate = c->d_rate[axis], error = r->rate_setpoint[axis] - r->gyro[axis];
    if (!held_back(c, axis, error)) {
        c->integral[axis] = clip(c->integral[axis] +
                                     quad_of_axis(set, axis, QUAD_RATE_KI) * error * period_s,
                                 quad_of_axis(set, axis, QUAD_RATE_INTEGRATOR_LIMIT));
    }
    const float filter_hz = quad_of_axis(set, axis, QUAD_RATE_D_FILTER_HZ);
    const float share = period_s / (period_s + 1.0f / (TURN_F * filter_hz));
    const float slope = (rate - c->last_rate[axis]) / period_s;
    c->slope[axis] += share * (slope - c->slope[axis]);
    c->last_rate[axis] = rate;
    return clip(quad_of_axis(set, axis, QUAD_RATE_KP) * error + c->integral[axis] -
                    quad_of_axis(set, axis, QUAD_RATE_KD) * c->slope[axis],
                quad_of_axis(set, axis, QUAD_RATE_OUTPUT_LIMIT));
}

/* The model's delay in whole cycles. */
static size_t cycles_late(const float *set, size_t axis, float period_s)
{
    const float cycles = floorf(quad_of_axis(set, axis, QUAD_LQR_DELAY_S) / period_s + 0.5f);
    return (size_t)fminf((float)QUAD_LONGEST_DELAY, fmaxf(0.0f, cycles));
}

/* How far the drive goes towards its command within a cycle. */
static float drive_share(const float *set, size_t axis, float period_s)
{
    return 1.0f - expf(-period_s / fmaxf(quad_of_axis(set, axis, QUAD_LQR_LAG_S), SHORTEST_LAG_S));
}

/* The state feedback's command of this cycle, unlimited. */
static float state_feedback(quad_feedback *own, const float *set, size_t axis, float period_s,
                            float error, float rate)
{
    own->rate += quad_of_axis(set, axis, QUAD_LQR_OBSERVER) * (rate - own->rate);
    const float share = drive_share(set, axis, period_s);
    const float gain = quad_of_axis(set, axis, QUAD_LQR_GAIN);
    const float damping = quad_of_axis(set, axis, QUAD_LQR_DAMPING);
    const float k_integral = quad_of_axis(set, axis, QUAD_LQR_K_INTEGRAL);
    float drive = own->drive, speed = own->rate, total = own->integral;
    for (size_t late = cycles_late(set, axis, period_s); late > 0; late--) {
        const float then = drive + share * (gain * own->commands[late - 1] - drive);
        const float after = speed + period_s * (0.5f * (drive + then) - damping * speed);
        total += k_integral * period_s * error;
        error -= 0.5f * period_s * (speed + after);
        drive = then;
        speed = after;
    }
    const float k_rate = quad_of_axis(set, axis, QUAD_LQR_K_RATE);
    /* the same limit of the rate that is asked for as the cascade's */
    const float pull = clip(quad_of_axis(set, axis, QUAD_LQR_K_ANGLE) * error,
                            quad_of_axis(set, axis, QUAD_ANGLE_RATE_LIMIT) * k_rate);
    return pull - k_rate * speed - quad_of_axis(set, axis, QUAD_LQR_K_DRIVE) * drive + total;
}

/* Take over what was commanded; `held`: the integral stays, the output was at its limit. */
static void feedback_moved(quad_feedback *own, const float *set, size_t axis, float period_s,
                           float error, float command, bool held)
{
    if (!held) {
        own->integral =
            clip(own->integral + quad_of_axis(set, axis, QUAD_LQR_K_INTEGRAL) * period_s * error,
                 quad_of_axis(set, axis, QUAD_RATE_INTEGRATOR_LIMIT));
    }
    memmove(&own->commands[1], &own->commands[0], QUAD_LONGEST_DELAY * sizeof(float));
    own->commands[0] = command;
    const float acting = own->commands[cycles_late(set, axis, period_s)];
    const float gain = quad_of_axis(set, axis, QUAD_LQR_GAIN);
    const float drive =
        own->drive + drive_share(set, axis, period_s) * (gain * acting - own->drive);
    own->rate += period_s * (0.5f * (own->drive + drive) -
                             quad_of_axis(set, axis, QUAD_LQR_DAMPING) * own->rate);
    own->drive = drive;
}

/* `u` of the cascade with the axis' share of state feedback in it; `extra` rad/s wanted. */
static float blended(quad_control *c, const quad_cycle *r, size_t axis, float period_s, float u,
                     float error, float extra)
{
    quad_feedback *own = &c->feedback[axis];
    const float *set = r->gains;
    const float share = quad_of_axis(set, axis, QUAD_LQR_SHARE);
    if (share <= 0.0f) { /* it begins where the cascade is, and with the rate that is measured */
        own->integral = c->integral[axis];
        own->rate = r->gyro[axis];
        return u;
    }
    if (!(quad_of_axis(set, axis, QUAD_LQR_K_INTEGRAL) > 0.0f)) {
        own->integral = 0.0f; /* nothing would ever change it */
    }
    const float raw = state_feedback(own, set, axis, period_s, error, r->gyro[axis]) +
                      quad_of_axis(set, axis, QUAD_LQR_K_RATE) * extra;
    if (!isfinite(raw) || fabsf(own->rate) > LARGEST_RATE) { /* its model is none of this aircraft */
        memset(own, 0, sizeof *own);
        own->rate = r->gyro[axis];
        return u;
    }
    /* two integrals of the same error would drift apart */
    c->integral[axis] = own->integral;
    return clip(share * raw + (1.0f - share) * u, quad_of_axis(set, axis, QUAD_RATE_OUTPUT_LIMIT));
}

/* What a command is multiplied by at this voltage. */
static float lift(const float *set, size_t axis, float volts)
{
    const float exponent = quad_of_axis(set, axis, QUAD_SAG_EXPONENT);
    const float reference = quad_of_axis(set, axis, QUAD_SAG_REFERENCE_V);
    if (!(exponent > 0.0f && reference > 0.0f && volts > 0.0f)) {
        return 1.0f;
    }
    return fminf(LARGEST_LIFT, fmaxf(1.0f / LARGEST_LIFT, powf(reference / volts, exponent)));
}

/* Nothing of a flight before is left. */
static void begin(quad_control *c, const quad_cycle *r)
{
    c->started = true;
    c->yaw_reference = r->attitude[2];
    for (size_t i = 0; i < 3; i++) {
        c->integral[i] = 0.0f;
        c->last_rate[i] = c->d_rate[i];
        c->not_given[i] = 0.0f;
        memset(&c->feedback[i], 0, sizeof c->feedback[i]);
        c->feedback[i].rate = r->gyro[i];
    }
}

/* The rates as the derivative sees them. */
static void see_rates(quad_control *c, const quad_cycle *r, float period_s)
{
    memcpy(c->d_rate, r->gyro, sizeof c->d_rate);
    quad_notch_tune(&c->d_notch, r->gains[QUAD_RATE_D_NOTCH_HZ],
                    r->gains[QUAD_RATE_D_NOTCH_BANDWIDTH_HZ], period_s);
    if (!c->started) {
        quad_notch_settle(&c->d_notch, c->d_rate);
    }
    quad_notch_pass(&c->d_notch, c->d_rate);
}

static void fly_axis(quad_control *c, quad_cycle *r, size_t i, float period_s)
{
    const float *set = r->gains;
    const float error = quad_wrapped(r->attitude_setpoint[i] - r->attitude[i]);
    const float extra = added(r, QUAD_INJECTION_RATE, i);
    r->rate_setpoint[i] = clip(quad_of_axis(set, i, QUAD_ANGLE_KP) * error,
                               quad_of_axis(set, i, QUAD_ANGLE_RATE_LIMIT)) +
                          extra;
    float u = second_loop(c, r, i, period_s);
    const bool followed = quad_of_axis(set, i, QUAD_LQR_GAIN) > 0.0f;
    if (followed) {
        u = blended(c, r, i, period_s, u, error, extra);
    } else {
        c->feedback[i].integral = c->integral[i]; /* it begins where the cascade is */
    }
    const bool held = fabsf(u) >= quad_of_axis(set, i, QUAD_RATE_OUTPUT_LIMIT) || held_back(c, i, error);
    const float on_top = added(r, QUAD_INJECTION_CONTROL, i);
    if (followed) {
        feedback_moved(&c->feedback[i], set, i, period_s, error, u + on_top, held);
    }
    r->control[i + 1] = u * lift(set, i, c->volts) + on_top;
}

/* What the state feedback's model of an axis has under way is what the motors gave. */
static void not_given(quad_control *c, const quad_cycle *r, const float given[4])
{
    for (size_t i = 0; i < 3; i++) {
        c->not_given[i] = r->control[i + 1] - given[i + 1];
        c->feedback[i].commands[0] -= c->not_given[i] / lift(r->gains, i, c->volts);
    }
}

bool quad_mix(const float control[4], float idle, float motors[4], float given[4])
{
    float turning[4], least = INFINITY, most = -INFINITY, down = -INFINITY, up = INFINITY;
    for (size_t i = 0; i < 4; i++) {
        turning[i] = mixer[i][1] * control[1] + mixer[i][2] * control[2];
        least = fminf(least, turning[i]);
        most = fmaxf(most, turning[i]);
        motors[i] = given[i] = 0.0f;
    }
    if (!isfinite(control[0] + control[3] + most - least)) {
        return true;
    }
    const float has = 1.0f - idle, needs = most - least;
    const float share = needs > has ? has / needs : 1.0f;
    const float throttle = fmaxf(idle - share * least, fminf(1.0f - share * most, control[0]));
    for (size_t i = 0; i < 4; i++) {
        const float here = throttle + share * turning[i];
        const float below = fminf(0.0f, idle - here), above = fmaxf(0.0f, 1.0f - here);
        down = fmaxf(down, mixer[i][3] > 0.0f ? below : -above);
        up = fminf(up, mixer[i][3] > 0.0f ? above : -below);
    }
    const float yaw = fmaxf(down, fminf(up, control[3]));
    for (size_t i = 0; i < 4; i++) {
        const float sum = throttle + share * turning[i] + mixer[i][3] * yaw;
        motors[i] = fmaxf(idle, fminf(1.0f, sum));
    }
    given[0] = throttle;
    given[1] = share * control[1];
    given[2] = share * control[2];
    given[3] = yaw;
    return share < 1.0f || throttle != control[0] || yaw != control[3];
}

/* Whether torque is commanded: see quad_control.h. */
static bool flies(quad_control *c, const quad_cycle *r, const quad_sticks *sticks)
{
    const bool armed = (r->flags & QUAD_FLAG_ARMED) != 0;
    const bool landed = (r->flags & QUAD_FLAG_LANDED) != 0;
    c->airborne = armed && !landed && (c->airborne || sticks->throttle >= QUAD_AIRBORNE_THROTTLE);
    const bool stays = c->airborne && r->gains[QUAD_MIXER_AIRMODE] >= 0.5f;
    return armed && (stays || sticks->throttle >= QUAD_LOW_THROTTLE);
}

void quad_control_cycle(quad_control *c, const quad_ranges *ranges, const quad_sticks *sticks,
                        float volts, float period_s, quad_cycle *r)
{
    const bool armed = (r->flags & QUAD_FLAG_ARMED) != 0;
    if (volts > 0.0f && volts < QUAD_MOST_VOLTS) {
        const float share = c->volts > 0.0f ? period_s / VOLTAGE_LAG_S : 1.0f;
        c->volts += share * (volts - c->volts);
    }
    const bool in_flight = flies(c, r, sticks);
    see_rates(c, r, period_s);
    if (!c->started || !in_flight) {
        begin(c, r);
    }
    c->yaw_reference =
        quad_wrapped(c->yaw_reference + sticks->yaw * ranges->yaw_rate * period_s);
    const float lead = quad_wrapped(c->yaw_reference - r->attitude[2]);
    if (fabsf(lead) > LARGEST_YAW_LEAD) { /* it waits for an aircraft that cannot follow */
        c->yaw_reference = quad_wrapped(r->attitude[2] + clip(lead, LARGEST_YAW_LEAD));
    }
    const float references[3] = {sticks->roll * ranges->angle, sticks->pitch * ranges->angle,
                                 c->yaw_reference};
    for (size_t i = 0; i < 3; i++) {
        r->attitude_setpoint[i] = references[i] + added(r, QUAD_INJECTION_ATTITUDE, i);
        fly_axis(c, r, i, period_s);
    }
    if (!in_flight) {
        memset(r->control, 0, sizeof r->control);
    }
    r->control[0] = armed ? sticks->throttle : 0.0f;
    if (in_flight) { /* FRD: the third value points down */
        r->control[0] = fmaxf(0.0f, r->control[0] - added(r, QUAD_INJECTION_THRUST, 2));
    }
    float given[4];
    if (!armed) {
        memset(r->motors, 0, sizeof r->motors);
    } else if (quad_mix(r->control, in_flight ? r->gains[QUAD_MIXER_IDLE] : 0.0f, r->motors, given)) {
        r->flags |= QUAD_FLAG_SATURATED;
    }
    if (in_flight) {
        not_given(c, r, given);
    }
    if (fmaxf(fabsf(r->attitude[0]), fabsf(r->attitude[1])) > ranges->angle_limit) {
        r->flags |= QUAD_FLAG_ANGLE_LIMIT;
    }
}
