/* See quad_firmware.h. */
#include "quad_firmware.h"

#include <math.h>
#include <string.h>

#include "quad_outbox.h"

#define SHORTEST_US 800.0f
#define LONGEST_US 2200.0f
#define SWITCHED_US 1750.0f
#define SWITCH_S 0.05f /* until the arming switch counts as thrown: longer than two frames of any receiver */

enum { ROLL, PITCH, THROTTLE, YAW, KILL, ARM, FREE, HOLD };

quad_firmware_settings quad_firmware_defaults(void)
{
    const quad_firmware_settings settings = {
        .endpoint = {.system = 1, .component = 1, .rate_hz = 250, .low_battery_v = 9.9f},
        .mounting = {.axes = {1, -2, -3}, .sample_s = 0.001f, .complementary_s = 5.0f},
        .ranges = {.angle = 0.52359878f, .yaw_rate = 1.5707963f, .angle_limit = 0.52359878f},
        .failsafe_off_us = 3000000,
    };
    return settings;
}

void quad_firmware_init(quad_firmware *f, const quad_firmware_settings *settings)
{
    memset(f, 0, sizeof *f);
    f->settings = *settings;
    f->settings.endpoint.stored = NULL;
    f->settings.endpoint.key = NULL;
    quad_endpoint_init(&f->endpoint, &settings->endpoint);
    quad_attitude_init(&f->attitude);
    quad_control_init(&f->control);
    quad_height_init(&f->height);
    f->period_s = 1.0f / (float)f->endpoint.settings.rate_hz;
    f->arm_switch = true; /* it must be seen off before it arms */
    const float *set = f->endpoint.gains.active;
    const size_t sticks[3] = {QUAD_RECEIVER_ROLL_CHANNEL, QUAD_RECEIVER_PITCH_CHANNEL, QUAD_RECEIVER_YAW_CHANNEL};
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        f->receiver.pulse_us[i] = 1000.0f;
    }
    for (size_t i = 0; i < 3; i++) {
        f->receiver.pulse_us[quad_setup_channel(set, sticks[i]) - 1] = 1500.0f;
    }
    f->arm_channel = quad_setup_channel(set, QUAD_RECEIVER_ARM_CHANNEL);
    if (f->arm_channel > 0) { /* not heard yet is not off */
        f->receiver.pulse_us[f->arm_channel - 1] = LONGEST_US;
    }
}

void quad_firmware_receive(quad_firmware *f, const uint8_t *bytes, size_t count, uint64_t now_us)
{
    quad_endpoint_receive(&f->endpoint, bytes, count, now_us);
}

size_t quad_firmware_send(quad_firmware *f, uint8_t *out, size_t room)
{
    return quad_endpoint_send(&f->endpoint, out, room);
}

static void hear_receiver(quad_firmware *f, const quad_receiver *now, uint64_t now_us)
{
    f->receiver.failsafe = now->failsafe;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        const float pulse = now->pulse_us[i];
        const size_t throttle = quad_setup_channel(f->endpoint.gains.active, QUAD_RECEIVER_THROTTLE_CHANNEL);
        if (pulse >= SHORTEST_US && pulse <= LONGEST_US && !(now->failsafe && i + 1 == throttle)) {
            f->receiver.pulse_us[i] = pulse;
        }
    }
    if (now->failsafe && !f->in_failsafe) {
        f->failsafe_since_us = now_us;
    }
    f->in_failsafe = now->failsafe;
    const uint32_t patience_us = f->settings.failsafe_off_us;
    if (f->in_failsafe && patience_us > 0 && now_us > f->failsafe_since_us &&
        now_us - f->failsafe_since_us > patience_us) {
        f->endpoint.armed = false;
    }
}

/* The pilot's switch: on arms where the throttle is low, off disarms whatever flies, but neither by one frame that was
 * heard wrong: pulses have no checksum, nor has SBUS. */
static void heed_switch(quad_firmware *f)
{
    const size_t channel = quad_setup_channel(f->endpoint.gains.active, QUAD_RECEIVER_ARM_CHANNEL);
    if (channel == 0 || f->in_failsafe) {
        return;
    }
    if (channel != f->arm_channel) { /* it is not known whether another switch was off */
        f->arm_channel = channel;
        f->arm_switch = true;
        f->arm_other = 0;
    }
    const bool on = f->receiver.pulse_us[channel - 1] > SWITCHED_US;
    f->arm_other = on == f->arm_switch ? 0 : f->arm_other + 1;
    if (f->arm_other < (uint32_t)(SWITCH_S / f->period_s)) {
        return;
    }
    f->arm_other = 0;
    f->arm_switch = on;
    if (!on) {
        f->endpoint.armed = false;
    } else if (!f->endpoint.armed) {
        const char *why = quad_endpoint_unarmed(&f->endpoint);
        f->endpoint.armed = why == NULL;
        if (why != NULL) {
            quad_put_text(&f->endpoint, 4, why);
        }
    }
}

