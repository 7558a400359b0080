/* The control law on records in memory: what is held back where the motors cannot give it, airmode, notches. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "quad_attitude.h"
#include "quad_control.h"
#include "quad_parameters.h"

#define PERIOD_S 0.004f
#define SAMPLE_S 0.001f

static int failures, checks;

static void check(bool holds, const char *what)
{
    checks++;
    if (!holds) {
        failures++;
        printf("not so: %s\n", what);
    }
}

static float gains[QUAD_PARAMETERS];
static quad_control control;
static quad_cycle record;

static void begin(void)
{
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        gains[i] = quad_parameters[i].start;
    }
    quad_control_init(&control);
}

/* Armed and level with this throttle; turning about an axis. */
static void fly(float throttle, size_t axis, float rate, size_t cycles)
{
    const quad_ranges ranges = {0.5f, 1.5f, 0.5f};
    const quad_sticks sticks = {0.0f, 0.0f, 0.0f, throttle};
    for (size_t k = 0; k < cycles; k++) {
        record = (quad_cycle){.gains = gains, .flags = QUAD_FLAG_ARMED};
        record.gyro[axis] = rate;
        quad_control_cycle(&control, &ranges, &sticks, NAN, PERIOD_S, &record);
    }
}

static void test_no_integral_of_what_is_not_given(void)
{
    begin();
    fly(1.0f, 2, -1.0f, 250);
    check(record.control[3] > 0.1f && record.motors[0] == record.motors[1], "no yaw at full throttle");
    check((record.flags & QUAD_FLAG_SATURATED) != 0, "which is told");
    check(fabsf(control.integral[2]) <= gains[2 * QUAD_PER_AXIS + QUAD_RATE_KI] * PERIOD_S * 1.1f,
          "its integral waits");
    fly(0.5f, 2, -1.0f, 250);
    check(control.integral[2] > 0.9f * gains[2 * QUAD_PER_AXIS + QUAD_RATE_KI], "and goes on");
}

static void test_airmode(void)
{
    for (int on = 0; on < 2; on++) {
        begin();
        gains[QUAD_MIXER_AIRMODE] = (float)on;
        fly(0.0f, 0, 1.0f, 5);
        check(record.motors[0] == 0.0f && record.motors[1] == 0.0f, "on the ground nothing turns");
        fly(0.5f, 0, 1.0f, 5);
        fly(0.0f, 0, 1.0f, 5);
        check((record.motors[0] != record.motors[2]) == (on != 0), "stabilised in the air without throttle");
        for (size_t i = 0; i < 4 && on != 0; i++) {
            check(record.motors[i] >= gains[QUAD_MIXER_IDLE], "no motor below idle");
        }
    }
}

/* Largest of a sine of this frequency behind the notch, of the last second. */
static float passed(quad_notch *notch, float hz)
{
    float most = 0.0f;
    for (int k = 0; k < 4000; k++) {
        float v[3] = {(float)sin(6.283185307179586 * (double)hz * 0.001 * k), 1.0f, 0.0f};
        quad_notch_pass(notch, v);
        most = k >= 3000 ? fmaxf(most, fabsf(v[0])) : 0.0f;
        check(v[1] == 1.0f, "a constant passes exactly");
    }
    return most;
}

static void test_notch(void)
{
    quad_notch notch;
    memset(&notch, 0, sizeof notch);
    const float rest[3] = {0.0f, 1.0f, 0.0f};
    quad_notch_settle(&notch, rest);
    quad_notch_tune(&notch, 0.0f, 20.0f, SAMPLE_S);
    check(passed(&notch, 80.0f) > 0.99f, "off at 0 Hz");
    quad_notch_tune(&notch, 80.0f, 20.0f, SAMPLE_S);
    check(passed(&notch, 80.0f) < 1e-3f, "gone where it is");
    const float lower = sqrtf(80.0f * 80.0f + 100.0f) - 10.0f; /* -3 dB, nearly: bilinear */
    check(fabsf(passed(&notch, lower) - 0.7071f) < 0.03f, "half of the power at its edge");
    check(passed(&notch, 5.0f) > 0.995f, "and the flight passes");
    quad_notch_tune(&notch, 0.45f / SAMPLE_S, 20.0f, SAMPLE_S);
    check(passed(&notch, 80.0f) > 0.99f, "off beyond what the samples tell");
}

int main(void)
{
    test_no_integral_of_what_is_not_given();
    test_airmode();
    test_notch();
    printf("%d checks, %d failed\n", checks, failures);
    return failures > 0;
}
