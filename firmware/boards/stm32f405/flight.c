/* The firmware on an STM32F405 with the paper's chips: MPU-6050, HMC5883L and MS5611 on one I2C bus, a
 * receiver, four speed controllers. TIM2 paces the cycles. NOT YET RUN ON A BOARD: its loop ran in QEMU
 * without chips, its drivers on a PC against a model of the registers (test/registers.c). */
#include <math.h>
#include <string.h>

#include "board.h"
#include "esc.h"
#include "hmc5883.h"
#include "mpu6050.h"
#include "ms5611.h"
#include "quad_outbox.h"

/* The pilot's receiver, `make stm32 RECEIVER=...`: pulses on one wire or on six, or frames on UART5 */
#define PPM 0
#define PWM 1
#define SBUS 2
#define CRSF 3
#define IBUS 4
#ifndef RECEIVER
#define RECEIVER PPM
#endif
#define TELEMETRY 25u    /* cycles between two of CRSF's telemetry */
#define RETRY 25u        /* cycles between two attempts at a chip that does not answer */
#define SILENT 5u        /* cycles without the gyro before it is set up anew */
#define SLOW 5u          /* cycles between two readings of the compass */
#define REST_SAMPLES 1000u
#define REST_PART 250u   /* samples; a part of REST_SAMPLES */
#define REST_RAD_S 0.1f  /* between the largest and the smallest rate of a gyro at rest */
#define REST_MEAN_RAD_S 0.005f /* the same of its parts' means: what sways in a hand turns no faster */
#define TOLD_CYCLES 1250u

typedef struct {
    float least, most;
} range;

static struct {
    quad_firmware firmware;
    quad_inputs inputs;
    radio pulses;
    serial_radio serial;
    ms5611 barometer;
    float gauss[3];
    bool gyro_is, compass_is, barometer_is, rested;
    uint32_t silent; /* cycles without the gyro */
    struct {
        uint32_t count;
        float sum[3], part[3]; /* of all samples, of those of the present part */
        range rates[3], means[3];
    } rest;
    uint32_t kept; /* confirmations that serve_flash has seen to */
    uint64_t due_us;
} flight;

static void begin(void)
{
    float kept[QUAD_PARAMETERS];
    quad_store_prepare(&board_flash); /* all before the watchdog: an erasure takes seconds, a search some of its time */
    const bool stored = quad_store_load(&board_flash, kept), strange = !stored && !quad_store_blank(&board_flash);
    const bool bitten = board_start();
    uart_start();
    i2c_start();
    pulses_start();
    quad_firmware_settings settings = quad_firmware_defaults();
    settings.endpoint.aircraft = board_id();
    settings.endpoint.stored = stored ? kept : NULL;
#ifdef LOW_BATTERY_V
    settings.endpoint.low_battery_v = LOW_BATTERY_V;
#endif
    settings.endpoint.unreadable = strange;
    quad_firmware_init(&flight.firmware, &settings);
    if (RECEIVER >= SBUS) {
        serial_radio_start(&flight.serial, (serial_kind)(RECEIVER - SBUS));
        receiver_start((serial_kind)(RECEIVER - SBUS));
    } else {
        radio_start(&flight.pulses, RECEIVER == PPM);
    }
    if (bitten) {
        quad_put_text(&flight.firmware.endpoint, 2, "restarted by the watchdog");
    }
    flight.due_us = board_now_us();
    board_alive();
}

static void start_chips(void)
{
    flight.gyro_is = flight.gyro_is || mpu6050_start(&board_bus);
    if (flight.gyro_is) { /* the compass is behind it */
        flight.compass_is = flight.compass_is || hmc5883_start(&board_bus);
        flight.barometer_is = flight.barometer_is || ms5611_start(&flight.barometer, &board_bus);
    }
}

static void measure(uint64_t now_us)
{
    quad_sensors *s = &flight.inputs.sensors;
    const uint32_t cycle = flight.firmware.timing.cycles;
    if (cycle % RETRY == 0 && !flight.firmware.endpoint.armed) {
        start_chips();
    }
    if (flight.silent >= SILENT) { /* it may have lost its settings; in flight it has QUAD_BLIND_S for that */
        flight.gyro_is = mpu6050_start(&board_bus);
        flight.compass_is = flight.gyro_is && hmc5883_start(&board_bus); /* of one supply: it may be idle for ever */
        flight.silent = 0;
    }
    s->samples = 0;
    const bool spoke = flight.gyro_is && mpu6050_read(&board_bus, s) && s->samples > 0;
    flight.silent = spoke ? 0 : flight.silent + 1;
    if (cycle % SLOW == 0) {
        flight.gauss[0] = flight.gauss[1] = flight.gauss[2] = NAN;
        if (flight.compass_is) {
            hmc5883_read(&board_bus, flight.gauss);
        }
    }
    memcpy(s->slow.mag_gauss, flight.gauss, sizeof flight.gauss);
    s->slow.pressure_hpa = s->slow.temperature_c = NAN;
    if (flight.barometer_is) {
        ms5611_cycle(&flight.barometer, &board_bus, now_us, &s->slow.pressure_hpa,
                     &s->slow.temperature_c);
    }
    s->slow.battery_v = battery_pin_v();
}

