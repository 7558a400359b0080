/* Beats the endpoint with bytes: random ones, frames of every kind with any content, damaged ones.
 *     fuzz SEED BYTES
 * Ends with 1 where a bound is broken; the sanitizers end it where memory or arithmetic is. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "quad_endpoint.h"

static uint64_t seed;
static quad_endpoint open_one, locked; /* without and with a key that nobody knows */

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

/* Mostly what makes sense, so that the depths are reached; the rest is any byte. */
static void fill(mavlink_message_t *m, uint32_t kind)
{
    if (kind == MAVLINK_MSG_ID_PARAM_SET && draw(4) != 0) {
        const quad_parameter *p = &quad_parameters[draw(QUAD_PARAMETERS)];
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
        g.checksum = quad_gains_checksum(draw(2) ? open_one.gains.copy : open_one.gains.active);
        memcpy(_MAV_PAYLOAD_NON_CONST(m), &g, MAVLINK_MSG_ID_QUAD_GAINS_LEN);
    } else if (kind == MAVLINK_MSG_ID_QUAD_EXCITATION && draw(4) != 0) {
        mavlink_quad_excitation_t x = {.valid_ms = (uint16_t)draw(2000)};
        x.injection = (uint8_t)draw(5);
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

static const char *broken(const quad_endpoint *e)
{
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
    }
    return e->waiting > QUAD_OUTBOX || e->first >= QUAD_OUTBOX ? "the outbox overflows" : NULL;
}

static void cycle(quad_endpoint *e, uint64_t now_us, uint16_t *flags)
{
    const quad_pilot pilot = {{1500}, (uint8_t)draw(30), draw(50) == 0, draw(50) == 0};
    const quad_slow slow = {draw(50) == 0 ? 9.0f : 12.0f, {0, 0, 0}, 1000.0f, 20.0f};
    uint8_t out[600];
    quad_cycle record;
    quad_endpoint_begin_cycle(e, now_us, &pilot, &record);
    *flags = record.flags;
    record.flags |= draw(50) == 0 ? QUAD_FLAG_ANGLE_LIMIT : 0u;
    quad_endpoint_end_cycle(e, &record, &pilot, &slow);
    quad_endpoint_send(e, out, draw(sizeof out));
}

int main(int count, char **given)
{
    const uint8_t key[32] = {1, 2, 3};
    quad_settings settings = {.system = 1, .component = 1, .aircraft = 1, .rate_hz = 250,
                              .low_battery_v = 9.9f, .armed = true, .may_arm = true};
    if (count != 3) {
        fprintf(stderr, "fuzz SEED BYTES\n");
        return 2;
    }
    seed = 0x9E3779B97F4A7C15u ^ strtoull(given[1], NULL, 10);
    const uint64_t wanted = strtoull(given[2], NULL, 10);
    quad_endpoint_init(&open_one, &settings);
    settings.key = key;
    settings.signing_time = 1000;
    quad_endpoint_init(&locked, &settings);
    uint64_t fed = 0, now_us = 0, excited = 0, reverted = 0;
    while (fed < wanted) {
        uint8_t bytes[300];
        size_t size = draw(3) == 0 ? draw(64) : 0;
        for (size_t i = 0; i < size; i++) {
            bytes[i] = (uint8_t)(draw(6) == 0 ? 0xFD : draw(256));
        }
        size = size == 0 ? make_frame(bytes) : size;
        fed += size;
        now_us += draw(200) == 0 ? draw(3000000) : draw(4000);
        quad_endpoint_receive(&open_one, bytes, size, now_us);
        quad_endpoint_receive(&locked, bytes, size, now_us);
        if (draw(3) == 0) {
            uint16_t flags;
            const uint8_t before = quad_gains_phase(&open_one.gains);
            cycle(&open_one, now_us, &flags);
            reverted += before != 0 && quad_gains_phase(&open_one.gains) == 0;
            excited += (flags & QUAD_FLAG_EXCITATION) != 0;
            cycle(&locked, now_us, &flags);
            if ((flags & QUAD_FLAG_EXCITATION) != 0 || locked.counts.frames != 0) {
                return fprintf(stderr, "the locked one obeyed\n"), 1;
            }
        }
        const char *fault = broken(&open_one);
        if (fault != NULL) {
            return fprintf(stderr, "%s after %" PRIu64 " bytes\n", fault, fed), 1;
        }
    }
    printf("%" PRIu64 " bytes, %u frames used, %u bad, %" PRIu64 " cycles excited, %" PRIu64
           " reverts; locked: %u unsigned, %u forged, %u replayed\n",
           fed, open_one.counts.frames, open_one.counts.bad, excited, reverted,
           locked.counts.unsigned_frames, locked.counts.forged, locked.counts.replayed);
    return 0;
}
