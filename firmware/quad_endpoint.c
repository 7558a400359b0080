/* See quad_endpoint.h. The cycle and what is due when; frames in: quad_inbox.c, out: quad_outbox.c. */
#include "quad_endpoint.h"

#include <math.h>
#include <string.h>

#include "quad_outbox.h"
#include "quad_setup.h"

#define LOWEST_RATE_HZ 50
#define BATTERY_LAG_S 0.5f /* a motor that starts does not empty the battery */
#define STILL_RAD_S 0.5f /* rates of an aircraft that stands */
#define LIST_PER_CYCLE 2 /* parameters, so that a list does not delay the cycles */

static void start_signing(quad_endpoint *e, const quad_settings *settings)
{
    if (settings->key == NULL) {
        return;
    }
    memcpy(e->signing.secret_key, settings->key, sizeof e->signing.secret_key);
    e->signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
    e->signing.timestamp = e->settings.signing_time;
    e->link.signing = &e->signing;
    e->link.signing_streams = &e->streams;
}

void quad_endpoint_init(quad_endpoint *e, const quad_settings *settings)
{
    memset(e, 0, sizeof *e);
    e->settings = *settings;
    if (e->settings.rate_hz < LOWEST_RATE_HZ) {
        e->settings.rate_hz = LOWEST_RATE_HZ;
    }
    if (e->settings.signing_time > QUAD_SIGNING_LAST) {
        e->settings.signing_time = 0; /* flash that was erased: no time is known */
    }
    e->settings.stored = NULL;
    e->settings.key = NULL;
    e->armed = settings->armed;
    e->blind = true;
    e->volts = QUAD_MOST_VOLTS;
    e->list_next = QUAD_PARAMETERS;
    quad_excitation_init(&e->excitation);
    e->unreadable = !quad_gains_init(&e->gains, settings->stored) || settings->unreadable;
    e->gains.good[QUAD_LOOP_RATE_HZ] = (float)e->settings.rate_hz;
    e->gains.active[QUAD_LOOP_RATE_HZ] = (float)e->settings.rate_hz;
    memcpy(e->in_force, e->gains.active, sizeof e->in_force);
    start_signing(e, settings);
}

uint64_t quad_endpoint_signing_time(const quad_endpoint *e)
{
    return e->signing.timestamp;
}

/* The signature's clock goes on with the board's, and never back. */
static void keep_time(quad_endpoint *e, uint64_t now_us)
{
    const uint64_t time = e->settings.signing_time + now_us / 10u;
    if (time > e->signing.timestamp) {
        e->signing.timestamp = time;
    }
}

/* Whether a motor's test goes on in this cycle. */
static bool tests(quad_endpoint *e, uint64_t now_us, const quad_pilot *pilot)
{
    const bool stopped = e->armed || pilot->kill || pilot->failsafe || !pilot->throttle_low || e->tilted ||
                         e->test.until_us == 0 || now_us > e->test.until_us;
    if (stopped) {
        e->test.until_us = 0;
    }
    return !stopped;
}

void quad_endpoint_test_motor(const quad_endpoint *e, quad_cycle *record)
{
    if ((record->flags & QUAD_FLAG_MOTOR_TEST) != 0) {
        record->motors[e->test.motor] = e->test.throttle;
    }
}

static uint16_t late(const quad_endpoint *e, uint64_t now_us)
{
    const uint64_t period_us = 1000000u / e->settings.rate_hz;
    const bool overrun = e->cycle > 0 && now_us > e->began_us + period_us + period_us / 2u;
    return overrun ? QUAD_FLAG_OVERRUN : 0u;
}

static void revert_where_due(quad_endpoint *e, uint64_t now_us, bool flying)
{
    uint8_t result;
    if (quad_gains_tick(&e->gains, now_us, flying, &result)) {
        quad_put_gains_state(e, QUAD_GAINS_ACTION_QUERY, result);
        quad_put_text(e, 2, result == QUAD_GAINS_RESULT_LINK_LOST
                                ? "link lost: last good gains restored"
                                : "gains not confirmed: last good restored");
    }
}