static void hear_pilot(uint64_t now_us)
{
    radio_edge edge;
    for (uint32_t i = 0; i < 64 && pulses_edge(&edge); i++) {
        radio_take(&flight.pulses, edge, now_us);
    }
    if (RECEIVER >= SBUS) {
        receiver_hear(&flight.serial, now_us);
        flight.inputs.receiver = serial_radio_now(&flight.serial, now_us);
    } else {
        flight.inputs.receiver = radio_now(&flight.pulses, now_us);
    }
}

static void tell_pilot(uint32_t cycle)
{
    if (RECEIVER == CRSF && cycle % TELEMETRY == 0) {
        uint8_t bytes[SERIAL_LONGEST];
        const bool battery = cycle / TELEMETRY % 2 == 0;
        receiver_tell(bytes, battery ? serial_radio_battery(flight.firmware.control.volts, bytes)
                                     : serial_radio_attitude(flight.firmware.record.attitude, bytes));
    }
}

/* Widen it by a value, or begin it with one; its width. */
static float widened(range *r, float value, bool first)
{
    r->least = first ? value : fminf(r->least, value);
    r->most = first ? value : fmaxf(r->most, value);
    return r->most - r->least;
}

/* Count a sample as one at rest, or begin anew with the next one where it is not. */
static void rest_on(const float rate[3])
{
    const uint32_t count = flight.rest.count, part = count / REST_PART;
    const bool first = count == 0, whole = count % REST_PART == REST_PART - 1u;
    bool still = true;
    for (size_t i = 0; i < 3; i++) {
        float *sum = &flight.rest.part[i];
        flight.rest.sum[i] = first ? rate[i] : flight.rest.sum[i] + rate[i];
        *sum = count % REST_PART == 0 ? rate[i] : *sum + rate[i];
        still = widened(&flight.rest.rates[i], rate[i], first) <= REST_RAD_S && still;
        if (whole) {
            still = widened(&flight.rest.means[i], *sum / (float)REST_PART, part == 0) <= REST_MEAN_RAD_S && still;
        }
    }
    flight.rest.count = still ? count + 1 : 0;
}

/* The gyro's bias is its mean over a second in which it hardly moves; before, the firmware gets no sample
 * and so does not arm. */
static void take_rest(void)
{
    quad_sensors *s = &flight.inputs.sensors;
    for (size_t k = 0; k < s->samples && flight.rest.count < REST_SAMPLES; k++) {
        rest_on(s->gyro[k]);
    }
    s->samples = 0;
    if (flight.rest.count >= REST_SAMPLES) {
        float mean[3];
        for (size_t i = 0; i < 3; i++) {
            mean[i] = flight.rest.sum[i] / (float)REST_SAMPLES;
        }
        quad_mounting *mounting = &flight.firmware.settings.mounting;
        quad_to_board(mounting->axes, mean, mounting->gyro_bias);
        flight.rested = true;
        quad_put_text(&flight.firmware.endpoint, 6, "gyro at rest: its bias is measured");
    }
}

static void run_cycle(uint64_t due_us)
{
    float motors[4];
    const uint64_t began_us = board_now_us();
    measure(began_us);
    hear_pilot(began_us);
    if (!flight.rested) {
        take_rest();
    }
    quad_firmware_cycle(&flight.firmware, due_us, &flight.inputs, motors);
    const float *set = flight.firmware.record.gains;
    const bool usual = quad_setup_fault(set) != NULL;
    pulses_motors(motors, usual ? ESC_LEAST_US : set[QUAD_MOTORS_PULSE_MIN_US],
                  usual ? ESC_MOST_US : set[QUAD_MOTORS_PULSE_MAX_US]);
    tell_pilot(flight.firmware.timing.cycles);
    quad_firmware_timed(&flight.firmware, due_us, began_us, board_now_us());
    const quad_timing *t = &flight.firmware.timing;
    if (t->cycles % TOLD_CYCLES == 0) {
        quad_put_timing(&flight.firmware.endpoint, t->latest_us, t->longest_us, board_stack_used());
    }
    serve_send(&flight.firmware);
}

static void turn(void)
{
    const uint64_t now_us = board_now_us();
    serve_bridge(&flight.firmware, now_us);
    if (now_us >= flight.due_us) {
        const uint64_t period_us = 1000000u / flight.firmware.endpoint.settings.rate_hz;
        run_cycle(flight.due_us);
        board_alive();
        serve_flash(&flight.firmware, &flight.kept);
        const bool behind = now_us >= flight.due_us + period_us;
        flight.due_us = (behind ? now_us : flight.due_us) + period_us;
    }
}

int main(void)
{
    begin();
    for (;;) {
        turn();
    }
}
