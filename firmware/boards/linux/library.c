/* The firmware as a shared library, for simulations in memory. The caller brings the memory, so that
 * there may be as many as it likes. */
#include <math.h>
#include <string.h>

#include "quad_hil.h"

typedef struct {
    quad_firmware firmware;
    quad_hil hil;
    quad_hil_boot boot;
    quad_inputs inputs;
    uint64_t time_us;
} simulated;

size_t quad_library_size(void);
int quad_library_boot(simulated *s, const uint8_t *frame, size_t count, const uint8_t *key,
                      uint64_t signing_time);
void quad_library_receive(simulated *s, const uint8_t *bytes, size_t count, uint64_t now_us);
size_t quad_library_send(simulated *s, uint8_t *out, size_t room);
int quad_library_cycle(simulated *s, const uint8_t *frame, size_t count,
                       uint8_t motors[QUAD_HIL_MOTORS]);
void quad_library_gains(const simulated *s, float out[QUAD_PARAMETERS]);
void quad_library_counts(const simulated *s, uint32_t out[6]);
void quad_library_arm(simulated *s, int armed, int may_arm);
double quad_library_fly(simulated *s, const float *gains, const double *given, double volts, double pascal,
                        const double *mag, const double *samples, int64_t count, double *out);

size_t quad_library_size(void)
{
    return sizeof(simulated);
}

static quad_hil_kind take(simulated *s, const uint8_t *frame, size_t count)
{
    quad_hil_kind kind = QUAD_HIL_NOTHING;
    for (size_t i = 0; i < count && kind == QUAD_HIL_NOTHING; i++) {
        kind = quad_hil_take(&s->hil, frame[i], &s->boot, &s->time_us, &s->inputs);
    }
    return kind;
}

/* 0 where the frame is not a boot frame. */
int quad_library_boot(simulated *s, const uint8_t *frame, size_t count, const uint8_t *key,
                      uint64_t signing_time)
{
    memset(s, 0, sizeof *s);
    if (take(s, frame, count) != QUAD_HIL_BOOT) {
        return 0;
    }
    s->boot.settings.endpoint.key = key;
    s->boot.settings.endpoint.signing_time = signing_time;
    quad_firmware_init(&s->firmware, &s->boot.settings);
    return 1;
}

void quad_library_receive(simulated *s, const uint8_t *bytes, size_t count, uint64_t now_us)
{
    quad_firmware_receive(&s->firmware, bytes, count, now_us);
}

size_t quad_library_send(simulated *s, uint8_t *out, size_t room)
{
    return quad_firmware_send(&s->firmware, out, room);
}

/* 0 where the frame is not one of sensors. */
int quad_library_cycle(simulated *s, const uint8_t *frame, size_t count,
                       uint8_t motors[QUAD_HIL_MOTORS])
{
    float commands[4];
    if (take(s, frame, count) != QUAD_HIL_SENSORS) {
        return 0;
    }
    quad_firmware_cycle(&s->firmware, s->time_us, &s->inputs, commands);
    quad_hil_motors(commands, s->time_us, &s->firmware.timing, motors);
    return 1;
}

void quad_library_gains(const simulated *s, float out[QUAD_PARAMETERS])
{
    memcpy(out, s->firmware.endpoint.gains.active, sizeof s->firmware.endpoint.gains.active);
}

void quad_library_counts(const simulated *s, uint32_t out[6])
{
    const quad_counts *c = &s->firmware.endpoint.counts;
    const uint32_t all[6] = {c->frames, c->bad,      c->unsigned_frames,
                             c->forged, c->replayed, c->dropped};
    memcpy(out, all, sizeof all);
}

void quad_library_arm(simulated *s, int armed, int may_arm)
{
    s->firmware.endpoint.armed = armed != 0;
    s->firmware.endpoint.settings.may_arm = may_arm != 0;
}

static void turned(const float in[3], double out[3])
{
    out[0] = (double)in[0];
    out[1] = -(double)in[1];
    out[2] = -(double)in[2];
}

static void turned_attitude(const float in[3], double out[3])
{
    turned(in, out);
    out[2] = remainder(1.5707963267948966 - (double)in[2], 6.283185307179586);
}

/* One cycle of the control loop alone, whatever the endpoint would say: for flights as arrays, in
 * FLU and ENU. `given` (10): armed, injection, excitation (3), sticks roll, pitch, throttle, yaw, height mode;
 * `mag` (3) T; `samples` (count, 6) gyro and accelerometer. Writes rates, acceleration, angles,
 * angle and rate references (3 each), U1..U4, motors, height and climb; returns 1 for a cut motor, 2 beyond the
 * angle limit, 4 on the ground. */
double quad_library_fly(simulated *s, const float *gains, const double *given, double volts, double pascal,
                        const double *mag, const double *samples, int64_t count, double *out)
{
    quad_firmware *f = &s->firmware;
    quad_sensors *sensors = &s->inputs.sensors;
    quad_cycle r = {.gains = gains, .flags = given[0] > 0.5 ? QUAD_FLAG_ARMED : 0u};
    quad_sticks sticks = {(float)given[5], -(float)given[6], -(float)given[8],
                                (float)given[7]};
    sensors->samples = (size_t)count;
    for (size_t i = 0; i < 3; i++) {
        sensors->slow.mag_gauss[i] = (float)(1e4 * mag[i]);
        for (size_t k = 0; k < sensors->samples; k++) {
            sensors->gyro[k][i] = (float)samples[6 * k + i];
            sensors->accel[k][i] = (float)samples[6 * k + 3 + i];
        }
    }
    r.injection = (uint8_t)given[1];
    r.excitation[0] = (float)given[2];
    r.excitation[1] = -(float)given[3];
    r.excitation[2] = -(float)given[4];
    quad_attitude_cycle(&f->attitude, &f->settings.mounting, sensors, gains, f->period_s, r.gyro,
                        r.accel, r.attitude);
    const bool armed = given[0] > 0.5;
    quad_height_measure(&f->height, gains, r.accel, r.attitude, (float)(0.01 * pascal), armed, f->period_s);
    sticks.throttle = quad_height_throttle(&f->height, gains, r.attitude, sticks.throttle, false, given[9] > 0.5,
                                           armed, f->period_s);
    r.flags |= f->height.landed ? QUAD_FLAG_LANDED : 0u;
    quad_control_cycle(&f->control, &f->settings.ranges, &sticks, (float)volts, f->period_s, &r);
    turned(r.gyro, out);
    turned(r.accel, &out[3]);
    turned_attitude(r.attitude, &out[6]);
    turned_attitude(r.attitude_setpoint, &out[9]);
    turned(r.rate_setpoint, &out[12]);
    out[15] = (double)r.control[0];
    turned(&r.control[1], &out[16]);
    for (size_t i = 0; i < 4; i++) {
        out[19 + i] = (double)r.motors[i];
    }
    out[23] = (double)f->height.height;
    out[24] = (double)f->height.climb;
    return ((r.flags & QUAD_FLAG_SATURATED) != 0 ? 1.0 : 0.0) +
           ((r.flags & QUAD_FLAG_ANGLE_LIMIT) != 0 ? 2.0 : 0.0) + ((r.flags & QUAD_FLAG_LANDED) != 0 ? 4.0 : 0.0);
}
