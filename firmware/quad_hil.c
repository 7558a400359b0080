/* See quad_hil.h. */
#include "quad_hil.h"

#include <math.h>
#include <string.h>

#define START 0xA5u
#define HEAD 4u
#define CRC 2u
#define SENSORS_HEAD (8u + 2u + 4u * (QUAD_CHANNELS + 6u))
#define SAMPLE (4u * 6u)
#define BOOT (8u + 2u + 4u + 4u * 6u + 4u * QUAD_PARAMETERS)

static uint16_t crc_of(const uint8_t *bytes, size_t count)
{
    uint32_t crc = 0xFFFFu;
    for (size_t i = 0; i < count; i++) {
        crc ^= (uint32_t)bytes[i] << 8;
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc & 0x8000u) != 0 ? (crc << 1) ^ 0x1021u : crc << 1;
        }
    }
    return (uint16_t)(crc & 0xFFFFu);
}

/* A place in a payload that is read or written in order. */
typedef struct {
    uint8_t *next;
} place;

static uint64_t take_number(place *p, size_t size)
{
    uint64_t value = 0;
    for (size_t i = size; i > 0; i--) {
        value = (value << 8) | p->next[i - 1];
    }
    p->next += size;
    return value;
}

static float take_float(place *p)
{
    const uint32_t bits = (uint32_t)take_number(p, 4);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void take_floats(place *p, float *values, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        values[i] = take_float(p);
    }
}

static void put_number(place *p, uint64_t value, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        *p->next++ = (uint8_t)(value >> (8 * i));
    }
}

static void put_float(place *p, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_number(p, bits, 4);
}

/* aircraft u64, rate_hz u16, armed, may_arm, samples, lockstep u8, angle, yaw_rate, angle_limit,
 * low_battery_v, complementary_s, declination, then the stored gains */
static bool take_boot(place p, quad_hil_boot *boot)
{
    quad_firmware_settings *s = &boot->settings;
    *s = quad_firmware_defaults();
    s->failsafe_off_us = 0;
    s->endpoint.aircraft = take_number(&p, 8);
    s->endpoint.rate_hz = (uint16_t)take_number(&p, 2);
    s->endpoint.armed = take_number(&p, 1) != 0;
    s->endpoint.may_arm = take_number(&p, 1) != 0;
    const uint64_t samples = take_number(&p, 1);
    boot->lockstep = take_number(&p, 1) != 0;
    s->ranges.angle = take_float(&p);
    s->ranges.yaw_rate = take_float(&p);
    s->ranges.angle_limit = take_float(&p);
    s->endpoint.low_battery_v = take_float(&p);
    s->mounting.complementary_s = take_float(&p);
    s->mounting.declination = take_float(&p);
    take_floats(&p, boot->stored, QUAD_PARAMETERS); /* each is checked by quad_gains_init */
    s->endpoint.stored = boot->stored;
    if (samples < 1 || samples > QUAD_MOST_SAMPLES || s->endpoint.rate_hz < 50 ||
        s->endpoint.rate_hz > 1000 || !(s->mounting.complementary_s > 0.1f) ||
        !isfinite(s->mounting.complementary_s + s->mounting.declination + s->ranges.angle +
                  s->ranges.yaw_rate + s->ranges.angle_limit + s->endpoint.low_battery_v)) {
        return false;
    }
    s->mounting.sample_s = 1.0f / ((float)samples * (float)s->endpoint.rate_hz);
    return true;
}

/* time_us u64, failsafe u8, samples u8, 9 pulses, battery_v, mag (3), pressure_hpa,
 * temperature_c, then gyro (3) and accel (3) of each sample; NaN where not measured */
static bool take_sensors(place p, size_t length, uint64_t *time_us, quad_inputs *inputs)
{
    quad_sensors *s = &inputs->sensors;
    *time_us = take_number(&p, 8);
    inputs->receiver.failsafe = take_number(&p, 1) != 0;
    s->samples = (size_t)take_number(&p, 1);
    if (s->samples > QUAD_MOST_SAMPLES || length != SENSORS_HEAD + s->samples * SAMPLE) {
        s->samples = 0;
        return false;
    }
    take_floats(&p, inputs->receiver.pulse_us, QUAD_CHANNELS);
    s->slow.battery_v = take_float(&p);
    take_floats(&p, s->slow.mag_gauss, 3);
    s->slow.pressure_hpa = take_float(&p);
    s->slow.temperature_c = take_float(&p);
    for (size_t i = 0; i < s->samples; i++) {
        take_floats(&p, s->gyro[i], 3);
        take_floats(&p, s->accel[i], 3);
    }
    return true;
}

/* Forget the first bytes up to the next one that may start a frame. */
static void skip(quad_hil *hil)
{
    size_t next = 1;
    while (next < hil->count && hil->bytes[next] != START) {
        next++;
    }
    hil->count -= next;
    memmove(hil->bytes, &hil->bytes[next], hil->count);
}

static size_t length_of(const quad_hil *hil)
{
    return (size_t)hil->bytes[2] | (size_t)hil->bytes[3] << 8;
}

quad_hil_kind quad_hil_take(quad_hil *hil, uint8_t byte, quad_hil_boot *boot, uint64_t *time_us,
                            quad_inputs *inputs)
{
    quad_hil_kind kind = QUAD_HIL_NOTHING;
    hil->bytes[hil->count++] = byte;
    while (hil->count > 0 &&
           (hil->bytes[0] != START ||
            (hil->count >= HEAD && length_of(hil) > QUAD_HIL_LARGEST - HEAD - CRC))) {
        skip(hil);
    }
    if (hil->count < HEAD || hil->count < HEAD + length_of(hil) + CRC) {
        return kind;
    }
    const size_t length = length_of(hil);
    place after = {&hil->bytes[HEAD + length]};
    const place payload = {&hil->bytes[HEAD]};
    if (take_number(&after, CRC) != crc_of(&hil->bytes[1], HEAD - 1 + length)) {
        hil->bad++;
        skip(hil); /* what follows is looked at again with the next byte */
        return kind;
    }
    if (hil->bytes[1] == 'B' && length == BOOT && take_boot(payload, boot)) {
        kind = QUAD_HIL_BOOT;
    } else if (hil->bytes[1] == 'S' && length >= SENSORS_HEAD &&
               take_sensors(payload, length, time_us, inputs)) {
        kind = QUAD_HIL_SENSORS;
    } else {
        hil->bad++;
    }
    hil->count = 0;
    return kind;
}

/* time_us u64, motors (4), latest_us, longest_us, overruns u32 */
void quad_hil_motors(const float motors[4], uint64_t time_us, const quad_timing *timing,
                     uint8_t out[QUAD_HIL_MOTORS])
{
    place p = {out};
    put_number(&p, START, 1);
    put_number(&p, 'M', 1);
    put_number(&p, QUAD_HIL_MOTORS - HEAD - CRC, 2);
    put_number(&p, time_us, 8);
    for (size_t i = 0; i < 4; i++) {
        put_float(&p, motors[i]);
    }
    put_number(&p, timing->latest_us, 4);
    put_number(&p, timing->longest_us, 4);
    put_number(&p, timing->overruns, 4);
    put_number(&p, crc_of(&out[1], (size_t)(p.next - out) - 1), 2);
}
