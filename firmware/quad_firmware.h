/* The whole firmware but its board: sensors in, motors out, bytes in and out. Start reading here.
 *
 * One struct holds all state; nothing is allocated, nothing is read or written but through the
 * calls below, and nothing blocks. All calls belong into one context (the control loop):
 *
 *     quad_firmware_receive(&f, bytes, count, now_us);     what the bridge's UART has brought
 *     quad_firmware_cycle(&f, start_us, &inputs, motors);  once per control cycle
 *     count = quad_firmware_send(&f, buffer, room);        to that UART's DMA
 *
 * Times are us since boot on a counter that never goes back. */
#ifndef QUAD_FIRMWARE_H
#define QUAD_FIRMWARE_H

#include "quad_control.h"
#include "quad_height.h"
#include "quad_setup.h"

typedef struct {
    quad_settings endpoint;
    quad_mounting mounting;
    quad_ranges ranges;
    uint32_t failsafe_off_us; /* motors stop after so long without the receiver; 0: never */
} quad_firmware_settings;

typedef struct {
    quad_sensors sensors;
    quad_receiver receiver;
} quad_inputs;

/* How well the loop keeps its time, in us of the board's timer. */
typedef struct {
    uint32_t cycles, overruns; /* overruns: ended after the next one was due */
    uint32_t latest_us;        /* worst start behind its due time */
    uint32_t longest_us;       /* worst time from start to end */
    uint64_t busy_us;          /* all of it */
} quad_timing;

typedef struct {
    quad_firmware_settings settings;
    quad_endpoint endpoint;
    quad_attitude attitude;
    quad_control control;
    quad_height height;
    quad_receiver receiver; /* last good pulses, as they came */
    quad_timing timing;
    quad_cycle record; /* the last cycle */
    float period_s;
    uint64_t failsafe_since_us;
    size_t arm_channel; /* the channel of `arm_switch` */
    uint32_t arm_other; /* cycles for which it has been heard other than `arm_switch` */
    bool in_failsafe, arm_switch;
} quad_firmware;

/* The settings of the board that is flown: 250 Hz, four samples a cycle, chip axes x forward,
 * y left, z up; the rest as in the paper. */
quad_firmware_settings quad_firmware_defaults(void);

void quad_firmware_init(quad_firmware *f, const quad_firmware_settings *settings);

/* Take bytes that arrived at now_us; what answers them waits for quad_firmware_send. */
void quad_firmware_receive(quad_firmware *f, const uint8_t *bytes, size_t count, uint64_t now_us);

/* Run the control cycle that starts at start_us; writes what the board's outputs give, 0..1. */
void quad_firmware_cycle(quad_firmware *f, uint64_t start_us, const quad_inputs *inputs,
                         float motors[4]);

/* Up to `room` bytes to send now; their number. */
size_t quad_firmware_send(quad_firmware *f, uint8_t *out, size_t room);

/* Note when a cycle that was due at due_us began and ended. */
void quad_firmware_timed(quad_firmware *f, uint64_t due_us, uint64_t began_us, uint64_t ended_us);

#endif
