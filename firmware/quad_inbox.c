/* The endpoint's ear: bytes to frames, who may speak, and what each frame does. */
#include <math.h>
#include <string.h>

#include "quad_outbox.h"

#define ARM_DISARM 400 /* MAV_CMD_COMPONENT_ARM_DISARM */
#define MOTOR_TEST 209 /* MAV_CMD_DO_MOTOR_TEST: motor from 1, type, throttle, s, count */
#define PERCENT 0.0f   /* MOTOR_TEST_THROTTLE_PERCENT */
#define STANDS_US 2000000u /* since it was in motion: what fell has reached the ground */

enum { ACCEPTED = 0, NOT_NOW = 1, DENIED = 2, UNSUPPORTED = 3 }; /* MAV_RESULT */

static bool for_us(const quad_endpoint *e, uint8_t system, uint8_t component)
{
    return (system == 0 || system == e->settings.system) &&
           (component == 0 || component == e->settings.component);
}

static void take_excitation(quad_endpoint *e, uint64_t now_us)
{
    mavlink_quad_excitation_t m;
    mavlink_msg_quad_excitation_decode(&e->rx, &m);
    if (for_us(e, m.target_system, m.target_component)) {
        float value[3];
        memcpy(value, m.value, sizeof value);
        quad_excitation_take(&e->excitation, value, m.injection, m.seq, m.valid_ms, now_us);
    }
}

static void take_gains(quad_endpoint *e, uint64_t now_us)
{
    mavlink_quad_gains_t m;
    mavlink_msg_quad_gains_decode(&e->rx, &m);
    if (for_us(e, m.target_system, m.target_component)) {
        const quad_gains_request request = {m.action, m.transaction, m.watch_ms, m.checksum};
        uint8_t action = m.action, result = QUAD_GAINS_RESULT_ARMED;
        if (m.action != QUAD_GAINS_ACTION_COMMIT || !e->armed || !quad_gains_sets_up(&e->gains)) {
            result = quad_gains_act(&e->gains, &request, now_us, &action);
        }
        quad_put_gains_state(e, action, result);
    }
}

static void answer_parameter(quad_endpoint *e, const char *name)
{
    const int index = quad_parameter_index(name);
    if (index >= 0) {
        quad_put_parameter(e, (size_t)index);
        return;
    }
    char text[50] = "unknown parameter ";
    memcpy(&text[18], name, QUAD_NAME_LENGTH);
    quad_put_text(e, 4, text);
}

static void take_read(quad_endpoint *e)
{
    mavlink_param_request_read_t m;
    mavlink_msg_param_request_read_decode(&e->rx, &m);
    if (!for_us(e, m.target_system, m.target_component)) {
        return;
    }
    if (m.param_index >= 0 && m.param_index < QUAD_PARAMETERS) {
        quad_put_parameter(e, (size_t)m.param_index);
    } else {
        answer_parameter(e, m.param_id);
    }
}

static void take_set(quad_endpoint *e)
{
    mavlink_param_set_t m;
    mavlink_msg_param_set_decode(&e->rx, &m);
    if (for_us(e, m.target_system, m.target_component)) {
        const int index = quad_parameter_index(m.param_id);
        if (index >= 0 && (index < QUAD_SET_UP || !e->armed)) {
            quad_gains_write(&e->gains, (size_t)index, m.param_value);
        }
        answer_parameter(e, m.param_id);
    }
}

static void take_list(quad_endpoint *e)
{
    mavlink_param_request_list_t m;
    mavlink_msg_param_request_list_decode(&e->rx, &m);
    if (for_us(e, m.target_system, m.target_component)) {
        e->list_next = 0;
    }
}

const char *quad_endpoint_unarmed(const quad_endpoint *e)
{
    const uint16_t flags = e->last_flags;
    const struct {
        bool holds;
        const char *text;
    } why[] = {
        {(flags & QUAD_FLAG_RC_FAILSAFE) != 0, "not armed: receiver failsafe"},
        {(flags & QUAD_FLAG_RC_KILL) != 0, "not armed: kill switch"},
        {!e->throttle_low, "not armed: throttle above 5 %"},
        {e->blind, "not armed: the gyro is silent or was not at rest"},
        {(flags & QUAD_FLAG_ANGLE_LIMIT) != 0, "not armed: tilted"},
        {e->low_battery, "not armed: low battery"},
        {e->unfit != NULL, e->unfit},
        {e->test.until_us != 0, "not armed: a motor is tested"},
        {quad_gains_sets_up(&e->gains), "not armed: the set-up is being written"},
    };
    for (size_t i = 0; i < sizeof why / sizeof why[0]; i++) {
        if (why[i].holds) {
            return why[i].text;
        }
    }
    return NULL;
}

bool quad_endpoint_may_test_now(const quad_endpoint *e)
{
    const uint16_t unsafe = QUAD_FLAG_RC_KILL | QUAD_FLAG_RC_FAILSAFE | QUAD_FLAG_ANGLE_LIMIT | QUAD_FLAG_ARMED;
    return !e->armed && e->throttle_low && !e->blind && e->unfit == NULL && (e->last_flags & unsafe) == 0 &&
           e->began_us >= e->flew_us + STANDS_US;
}

