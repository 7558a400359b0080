/* How this aircraft is built, by its parameters from QUAD_SET_UP on: which channel of the receiver is what and how far
 * its sticks go, which output drives which motor. Pure. Board and sensors: quad_attitude.h. */
#ifndef QUAD_SETUP_H
#define QUAD_SETUP_H

#include <stdbool.h>

#include "quad_parameters.h"

#define QUAD_CHANNELS 9 /* roll, pitch, throttle, yaw, aux 1 (kill), aux 2 (arm), aux 3, aux 4 (height), aux 5 */

/* The receiver. Pulses are us, 1000..2000; a pitch pulse above the middle is nose down, a yaw pulse
 * above it nose to the left. A pulse outside 800..2200 is none: the last good one holds. */
typedef struct {
    float pulse_us[QUAD_CHANNELS];
    bool failsafe;
} quad_receiver;

/* Why nothing may arm with this set-up, in a text of STATUSTEXT's length; NULL where it may. */
const char *quad_setup_fault(const float *set);

/* A channel that a parameter names, from 1; 0: none. */
size_t quad_setup_channel(const float *set, size_t parameter);

/* Pulses as they came (QUAD_CHANNELS) into the order above, sticks from 1000 over 1500 to 2000; 1000 where there is no
 * channel for it. */
void quad_setup_pulses(const float *set, const float came_us[QUAD_CHANNELS], float meant_us[QUAD_CHANNELS]);

/* Commands of the motors (4) to those of the board's outputs. */
void quad_setup_outputs(const float *set, const float motors[4], float outputs[4]);

#endif
