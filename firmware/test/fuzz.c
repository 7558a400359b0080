/* Beats the firmware with bytes: random ones, frames of every kind with any content, damaged ones,
 * and with inputs that no sensor would give.
 *     fuzz SEED BYTES
 * Ends with 1 where a bound is broken; the sanitizers end it where memory or arithmetic is. */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "quad_hil.h"

static uint64_t seed;
static quad_firmware open_one, locked; /* without and with a key that nobody knows */
static quad_hil line;

static uint32_t draw(uint32_t below)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (uint32_t)(seed >> 32) % below;
}

static const uint32_t kinds[] = {
    MAVLINK_MSG_ID_HEARTBEAT,       MAVLINK_MSG_ID_TIMESYNC,
    MAVLINK_MSG_ID_PARAM_SET,       MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
    MAVLINK_MSG_ID_QUAD_EXCITATION, MAVLINK_MSG_ID_QUAD_GAINS,
    MAVLINK_MSG_ID_COMMAND_LONG,    MAVLINK_MSG_ID_PARAM_REQUEST_READ,
    MAVLINK_MSG_ID_QUAD_CYCLE,      MAVLINK_MSG_ID_STATUSTEXT,
};

/* Mostly a number as it might be; any float at times. */
static float number(float middle, float spread)
{
    if (draw(200) != 0) {
        return middle + spread * ((float)draw(2001) / 1000.0f - 1.0f);
    }
    const uint32_t bits = (draw(1u << 16) << 16) | draw(1u << 16);
    float any;
    memcpy(&any, &bits, sizeof any);
    return any;
}

/* Mostly what makes sense, so that the depths are reached; the rest is any byte. */
static void fill(mavlink_message_t *m, uint32_t kind)
{
    if (kind == MAVLINK_MSG_ID_PARAM_SET && draw(4) != 0) {
        /* seldom one of the set-up: few of them fit together */
        const quad_parameter *p = &quad_parameters[draw(draw(50) == 0 ? QUAD_PARAMETERS : QUAD_SET_UP)];
        float value = p->lowest + (p->highest - p->lowest) * (float)draw(1000) / 800.0f;
        mavlink_param_set_t set = {.target_system = 1, .target_component = 1};
        memcpy(set.param_id, p->name, sizeof set.param_id);
        set.param_value = value;
        memcpy(_MAV_PAYLOAD_NON_CONST(m), &set, MAVLINK_MSG_ID_PARAM_SET_LEN);
    } else if (kind == MAVLINK_MSG_ID_QUAD_GAINS && draw(4) != 0) {
        mavlink_quad_gains_t g = {.target_system = 0, .target_component = 0};
        g.action = (uint8_t)draw(6);
        g.transaction = (uint8_t)draw(3);
        g.watch_ms = (uint16_t)draw(5000);
        g.checksum = quad_gains_checksum(draw(2) ? open_one.endpoint.gains.copy
                                                 : open_one.endpoint.gains.active);
        memcpy(_MAV_PAYLOAD_NON_CONST(m), &g, MAVLINK_MSG_ID_QUAD_GAINS_LEN);
    } else if (kind == MAVLINK_MSG_ID_COMMAND_LONG && draw(4) != 0) { /* arm, or spin a motor */
        mavlink_command_long_t c = {.command = (uint16_t)(draw(2) == 0 ? 400 : 209)};
        c.param1 = (float)draw(c.command == 400 ? 3 : 6);
        c.param3 = (float)draw(40);
        c.param4 = number(0.5f, 1.0f);
        c.param5 = (float)draw(3);
        memcpy(_MAV_PAYLOAD_NON_CONST(m), &c, MAVLINK_MSG_ID_COMMAND_LONG_LEN);
    } else if (kind == MAVLINK_MSG_ID_QUAD_EXCITATION && draw(4) != 0) {
        mavlink_quad_excitation_t x = {.valid_ms = (uint16_t)draw(2000)};
        x.injection = (uint8_t)(draw(2) == 0 ? 0 : draw(5)); /* 0 ends a refusal */
        for (int i = 0; i < 3; i++) {
            x.value[i] = (float)draw(1000) / 1500.0f;
        }
        memcpy(_MAV_PAYLOAD_NON_CONST(m), &x, MAVLINK_MSG_ID_QUAD_EXCITATION_LEN);
    }
}