/* One motor, slowly, and no longer than an excitation may go on without being asked for again. */
static uint8_t test_motor(quad_endpoint *e, const mavlink_command_long_t *m, uint64_t now_us)
{
    const float throttle = 0.01f * m->param3;
    const bool one = m->param1 == 1.0f || m->param1 == 2.0f || m->param1 == 3.0f || m->param1 == 4.0f;
    if (!one || m->param2 != PERCENT || !(throttle >= 0.0f && throttle <= QUAD_TEST_THROTTLE) ||
        !(m->param4 >= 0.0f) || !(m->param5 <= 1.0f)) {
        return DENIED;
    }
    if (!quad_endpoint_may_test_now(e)) {
        return NOT_NOW;
    }
    const float long_us = fminf(1e6f * m->param4, (float)QUAD_DEAD_MAN_US);
    e->test.motor = (size_t)m->param1 - 1;
    e->test.throttle = throttle;
    e->test.until_us = throttle > 0.0f && long_us >= 1.0f ? now_us + (uint64_t)long_us : 0;
    return ACCEPTED;
}

static uint8_t arm(quad_endpoint *e, float wanted)
{
    if (wanted == 0.0f) {
        e->armed = false;
        return ACCEPTED;
    }
    if (wanted != 1.0f) {
        return UNSUPPORTED;
    }
    if (!e->settings.may_arm) {
        return DENIED;
    }
    if (quad_endpoint_unarmed(e) != NULL) {
        return NOT_NOW;
    }
    e->armed = true;
    return ACCEPTED;
}

static void take_command(quad_endpoint *e, uint64_t now_us)
{
    mavlink_command_long_t m;
    mavlink_msg_command_long_decode(&e->rx, &m);
    if (for_us(e, m.target_system, m.target_component)) {
        uint8_t result = UNSUPPORTED;
        if (m.command == ARM_DISARM) {
            result = arm(e, m.param1);
        } else if (m.command == MOTOR_TEST) {
            result = test_motor(e, &m, now_us);
        }
        quad_put_ack(e, m.command, result);
    }
}

static void take_time(quad_endpoint *e, uint64_t now_us)
{
    mavlink_timesync_t m;
    mavlink_msg_timesync_decode(&e->rx, &m);
    if (m.tc1 == 0) {
        quad_put_time(e, now_us, m.ts1);
    }
}

static void use(quad_endpoint *e, uint64_t now_us)
{
    const mavlink_message_t *m = &e->rx;
    if (m->sysid == e->settings.system && m->compid == e->settings.component) {
        return; /* our own echo is no sign of life */
    }
    e->counts.frames++;
    if (m->sysid == QUAD_BRIDGE_SYSTEM && m->compid == QUAD_BRIDGE_COMPONENT) {
        quad_gains_heard(&e->gains, now_us); /* a ground station beside it does not watch the gains */
    }
    switch (m->msgid) {
    case MAVLINK_MSG_ID_TIMESYNC:
        take_time(e, now_us);
        break;
    case MAVLINK_MSG_ID_QUAD_EXCITATION:
        take_excitation(e, now_us);
        break;
    case MAVLINK_MSG_ID_QUAD_GAINS:
        take_gains(e, now_us);
        break;
    case MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
        take_list(e);
        break;
    case MAVLINK_MSG_ID_PARAM_REQUEST_READ:
        take_read(e);
        break;
    case MAVLINK_MSG_ID_PARAM_SET:
        take_set(e);
        break;
    case MAVLINK_MSG_ID_COMMAND_LONG:
        take_command(e, now_us);
        break;
    default: /* HEARTBEAT and others: a sign of life */
        break;
    }
}

/* Whether the well signed frame in `rx` is from before this start (the headers allow a minute), or
 * of a time that cannot be. */
static bool wrong_time(const quad_endpoint *e)
{
    uint64_t time = 0;
    for (size_t i = 6; i > 0; i--) {
        time = (time << 8) | e->rx.signature[i];
    }
    return e->link.signing != NULL &&
           (time < e->settings.signing_time || time > QUAD_SIGNING_LAST);
}

static void count_refused(quad_endpoint *e)
{
    if ((e->rx.incompat_flags & MAVLINK_IFLAG_SIGNED) == 0) {
        e->counts.unsigned_frames++;
    } else if (e->signing.last_status == MAVLINK_SIGNING_STATUS_BAD_SIGNATURE) {
        e->counts.forged++;
    } else {
        e->counts.replayed++;
    }
}

void quad_endpoint_receive(quad_endpoint *e, const uint8_t *bytes, size_t count, uint64_t now_us)
{
    mavlink_signing_streams_t streams = e->streams;
    uint64_t time = e->signing.timestamp;
    for (size_t i = 0; i < count; i++) {
        switch (mavlink_frame_char_buffer(&e->rx, &e->link, bytes[i], NULL, NULL)) {
        case MAVLINK_FRAMING_OK:
            if (wrong_time(e)) { /* the headers have noted it by now */
                e->streams = streams;
                e->signing.timestamp = time;
                e->counts.replayed++;
            } else {
                use(e, now_us);
                streams = e->streams;
                time = e->signing.timestamp;
            }
            break;
        case MAVLINK_FRAMING_BAD_CRC:
            e->counts.bad++;
            break;
        case MAVLINK_FRAMING_BAD_SIGNATURE:
            count_refused(e);
            break;
        default:
            break;
        }
    }
}
