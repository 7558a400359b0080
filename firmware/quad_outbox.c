/* See quad_outbox.h. A frame goes in whole or, where there is no room, not at all, and is counted. */
#include "quad_outbox.h"

#include <string.h>

#define NO_PULSE 0xFFFFu

static void put(quad_endpoint *e, const mavlink_message_t *message)
{
    uint8_t frame[MAVLINK_MAX_PACKET_LEN];
    const size_t size = mavlink_msg_to_send_buffer(frame, message);
    if (size > QUAD_OUTBOX - e->waiting) {
        e->counts.dropped++;
        return;
    }
    const size_t end = (e->first + e->waiting) % QUAD_OUTBOX;
    const size_t straight = size < QUAD_OUTBOX - end ? size : QUAD_OUTBOX - end;
    memcpy(&e->outbox[end], frame, straight);
    memcpy(e->outbox, &frame[straight], size - straight);
    e->waiting += size;
}

size_t quad_endpoint_send(quad_endpoint *e, uint8_t *out, size_t room)
{
    const size_t count = room < e->waiting ? room : e->waiting;
    const size_t straight = count < QUAD_OUTBOX - e->first ? count : QUAD_OUTBOX - e->first;
    memcpy(out, &e->outbox[e->first], straight);
    memcpy(&out[straight], e->outbox, count - straight);
    e->first = (e->first + count) % QUAD_OUTBOX;
    e->waiting -= count;
    return count;
}

/* Arguments that every generated pack function begins with. */
#define FROM(e) (e)->settings.system, (e)->settings.component, &(e)->link

void quad_put_cycle(quad_endpoint *e, const quad_cycle *r)
{
    mavlink_message_t m;
    mavlink_msg_quad_cycle_pack_status(FROM(e), &m, r->time_us, r->cycle, r->gyro, r->accel,
                                       r->attitude, r->attitude_setpoint, r->rate_setpoint,
                                       r->control, r->excitation, r->motors, r->flags,
                                       r->excitation_seq, r->injection);
    put(e, &m);
}

void quad_put_heartbeat(quad_endpoint *e)
{
    const bool armed = (e->last_flags & QUAD_FLAG_ARMED) != 0;
    mavlink_message_t m;
    /* quadrotor, generic autopilot; armed flag; active or standby */
    mavlink_msg_heartbeat_pack_status(FROM(e), &m, 2, 0, armed ? 128 : 0, 0, armed ? 4 : 3);
    put(e, &m);
}

void quad_put_gains_state(quad_endpoint *e, uint8_t action, uint8_t result)
{
    mavlink_message_t m;
    mavlink_msg_quad_gains_state_pack_status(FROM(e), &m, e->settings.aircraft,
                                             quad_gains_checksum(e->gains.active),
                                             e->gains.transaction, action, result,
                                             quad_gains_phase(&e->gains));
    put(e, &m);
}

void quad_put_parameter(quad_endpoint *e, size_t index)
{
    mavlink_message_t m;
    char name[QUAD_NAME_LENGTH];
    memcpy(name, quad_parameters[index].name, sizeof name);
    /* 9: a float */
    mavlink_msg_param_value_pack_status(FROM(e), &m, name, quad_gains_shown(&e->gains, index), 9,
                                        QUAD_PARAMETERS, (uint16_t)index);
    put(e, &m);
}

void quad_put_time(quad_endpoint *e, uint64_t now_us, int64_t asked_ns)
{
    mavlink_message_t m;
    mavlink_msg_timesync_pack_status(FROM(e), &m, (int64_t)(1000u * now_us), asked_ns);
    put(e, &m);
}

void quad_put_ack(quad_endpoint *e, uint16_t command, uint8_t result)
{
    mavlink_message_t m;
    mavlink_msg_command_ack_pack_status(FROM(e), &m, command, result, 0, 0, 0, 0);
    put(e, &m);
}

void quad_put_text(quad_endpoint *e, uint8_t severity, const char *text)
{
    mavlink_message_t m;
    char padded[50] = {0};
    for (size_t i = 0; i < sizeof padded && text[i] != '\0'; i++) {
        padded[i] = text[i];
    }
    mavlink_msg_statustext_pack_status(FROM(e), &m, severity, padded, 0, 0);
    put(e, &m);
}

/* Write words and a number behind `text`, whose length is returned. */
static size_t append(char *text, size_t length, size_t room, const char *words, uint32_t number)
{
    char digits[10];
    size_t count = 0;
    while (*words != '\0' && length + 1 < room) {
        text[length++] = *words++;
    }
    do {
        digits[count++] = (char)('0' + number % 10u);
        number /= 10u;
    } while (number > 0);
    while (count > 0 && length + 1 < room) {
        text[length++] = digits[--count];
    }
    text[length] = '\0';
    return length;
}

void quad_put_timing(quad_endpoint *e, uint32_t latest_us, uint32_t longest_us, uint32_t stack)
{
    char text[51];
    size_t length = append(text, 0, sizeof text, "timing: latest ", latest_us);
    length = append(text, length, sizeof text, ", longest ", longest_us);
    append(text, length, sizeof text, ", stack ", stack);
    quad_put_text(e, 6, text);
}

void quad_put_battery(quad_endpoint *e, const quad_slow *slow)
{
    mavlink_message_t m;
    uint16_t cells[10];
    const uint16_t none[4] = {0};
    memset(cells, 0xFF, sizeof cells);
    if (slow->battery_v >= 0.0f && slow->battery_v < 65.0f) {
        cells[0] = (uint16_t)(1000.0f * slow->battery_v + 0.5f);
    }
    mavlink_msg_battery_status_pack_status(FROM(e), &m, 0, 1, 1, INT16_MAX, cells, -1, -1, -1, -1,
                                           0, 0, none, 0, 0);
    put(e, &m);
}

void quad_put_receiver(quad_endpoint *e, const quad_cycle *record, const quad_pilot *pilot)
{
    mavlink_message_t m;
    uint16_t c[QUAD_RC_CHANNELS];
    const uint8_t count = pilot->count < QUAD_RC_CHANNELS ? pilot->count : QUAD_RC_CHANNELS;
    for (size_t i = 0; i < QUAD_RC_CHANNELS; i++) {
        c[i] = i < count ? pilot->pulse_us[i] : NO_PULSE;
    }
    mavlink_msg_rc_channels_pack_status(
        FROM(e), &m, (uint32_t)(record->time_us / 1000u), count, c[0], c[1], c[2], c[3], c[4], c[5],
        c[6], c[7], c[8], c[9], c[10], c[11], c[12], c[13], c[14], c[15], c[16], c[17],
        pilot->failsafe ? 0 : 200);
    put(e, &m);
}

void quad_put_slow_sensors(quad_endpoint *e, const quad_cycle *record, const quad_slow *slow)
{
    mavlink_message_t m;
    const float *mag = slow->mag_gauss;
    const bool compass = mag[0] == mag[0] && mag[1] == mag[1] && mag[2] == mag[2];
    const bool pressure = slow->pressure_hpa == slow->pressure_hpa;
    const uint16_t updated = (uint16_t)((compass ? 0x1C0 : 0) | (pressure ? 0x200 : 0));
    mavlink_msg_highres_imu_pack_status(
        FROM(e), &m, record->time_us, 0, 0, 0, 0, 0, 0, compass ? mag[0] : 0.0f,
        compass ? mag[1] : 0.0f, compass ? mag[2] : 0.0f, pressure ? slow->pressure_hpa : 0.0f, 0,
        0, slow->temperature_c, updated, 0);
    put(e, &m);
}
