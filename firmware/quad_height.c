/* See quad_height.h. */
#include "quad_height.h"

#include <math.h>
#include <string.h>

#include "quad_parameters.h"

#define GRAVITY 9.80665f
#define LOWEST_HPA 300.0f /* lowest pressure at which one flies */
#define HIGHEST_HPA 1200.0f
#define METRES 44330.77f /* standard atmosphere: METRES (1 - (p / p0)^POWER) */
#define POWER 0.190263f
#define LARGEST_JUMP 20.0f /* m: a measurement that far from the estimate is none */
#define LARGEST_BIAS 1.0f  /* m/s^2 */
#define GROUND_LAG_S 2.0f
#define DEADBAND 0.08f   /* deadband of the stick about its middle */
#define LEAST 0.1f       /* throttle in the mode in the air: what roll and pitch need */
#define MOST 0.9f
#define LEAST_COSINE 0.7f /* cosine of the largest tilt that is compensated */
#define LOW_M 1.5f       /* below it, it sinks slowly */
#define SLOW_M_S 0.4f
#define STILL_M_S 0.25f
#define SINKS 0.15f /* of the command a second, of what is asked to sink and does not */
#define SETTLED_S 1.0f   /* time until it counts as a landing */
#define LIFTED_S 0.5f    /* time until it counts as a take-off */
#define LIFTS 0.7f       /* share of CLIMB_HOVER above which it may fly */
#define IDLE 0.05f       /* throttle that is nothing: QUAD_LOW_THROTTLE */
#define COAST_S 0.4f     /* climb over so long that a released stick adds to the height reference */

static float within(float value, float least, float most)
{
    return fmaxf(least, fminf(most, value));
}

void quad_height_init(quad_height *h)
{
    memset(h, 0, sizeof *h);
    h->landed = true;
    h->silent_s = QUAD_BARO_S;
}

/* Take a pressure: the barometer's height where it is new and could be. */
static void hear(quad_height *h, float hpa, float period_s)
{
    h->silent_s = fminf(h->silent_s + period_s, 10.0f);
    if (hpa >= LOWEST_HPA && hpa <= HIGHEST_HPA && hpa != h->hpa) {
        const bool first = !(h->ground_hpa > 0.0f);
        h->ground_hpa = first ? hpa : h->ground_hpa;
        const float metres = METRES * (1.0f - powf(hpa / h->ground_hpa, POWER));
        if (!h->known || fabsf(metres - h->height) < LARGEST_JUMP) {
            h->barometer = metres;
            h->silent_s = 0.0f;
        }
        h->hpa = hpa;
    }
    h->known = h->silent_s < QUAD_BARO_S;
}

/* Disarmed: the place is the ground, and what the accelerometer shows is its bias. */
static void stand(quad_height *h, float acceleration, float period_s)
{
    const float share = fminf(1.0f, period_s / GROUND_LAG_S);
    h->bias = within(h->bias + share * (acceleration - h->bias), -LARGEST_BIAS, LARGEST_BIAS);
    if (h->known) {
        h->ground_hpa += share * (h->hpa - h->ground_hpa);
    }
    h->height = h->climb = h->acceleration = h->barometer = 0.0f;
}

void quad_height_measure(quad_height *h, const float *set, const float accel[3], const float attitude[3], float hpa,
                         bool armed, float period_s)
{
    const float sr = sinf(attitude[0]), cr = cosf(attitude[0]);
    const float sp = sinf(attitude[1]), cp = cosf(attitude[1]);
    const float up = sp * accel[0] - cp * (sr * accel[1] + cr * accel[2]) - GRAVITY;
    const float filter_s = set[QUAD_CLIMB_FILTER_S];
    hear(h, hpa, period_s);
    if (!isfinite(up)) {
        return;
    }
    if (!armed) {
        stand(h, up, period_s);
        return;
    }
    const float wrong = h->known ? h->barometer - h->height : 0.0f;
    h->acceleration = up - h->bias;
    h->height += period_s * (h->climb + 3.0f / filter_s * wrong);
    h->climb += period_s * (h->acceleration + 3.0f / (filter_s * filter_s) * wrong);
    h->bias = within(h->bias - period_s * wrong / (filter_s * filter_s * filter_s), -LARGEST_BIAS, LARGEST_BIAS);
    if (!h->known) {
        h->climb -= period_s / filter_s * h->climb;
    }
}

/* Change `landed` once `looks` has held for so long. */
static void decide(quad_height *h, bool looks, float long_s, float period_s)
{
    h->pending_s = looks ? h->pending_s + period_s : 0.0f;
    if (h->pending_s >= long_s) {
        h->landed = !h->landed;
        h->pending_s = 0.0f;
    }
}

/* The climb that the stick asks for, m/s; 0 about its middle. */
static float asked(const quad_height *h, const float *set, float stick)
{
    const float off = stick - h->middle;
    const float past = fabsf(off) - DEADBAND;
    const float span = (off > 0.0f ? 1.0f - h->middle : h->middle) - DEADBAND;
    if (!(past > 0.0f)) {
        return 0.0f;
    }
    return copysignf(set[QUAD_CLIMB_HEIGHT_RATE_LIMIT] * fminf(1.0f, past / span), off);
}