void quad_endpoint_begin_cycle(quad_endpoint *e, uint64_t now_us, const quad_pilot *pilot,
                               quad_cycle *record)
{
    keep_time(e, now_us);
    revert_where_due(e, now_us, e->armed && !pilot->idle);
    memcpy(e->in_force, e->gains.active, sizeof e->in_force);
    e->armed = e->armed && !pilot->kill; /* nothing starts again by the switch's going back */
    const bool allowed = e->armed && !pilot->idle && !pilot->failsafe && !e->low_battery && !e->tilted;
    memset(record, 0, sizeof *record);
    record->flags = quad_excitation_tick(&e->excitation, allowed, now_us);
    record->flags |= e->armed ? QUAD_FLAG_ARMED : 0u;
    record->flags |= tests(e, now_us, pilot) ? QUAD_FLAG_MOTOR_TEST : 0u;
    record->flags |= pilot->kill ? QUAD_FLAG_RC_KILL : 0u;
    record->flags |= pilot->failsafe ? QUAD_FLAG_RC_FAILSAFE : 0u;
    record->flags |= late(e, now_us);
    record->time_us = now_us;
    record->cycle = e->cycle++;
    record->gains = e->in_force;
    record->injection = e->excitation.injection;
    record->excitation_seq = e->excitation.seq;
    memcpy(record->excitation, e->excitation.value, sizeof record->excitation);
    e->began_us = now_us;
}

/* A text for each flag that has come up, and once for a low battery. */
static void tell(quad_endpoint *e, uint16_t flags, bool low_battery)
{
    static const struct {
        uint16_t flag;
        const char *text;
    } texts[] = {
        {QUAD_FLAG_RC_KILL, "pilot: kill switch"},
        {QUAD_FLAG_RC_FAILSAFE, "receiver failsafe"},
        {QUAD_FLAG_STALE_SETPOINT, "excitation stale, dropped"},
        {QUAD_FLAG_EXCITATION_REFUSED, "excitation refused"},
    };
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) {
        if ((flags & texts[i].flag) != 0 && (e->last_flags & texts[i].flag) == 0) {
            quad_put_text(e, 4, texts[i].text);
        }
    }
    if (low_battery && !e->low_battery) {
        quad_put_text(e, 2, "low battery");
    }
    e->last_flags = flags;
}

static bool battery_is_low(quad_endpoint *e, float volts)
{
    if (volts >= 0.0f && volts < QUAD_MOST_VOLTS) { /* not NaN */
        const bool first = e->volts >= QUAD_MOST_VOLTS;
        e->volts += (first ? 1.0f : 1.0f / (BATTERY_LAG_S * (float)e->settings.rate_hz)) * (volts - e->volts);
    }
    return e->volts < e->settings.low_battery_v;
}

/* When it was last in motion. */
static void keep_still(quad_endpoint *e, const quad_cycle *r)
{
    const bool turns = !(fabsf(r->gyro[0]) + fabsf(r->gyro[1]) + fabsf(r->gyro[2]) < STILL_RAD_S);
    if (e->armed || (turns && e->test.until_us == 0)) {
        e->flew_us = r->time_us + 1;
    }
}

/* Whether the set-up allows arming; says once why not. */
static void check_setup(quad_endpoint *e, const quad_cycle *r)
{
    const char *fault = quad_setup_fault(r->gains);
    if (fault == NULL && e->unreadable && e->gains.confirmations == 0) { /* this one's axes may be another's */
        fault = "set-up: the stored one cannot be read, do it anew";
    }
    if (fault != NULL && e->unfit == NULL) {
        quad_put_text(e, 3, fault);
    }
    e->unfit = fault;
}

static bool due(const quad_endpoint *e, uint32_t cycle, uint32_t per_second)
{
    return cycle % (e->settings.rate_hz / per_second) == 0;
}

void quad_endpoint_end_cycle(quad_endpoint *e, const quad_cycle *record, const quad_pilot *pilot,
                             const quad_slow *slow)
{
    const bool low_battery = battery_is_low(e, slow->battery_v);
    quad_put_cycle(e, record);
    tell(e, record->flags, low_battery);
    e->low_battery = low_battery;
    e->throttle_low = pilot->throttle_low;
    e->tilted = (record->flags & QUAD_FLAG_ANGLE_LIMIT) != 0;
    keep_still(e, record);
    check_setup(e, record);
    if (due(e, record->cycle, 1)) {
        quad_put_heartbeat(e);
        quad_put_gains_state(e, QUAD_GAINS_ACTION_QUERY, QUAD_GAINS_RESULT_OK);
    }
    if (due(e, record->cycle, 10)) {
        quad_put_battery(e, slow);
    }
    if (due(e, record->cycle, 50)) {
        quad_put_receiver(e, record, pilot);
        quad_put_slow_sensors(e, record, slow);
    }
    for (int i = 0; i < LIST_PER_CYCLE && e->list_next < QUAD_PARAMETERS; i++) {
        quad_put_parameter(e, e->list_next++);
    }
}