/* Without a gyro nothing arms, and what flies is let fall before it turns over with a rate of long ago. */
static void heed_gyro(quad_firmware *f)
{
    const bool lost = (float)f->attitude.silent * f->period_s > QUAD_BLIND_S;
    if (lost && f->endpoint.armed) {
        f->endpoint.armed = false;
        quad_put_text(&f->endpoint, 2, "gyro silent: motors stopped");
    }
    f->endpoint.blind = lost || !f->attitude.settled;
}

static float stick(float pulse_us)
{
    return fmaxf(-1.0f, fminf(1.0f, (pulse_us - 1500.0f) / 500.0f));
}

static quad_sticks sticks_of(const quad_receiver *r)
{
    const float throttle = (r->pulse_us[THROTTLE] - 1000.0f) / 1000.0f;
    quad_sticks s = {0.0f, 0.0f, 0.0f, fmaxf(0.0f, fminf(1.0f, throttle))};
    if (!r->failsafe) {
        s.roll = stick(r->pulse_us[ROLL]);
        s.pitch = -stick(r->pulse_us[PITCH]);
        s.yaw = -stick(r->pulse_us[YAW]);
    }
    return s;
}

/* Channels as they are meant, behind them as they came. */
static quad_pilot pilot_of(const quad_firmware *f, const quad_receiver *meant, float throttle)
{
    const bool holds = f->height.holding;
    quad_pilot pilot = {.count = 2 * QUAD_CHANNELS, .failsafe = meant->failsafe};
    pilot.throttle_low = throttle < QUAD_LOW_THROTTLE;
    pilot.idle = holds ? f->height.throttle < QUAD_LOW_THROTTLE : pilot.throttle_low;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        pilot.pulse_us[i] = (uint16_t)(fmaxf(0.0f, meant->pulse_us[i]) + 0.5f);
        pilot.pulse_us[QUAD_CHANNELS + i] = (uint16_t)(f->receiver.pulse_us[i] + 0.5f);
    }
    pilot.kill = meant->pulse_us[KILL] > SWITCHED_US;
    return pilot;
}

/* The height mode has the throttle where the pilot's switch says so. */
static void heed_height(quad_firmware *f, const quad_receiver *meant, quad_sticks *sticks, float hpa)
{
    quad_cycle *r = &f->record;
    const bool armed = (r->flags & QUAD_FLAG_ARMED) != 0, lost = f->height.lost;
    quad_height_measure(&f->height, r->gains, r->accel, r->attitude, hpa, armed, f->period_s);
    sticks->throttle =
        quad_height_throttle(&f->height, r->gains, r->attitude, sticks->throttle, meant->failsafe,
                             meant->pulse_us[HOLD] > SWITCHED_US, armed, f->period_s);
    if (f->height.lost && !lost) {
        quad_put_text(&f->endpoint, 2, "barometer lost: the height is not held");
    }
    r->flags |= f->height.holding ? QUAD_FLAG_HOLD : 0u;
    r->flags |= f->height.landed ? QUAD_FLAG_LANDED : 0u;
}

void quad_firmware_cycle(quad_firmware *f, uint64_t start_us, const quad_inputs *inputs,
                         float motors[4])
{
    quad_cycle *r = &f->record;
    quad_slow slow = inputs->sensors.slow;
    quad_receiver meant;
    hear_receiver(f, &inputs->receiver, start_us);
    heed_switch(f);
    meant.failsafe = f->receiver.failsafe;
    quad_setup_pulses(f->endpoint.gains.active, f->receiver.pulse_us, meant.pulse_us);
    quad_sticks sticks = sticks_of(&meant);
    const quad_pilot pilot = pilot_of(f, &meant, sticks.throttle);
    quad_endpoint_begin_cycle(&f->endpoint, start_us, &pilot, r);
    slow.battery_v *= r->gains[QUAD_BATTERY_DIVIDER];
    quad_attitude_cycle(&f->attitude, &f->settings.mounting, &inputs->sensors, r->gains,
                        f->period_s, r->gyro, r->accel, r->attitude);
    memcpy(slow.mag_gauss, f->attitude.mag, sizeof slow.mag_gauss);
    heed_gyro(f);
    heed_height(f, &meant, &sticks, slow.pressure_hpa);
    quad_control_cycle(&f->control, &f->settings.ranges, &sticks, slow.battery_v, f->period_s,
                       r);
    quad_endpoint_test_motor(&f->endpoint, r);
    quad_endpoint_end_cycle(&f->endpoint, r, &pilot, &slow);
    quad_setup_outputs(r->gains, r->motors, motors);
}

void quad_firmware_timed(quad_firmware *f, uint64_t due_us, uint64_t began_us, uint64_t ended_us)
{
    quad_timing *t = &f->timing;
    const uint32_t late = began_us > due_us ? (uint32_t)(began_us - due_us) : 0;
    const uint32_t long_ = ended_us > began_us ? (uint32_t)(ended_us - began_us) : 0;
    const uint64_t period_us = 1000000u / f->endpoint.settings.rate_hz;
    t->cycles++;
    t->overruns += ended_us > due_us + period_us ? 1u : 0u;
    t->latest_us = late > t->latest_us ? late : t->latest_us;
    t->longest_us = long_ > t->longest_us ? long_ : t->longest_us;
    t->busy_us += long_;
}