/* From the throttle of the moment. The trim stays so near the hovering one that the loop's limits reach to both sides
 * of it: about that of a steep climb they would not, and it would climb whatever is asked. */
static void enter(quad_height *h, const float *set, float stick)
{
    const float hover = set[QUAD_CLIMB_HOVER], most = set[QUAD_CLIMB_RATE_INTEGRATOR_LIMIT];
    const float near = 0.5f * set[QUAD_CLIMB_RATE_OUTPUT_LIMIT];
    h->holding = true;
    h->lost = false;
    h->landed = h->landed && stick < LIFTS * hover;
    h->middle = h->landed ? 0.5f : within(stick, 0.2f, 0.8f);
    h->trim = h->landed ? hover : within(stick, hover - near, hover + near);
    h->integral = h->landed ? 0.0f : within(stick - h->trim, -most, most);
    h->reference = h->height;
    h->pending_s = 0.0f;
}

/* The climb that is to be flown, m/s. */
static float climb_reference(quad_height *h, const float *set, float wish)
{
    const float kp = set[QUAD_CLIMB_HEIGHT_KP], limit = set[QUAD_CLIMB_HEIGHT_RATE_LIMIT];
    const float ceiling = set[QUAD_CLIMB_HEIGHT_CEILING];
    float reference = wish;
    if (wish != 0.0f) {
        h->reference = fminf(ceiling, h->height + COAST_S * h->climb);
    } else {
        reference = within(kp * (h->reference - h->height), -limit, limit);
    }
    if (h->height < LOW_M) {
        reference = fmaxf(reference, -SLOW_M_S);
    }
    return fminf(reference, fmaxf(-limit, kp * (ceiling - h->height)));
}

static float hold(quad_height *h, const float *set, const float attitude[3], float wish, float period_s)
{
    const float climb = climb_reference(h, set, wish);
    const float error = climb - h->climb, limit = set[QUAD_CLIMB_RATE_OUTPUT_LIMIT];
    const float raw = set[QUAD_CLIMB_RATE_KP] * error + h->integral - set[QUAD_CLIMB_RATE_KD] * h->acceleration;
    const float tilt = fmaxf(LEAST_COSINE, cosf(attitude[0]) * cosf(attitude[1]));
    const float sum = (h->trim + within(raw, -limit, limit)) / tilt;
    const float throttle = within(sum, LEAST, MOST);
    if (fabsf(raw) < limit ? throttle == sum || (sum - throttle) * error < 0.0f : raw * error < 0.0f) {
        const float most = set[QUAD_CLIMB_RATE_INTEGRATOR_LIMIT];
        h->integral = within(h->integral + period_s * set[QUAD_CLIMB_RATE_KI] * error, -most, most);
    }
    if (h->landed) {
        decide(h, h->height > 0.3f || throttle >= h->trim + 0.5f * limit, LIFTED_S, period_s);
    } else {
        const bool still = climb < -STILL_M_S && fabsf(h->climb) < STILL_M_S;
        decide(h, still && throttle <= fmaxf(LEAST, 0.5f * h->trim), SETTLED_S, period_s);
        if (still) {
            h->integral = fmaxf(-limit, h->integral - SINKS * period_s);
        }
    }
    return h->landed && wish <= 0.0f ? 0.0f : throttle;
}

static float by_hand(quad_height *h, const float *set, float stick, float period_s)
{
    h->holding = h->lost = false;
    if (h->landed) {
        decide(h, stick >= LIFTS * set[QUAD_CLIMB_HOVER], LIFTED_S, period_s);
    } else {
        decide(h, stick < IDLE && fabsf(h->climb) < STILL_M_S, SETTLED_S, period_s);
    }
    return stick;
}

float quad_height_throttle(quad_height *h, const float *set, const float attitude[3], float stick, bool middle,
                           bool wanted, bool armed, float period_s)
{
    if (!armed) {
        h->landed = true;
        h->holding = h->lost = false;
        h->pending_s = 0.0f;
        h->throttle = stick;
        return stick;
    }
    if (wanted && !h->holding && h->known) {
        enter(h, set, stick);
    }
    if (!wanted || !h->holding) {
        h->throttle = by_hand(h, set, stick, period_s);
        return h->throttle;
    }
    h->lost = h->lost || !h->known;
    const float at = middle ? h->middle : stick;
    if (h->lost) {
        const float last = h->landed ? 0.0f : h->trim + h->integral;
        h->throttle = within(last + at - h->middle, 0.0f, MOST);
        return h->throttle;
    }
    const float wish = asked(h, set, at);
    if (h->landed && wish <= 0.0f) {
        h->pending_s = h->integral = h->throttle = 0.0f;
        h->trim = set[QUAD_CLIMB_HOVER];
        h->reference = h->height;
        return 0.0f;
    }
    h->throttle = hold(h, set, attitude, wish, period_s);
    return h->throttle;
}
