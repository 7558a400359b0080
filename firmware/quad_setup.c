/* See quad_setup.h. */
#include "quad_setup.h"

#include <math.h>
#include <stdint.h>

#define MIDDLE_US 1500.0f
#define LOW_US 1000.0f
#define FURTHEST_US 1000.0f /* from the middle, of any pulse */
#define LEAST_SPAN_US 150.0f /* least travel of a stick from its middle to an end */

/* Its pulses at both ends and in the middle; the throttle, without one, has its middle between. */
typedef struct {
    size_t least, middle, most;
} stick;

enum { STICKS = 4, SWITCHES = 3 };

static const stick sticks[STICKS] = {
    {QUAD_RECEIVER_ROLL_MIN_US, QUAD_RECEIVER_ROLL_CENTRE_US, QUAD_RECEIVER_ROLL_MAX_US},
    {QUAD_RECEIVER_PITCH_MIN_US, QUAD_RECEIVER_PITCH_CENTRE_US, QUAD_RECEIVER_PITCH_MAX_US},
    {QUAD_RECEIVER_THROTTLE_MIN_US, QUAD_PARAMETERS, QUAD_RECEIVER_THROTTLE_MAX_US},
    {QUAD_RECEIVER_YAW_MIN_US, QUAD_RECEIVER_YAW_CENTRE_US, QUAD_RECEIVER_YAW_MAX_US},
};

static float middle_of(const float *set, const stick *s)
{
    return s->middle < QUAD_PARAMETERS ? set[s->middle] : 0.5f * (set[s->least] + set[s->most]);
}

static size_t whole(float value)
{
    return (size_t)(value + 0.5f);
}

size_t quad_setup_channel(const float *set, size_t parameter)
{
    const size_t channel = whole(set[parameter]);
    return channel <= QUAD_CHANNELS ? channel : 0;
}

/* Whether these parameters, whole numbers from 1, are all different; 0 is like nothing else. */
static bool distinct(const float *set, size_t first, size_t count)
{
    uint32_t seen = 0;
    for (size_t i = 0; i < count; i++) {
        const uint32_t bit = 1u << whole(set[first + i]);
        if (bit > 1u && (seen & bit) != 0) {
            return false;
        }
        seen |= bit;
    }
    return true;
}

const char *quad_setup_fault(const float *set)
{
    if (!distinct(set, QUAD_RECEIVER_ROLL_CHANNEL, STICKS + SWITCHES)) {
        return "set-up: two functions on one channel";
    }
    for (size_t i = 0; i < STICKS; i++) {
        const float middle = middle_of(set, &sticks[i]);
        const float below = middle - set[sticks[i].least], above = set[sticks[i].most] - middle;
        if (!(below * above > 0.0f) || !(fminf(fabsf(below), fabsf(above)) >= LEAST_SPAN_US)) {
            return "set-up: a stick's end lies near its middle";
        }
    }
    if (!distinct(set, QUAD_MOTORS_OUTPUT_1, 4)) {
        return "set-up: two motors on one output";
    }
    if (!(set[QUAD_MOTORS_PULSE_MAX_US] - set[QUAD_MOTORS_PULSE_MIN_US] >= LEAST_SPAN_US)) {
        return "set-up: the motors' pulses are too near";
    }
    return NULL;
}

/* A stick behind its ends, middle and deadband; beyond its ends it goes on. */
static float meant(const float *set, const stick *s, float pulse_us)
{
    const float middle = middle_of(set, s), moved = pulse_us - middle;
    const float end = (moved > 0.0f) == (set[s->most] > set[s->least]) ? set[s->most] : set[s->least];
    const float dead = s->middle < QUAD_PARAMETERS ? set[QUAD_RECEIVER_DEADBAND_US] : 0.0f;
    const float span = fabsf(end - middle) - dead, past = fabsf(moved) - dead;
    if (!(past > 0.0f) || !(span > 0.0f)) {
        return MIDDLE_US;
    }
    const float off = fminf(FURTHEST_US, 500.0f * past / span);
    return MIDDLE_US + (end == set[s->most] ? off : -off);
}

void quad_setup_pulses(const float *set, const float came_us[QUAD_CHANNELS], float meant_us[QUAD_CHANNELS])
{
    static const size_t of[QUAD_CHANNELS] = {
        QUAD_RECEIVER_ROLL_CHANNEL, QUAD_RECEIVER_PITCH_CHANNEL, QUAD_RECEIVER_THROTTLE_CHANNEL,
        QUAD_RECEIVER_YAW_CHANNEL, QUAD_RECEIVER_KILL_CHANNEL, QUAD_RECEIVER_ARM_CHANNEL,
        QUAD_PARAMETERS, QUAD_RECEIVER_HOLD_CHANNEL, QUAD_PARAMETERS};
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        const size_t channel = of[i] < QUAD_PARAMETERS ? quad_setup_channel(set, of[i]) : i + 1;
        const float came = channel > 0 ? came_us[channel - 1] : LOW_US;
        meant_us[i] = i < STICKS ? meant(set, &sticks[i], came) : came;
    }
}

void quad_setup_outputs(const float *set, const float motors[4], float outputs[4])
{
    for (size_t i = 0; i < 4; i++) {
        outputs[i] = 0.0f;
    }
    for (size_t i = 0; i < 4; i++) {
        const size_t output = whole(set[QUAD_MOTORS_OUTPUT_1 + i]);
        outputs[output >= 1 && output <= 4 ? output - 1 : i] = motors[i];
    }
}
