/* The control law on records in memory: what is held back where the motors cannot give it, airmode, notches; the
 * attitude of what is turned over; the height mode on a point mass, with the barometer lost in the midst. */
#include <math.h>
#include <string.h>

#include "check.h"
#include "quad_attitude.h"
#include "quad_control.h"
#include "quad_height.h"
#include "quad_parameters.h"

#define PERIOD_S 0.004f
#define SAMPLE_S 0.001f

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

/* Turn it about its pitch at this rate for so many seconds. */
static void pitch_over(quad_attitude *a, float *angle, float rate, float seconds, float attitude[3])
{
    const quad_mounting mounting = {.axes = {1, 2, 3}, .sample_s = PERIOD_S, .complementary_s = 5.0f};
    quad_sensors s = {.samples = 1, .gyro = {{0.0f, rate, 0.0f}}, .slow = {.mag_gauss = {NAN, NAN, NAN}}};
    float gyro[3], accel[3];
    for (float at = 0.0f; at < seconds; at += PERIOD_S) {
        *angle += PERIOD_S * rate;
        s.accel[0][0] = 9.80665f * sinf(*angle);
        s.accel[0][2] = -9.80665f * cosf(*angle);
        quad_attitude_cycle(a, &mounting, &s, gains, PERIOD_S, gyro, accel, attitude);
    }
}

static void test_turned_over(void)
{
    quad_attitude a;
    float angle = 3.1415927f, attitude[3];
    begin();
    quad_attitude_init(&a);
    pitch_over(&a, &angle, 0.0f, 1.0f, attitude); /* the battery was plugged in from below */
    check(fabsf(attitude[0]) > 3.1f && fabsf(attitude[1]) < 0.01f, "upside down");
    pitch_over(&a, &angle, 3.1415927f, 1.0f, attitude);
    pitch_over(&a, &angle, 0.0f, 0.1f, attitude);
    check(fabsf(attitude[0]) < 0.05f && fabsf(attitude[1]) < 0.05f, "level once it was turned over by its nose");
    pitch_over(&a, &angle, -3.1415927f, 1.0f, attitude);
    pitch_over(&a, &angle, 0.0f, 5.0f, attitude);
    check(fabsf(attitude[0]) > 3.0f && fabsf(attitude[1]) < 0.05f, "upside down again, for long");
    pitch_over(&a, &angle, -3.1415927f, 1.0f, attitude);
    pitch_over(&a, &angle, 0.0f, 0.1f, attitude);
    check(fabsf(attitude[0]) < 0.05f && fabsf(attitude[1]) < 0.05f, "and level after a whole turn");
}

/* A mass that one unit of throttle accelerates by 30 m/s^2, on a ground. */
typedef struct {
    quad_height mode;
    double height, climb, force; /* m, m/s, m/s^2 */
    float highest, tilt;
} mass;

static void lift(mass *m, float stick, bool wanted, bool barometer, size_t cycles)
{
    const float attitude[3] = {m->tilt, 0.0f, 0.0f};
    for (size_t k = 0; k < cycles; k++) {
        const double noise = 0.15 * sin(1.7 * (double)k) + 0.1 * sin(0.31 * (double)k);
        const float hpa = (float)(1000.0 * pow(1.0 - (m->height + noise) / 44330.77, 5.2559));
        const float up = (float)m->force;
        const float accel[3] = {0.0f, -sinf(m->tilt) * up, -cosf(m->tilt) * up};
        quad_height_measure(&m->mode, gains, accel, attitude, barometer ? hpa : NAN, true, PERIOD_S);
        const float throttle =
            quad_height_throttle(&m->mode, gains, attitude, stick, false, wanted, true, PERIOD_S);
        check(throttle >= 0.0f && throttle <= 1.0f, "a throttle");
        const double pull = 30.0 * (double)(throttle * cosf(m->tilt));
        m->force = m->height <= 0.0 ? fmax(pull, 9.80665) : pull;
        m->climb += (double)PERIOD_S * (m->force - 9.80665);
        m->height = fmax(0.0, m->height + (double)PERIOD_S * m->climb);
        m->climb = m->height <= 0.0 ? fmax(0.0, m->climb) : m->climb;
        m->highest = fmaxf(m->highest, (float)m->height);
    }
}

static void test_height(void)
{
    mass m = {.force = 9.80665};
    begin();
    gains[QUAD_CLIMB_HEIGHT_CEILING] = 3.0f;
    quad_height_init(&m.mode);
    lift(&m, 0.0f, true, true, 500);
    check(m.mode.landed && m.mode.holding && m.height <= 0.0, "on the ground it waits");
    lift(&m, 1.0f, true, true, 2500);
    check(!m.mode.landed && fabs(m.height - 3.0) < 0.3 && m.highest < 3.6f, "up to the ceiling, not beyond");
    m.tilt = 0.4f;
    lift(&m, 0.5f, true, true, 2000);
    check(fabs(m.height - (double)m.mode.reference) < 0.3, "the stick in its middle holds it, tilted too");
    m.tilt = 0.0f;
    lift(&m, 0.5f, true, true, 500);
    const double before = m.height;
    lift(&m, 0.5f, true, false, 750);
    check(m.mode.lost && fabs(m.height - before) < 1.5, "without the barometer the throttle stays");
    const float held = m.mode.throttle;
    lift(&m, 0.6f, true, false, 1);
    check(m.mode.throttle > held, "and the stick has it");
    lift(&m, 0.33f, false, true, 250);
    check(!m.mode.holding && m.mode.throttle == 0.33f, "until the pilot leaves the mode");
    lift(&m, 0.33f, true, true, 250);
    check(m.mode.holding && m.mode.known, "the barometer is back");
    lift(&m, 0.0f, true, true, 3500);
    check(m.mode.landed && m.mode.throttle == 0.0f && m.height <= 0.0, "it sinks and has landed");
    lift(&m, 0.33f, true, true, 250);
    check(m.mode.landed && m.mode.throttle == 0.0f, "and stays there");
}

/* Whatever throttle it is switched on at, the stick has the height, and the ceiling holds. */
static void test_height_from_any_throttle(void)
{
    static const float throttles[] = {1.0f, 0.8f, 0.1f};
    for (size_t i = 0; i < sizeof throttles / sizeof throttles[0]; i++) {
        const float stick = throttles[i], middle = fmaxf(0.2f, fminf(0.8f, stick));
        mass m = {.force = 9.80665};
        begin();
        quad_height_init(&m.mode);
        lift(&m, 0.36f, false, true, 250);
        lift(&m, 0.45f, false, true, 250);
        lift(&m, 0.25f, false, true, 125);
        lift(&m, stick, false, true, 125);
        lift(&m, stick, true, true, 1);
        check(!m.mode.landed && m.mode.holding, "the mode begins in the air");
        lift(&m, middle, true, true, 8000);
        check(fabs(m.climb) < 0.2 && fabs(m.height - (double)m.mode.reference) < 0.5, "it holds its height");
        lift(&m, 0.0f, true, true, 500);
        check(m.climb < -0.3, "it sinks as the stick asks");
        lift(&m, 1.0f, true, true, 15000);
        check(fabs(m.height - 30.0) < 0.5, "and climbs to the ceiling");
    }
}

int main(void)
{
    test_no_integral_of_what_is_not_given();
    test_airmode();
    test_notch();
    test_turned_over();
    test_height();
    test_height_from_any_throttle();
    return checked();
}
