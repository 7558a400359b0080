/* A quadrotor for the desk: three independent axes with a motor lag, and the cascade C1, C2 that
 * flies them with the endpoint's gains. An example of a control cycle, and no physics to learn
 * from: that is the virtual STM32's part. */
#ifndef PLANT_H
#define PLANT_H

#include "quad_endpoint.h"

typedef struct {
    float rate[3], angle[3], torque[3]; /* truth: rad/s, rad, normalised command behind the lag */
    float integral[3], slope[3], last_rate[3], yaw_reference;
    uint32_t noise;
} plant;

void plant_init(plant *p);

/* One cycle of period_s: measure, control (fills the record), move. `throttle` is U1. */
void plant_cycle(plant *p, quad_cycle *record, float throttle, float period_s);

#endif