static size_t make_frame(uint8_t *bytes)
{
    const uint32_t kind = kinds[draw(sizeof kinds / sizeof kinds[0])];
    const mavlink_msg_entry_t *entry = mavlink_get_msg_entry(kind);
    mavlink_status_t status;
    mavlink_signing_t signing;
    mavlink_message_t m;
    memset(&status, 0, sizeof status);
    memset(&signing, 0, sizeof signing);
    memset(&m, 0, sizeof m);
    for (int i = 0; i < entry->max_msg_len; i++) {
        _MAV_PAYLOAD_NON_CONST(&m)[i] = (char)draw(256);
    }
    fill(&m, kind);
    m.msgid = kind & 0xFFFFFFu;
    if (draw(4) == 0) { /* signed, with a key of its own */
        signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
        signing.timestamp = seed >> 16;
        status.signing = &signing;
    }
    status.current_tx_seq = (uint8_t)draw(256);
    mavlink_finalize_message_buffer(&m, 1, (uint8_t)(draw(8) == 0 ? 1 : 191), &status,
                                    entry->min_msg_len, entry->max_msg_len, entry->crc_extra);
    size_t count = mavlink_msg_to_send_buffer(bytes, &m);
    if (draw(5) == 0) {
        bytes[draw((uint32_t)count)] ^= (uint8_t)(1u << draw(8));
    }
    return draw(10) == 0 ? draw((uint32_t)count) : count;
}

static const char *broken(const quad_firmware *f)
{
    const quad_endpoint *e = &f->endpoint;
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        if (i != QUAD_LOOP_RATE_HZ && (!quad_parameter_fits(i, e->gains.active[i]) ||
                                       !quad_parameter_fits(i, e->gains.good[i]))) {
            return "a parameter is out of its bounds";
        }
    }
    for (int i = 0; i < 3; i++) {
        if (!(e->excitation.value[i] >= -QUAD_LIMIT_RATE &&
              e->excitation.value[i] <= QUAD_LIMIT_RATE)) {
            return "an excitation is beyond its limits";
        }
        if (!isfinite(f->record.gyro[i] + f->record.attitude[i] + f->record.control[i + 1] + f->height.height +
                      f->record.control[0])) {
            return "a number is not finite";
        }
    }
    for (int i = 0; i < 4; i++) {
        const float tested = (f->record.flags & QUAD_FLAG_MOTOR_TEST) != 0 ? QUAD_TEST_THROTTLE : 0.0f;
        const float most = (f->record.flags & QUAD_FLAG_ARMED) != 0 ? 1.0f : tested;
        if (!(f->record.motors[i] >= 0.0f && f->record.motors[i] <= most)) {
            return "a motor is beyond its limits";
        }
    }
    return e->waiting > QUAD_OUTBOX || e->first >= QUAD_OUTBOX ? "the outbox overflows" : NULL;
}

static void measure(quad_inputs *inputs)
{
    static uint32_t at; /* cycles since the arm switch was thrown off; it is on again from the 20th on */
    quad_sensors *s = &inputs->sensors;
    s->samples = draw(QUAD_MOST_SAMPLES + 2);
    for (size_t i = 0; i < QUAD_MOST_SAMPLES; i++) {
        for (size_t k = 0; k < 3; k++) {
            s->gyro[i][k] = number(0.0f, 0.5f);
            s->accel[i][k] = number(k == 2 ? 9.81f : 0.0f, 0.5f);
        }
    }
    s->slow.battery_v = draw(50) == 0 ? 0.8f : number(1.1f, 0.05f);
    for (size_t k = 0; k < 3; k++) {
        s->slow.mag_gauss[k] = number(0.2f, 0.2f);
    }
    s->slow.pressure_hpa = number(1000.0f, 10.0f);
    s->slow.temperature_c = number(20.0f, 10.0f);
    inputs->receiver.failsafe = draw(100) == 0;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        inputs->receiver.pulse_us[i] = number(i == 4 ? 1100.0f : 1500.0f, i == 4 ? 50.0f : 600.0f);
    }
    inputs->receiver.pulse_us[4] += draw(200) == 0 ? 900.0f : 0.0f;
    at = draw(200) == 0 ? 0 : at + 1;
    inputs->receiver.pulse_us[5] = at < 20 ? 1100.0f : 1900.0f;
    if (at >= 20 && at < 40 && draw(20) != 0) { /* as a pilot has it who arms */
        inputs->receiver.pulse_us[2] = 1000.0f;
    }
}

