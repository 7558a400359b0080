/* The control law and the mixer, once a cycle. Body FRD, SI, commands normalised. No frames here.
 *
 * C1: rate reference = kp (angle reference - angle), limited. C2: u = kp e + ki int(e dt) -
 * kd d(rate)/dt with e = rate reference - rate; the derivative of the measured rate behind a
 * first-order filter (backward Euler), the integral clamped, u limited. Excitation is added to the
 * angle reference, behind C1's limit to the rate reference, behind C2's limit to U2..U4, or, up, to U1.
 *
 * An axis flies LQR_SHARE of a state feedback and the rest of the cascade; 0 is the cascade alone.
 * Its model of the axis is
 *
 *     drive' = (gain u(t - delay) - drive) / lag,  rate' = drive - damping rate,  angle' = rate
 *     u = k_angle e - k_rate rate - k_drive drive + k_integral xi,  e = reference - angle, xi' = e
 *
 * An observer corrects the model's rate by the measured one; from there the states are predicted
 * over the delay (whole cycles) with the commands that are under way (Franklin, Powell, Workman,
 * Digital Control of Dynamic Systems, 3rd ed., 8.2 and 8.6). Only one integral runs.
 *
 * Below QUAD_LOW_THROTTLE no torque is commanded and all begins anew with the next cycle: standing on the ground,
 * nothing answers, and what is added up there would act at take-off. With AIRMODE that ends once the throttle has
 * been at QUAD_AIRBORNE_THROTTLE, until it has landed or is disarmed.
 *
 * Where the motors cannot give all four commands, yaw is given up first, then throttle, roll and pitch last
 * (quad_mix); an integrator does not run further towards what was not given.
 *
 * Where SAG_EXP is not 0, u is multiplied by that power of (reference voltage / voltage). */
#ifndef QUAD_CONTROL_H
#define QUAD_CONTROL_H

#include "quad_endpoint.h"
#include "quad_filter.h"

#define QUAD_AIRBORNE_THROTTLE 0.25f
#define QUAD_LONGEST_DELAY 15 /* cycles, of the state feedback's model */

typedef struct {
    float drive, rate, integral; /* rad/s^2, rad/s; of the command, so no gain divides it */
    float commands[QUAD_LONGEST_DELAY + 1]; /* newest first */
} quad_feedback;

typedef struct {
    float integral[3], slope[3], last_rate[3]; /* state of C2 */
    float not_given[3]; /* U2..U4 that the motors could not give in the last cycle */
    quad_notch d_notch; /* notch before kd */
    float d_rate[3];
    float yaw_reference;
    float volts; /* low-passed; 0 before the first measurement */
    bool started, airborne;
    quad_feedback feedback[3];
} quad_control;

/* What the sticks ask for: roll, pitch, yaw -1..1 (FRD: right side down, nose up, nose to the
 * right), throttle 0..1. */
typedef struct {
    float roll, pitch, yaw, throttle;
} quad_sticks;

typedef struct {
    float angle;       /* rad, of a full stick */
    float yaw_rate;    /* rad/s, of a full stick */
    float angle_limit; /* rad: beyond it QUAD_FLAG_ANGLE_LIMIT is set */
} quad_ranges;

void quad_control_init(quad_control *control);

/* Fill the record's references, U1..U4 and motors from its gains, flags, excitation, gyro and
 * attitude; adds the flags SATURATED and ANGLE_LIMIT. `volts` NaN where not measured. */
void quad_control_cycle(quad_control *control, const quad_ranges *ranges,
                        const quad_sticks *sticks, float volts, float period_s,
                        quad_cycle *record);

/* Motors (4), idle..1, of U1..U4 (4): eq. (7) with limits. Where not all fits, yaw is what the motors have left,
 * then the throttle moves, and only where roll and pitch alone need more than the motors have are both made smaller by one
 * factor. Writes what is given of U1..U4 (4); true where that is not all. Of no number all motors are 0. */
bool quad_mix(const float control[4], float idle, float motors[4], float given[4]);

#endif