/* The second line too: whole frames and noise. */
static void beat_line(void)
{
    static quad_hil_boot boot;
    static quad_inputs inputs;
    uint64_t time_us;
    uint8_t bytes[QUAD_HIL_LARGEST + 40];
    const size_t size = draw(sizeof bytes);
    for (size_t i = 0; i < size; i++) {
        bytes[i] = (uint8_t)(draw(20) == 0 ? 0xA5 : draw(256));
    }
    for (size_t i = 0; i < size; i++) {
        quad_hil_take(&line, bytes[i], &boot, &time_us, &inputs);
    }
}

static void cycle(quad_firmware *f, uint64_t now_us, const quad_inputs *inputs)
{
    uint8_t out[600];
    float motors[4];
    quad_firmware_cycle(f, now_us, inputs, motors);
    quad_firmware_send(f, out, draw(sizeof out));
}

int main(int count, char **given)
{
    const uint8_t key[32] = {1, 2, 3};
    quad_firmware_settings settings = quad_firmware_defaults();
    settings.endpoint.armed = settings.endpoint.may_arm = true;
    if (count != 3) {
        fprintf(stderr, "fuzz SEED BYTES\n");
        return 2;
    }
    seed = 0x9E3779B97F4A7C15u ^ strtoull(given[1], NULL, 10);
    const uint64_t wanted = strtoull(given[2], NULL, 10);
    quad_firmware_init(&open_one, &settings);
    settings.endpoint.key = key;
    settings.endpoint.signing_time = 1000;
    quad_firmware_init(&locked, &settings);
    uint64_t fed = 0, now_us = 0, excited = 0, reverted = 0, tested = 0;
    while (fed < wanted) {
        uint8_t bytes[300];
        size_t size = draw(3) == 0 ? draw(64) : 0;
        for (size_t i = 0; i < size; i++) {
            bytes[i] = (uint8_t)(draw(6) == 0 ? 0xFD : draw(256));
        }
        size = size == 0 ? make_frame(bytes) : size;
        fed += size;
        now_us += draw(200) == 0 ? draw(3000000) : draw(4000);
        quad_firmware_receive(&open_one, bytes, size, now_us);
        quad_firmware_receive(&locked, bytes, size, now_us);
        if (draw(3) == 0) {
            quad_inputs inputs;
            const uint8_t before = quad_gains_phase(&open_one.endpoint.gains);
            measure(&inputs);
            cycle(&open_one, now_us, &inputs);
            reverted += before != 0 && quad_gains_phase(&open_one.endpoint.gains) == 0;
            excited += (open_one.record.flags & QUAD_FLAG_EXCITATION) != 0;
            tested += (open_one.record.flags & QUAD_FLAG_MOTOR_TEST) != 0;
            cycle(&locked, now_us, &inputs);
            if (draw(20) == 0) {
                beat_line();
            }
            if ((locked.record.flags & QUAD_FLAG_EXCITATION) != 0 ||
                locked.endpoint.counts.frames != 0) {
                return fprintf(stderr, "the locked one obeyed\n"), 1;
            }
        }
        const char *fault = broken(&open_one);
        if (fault != NULL) {
            return fprintf(stderr, "%s after %" PRIu64 " bytes\n", fault, fed), 1;
        }
    }
    printf("%" PRIu64 " bytes, %u frames used, %u bad, %" PRIu64 " cycles excited, %" PRIu64
           " reverts, %" PRIu64 " cycles with a motor's test; locked: %u unsigned, %u forged, %u replayed\n",
           fed, open_one.endpoint.counts.frames, open_one.endpoint.counts.bad, excited, reverted, tested,
           locked.endpoint.counts.unsigned_frames, locked.endpoint.counts.forged, locked.endpoint.counts.replayed);
    return 0;
}
