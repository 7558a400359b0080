/* Height and climb by barometer and accelerometer, whether it has landed, and the mode that holds the height. SI, up is
 * positive. No frames here.
 *
 * A complementary filter of third order with the time constant T = CLIMB_FILTER_S (as in D. Titterton, J. Weston,
 * Strapdown Inertial Navigation Technology, 2nd ed., 13.4, on the vertical channel):
 *
 *     e = barometer - height
 *     height' = climb + 3/T e,  climb' = acceleration - bias + 3/T^2 e,  bias' = -1/T^3 e
 *
 * Disarmed, the height is 0 and the bias is what the accelerometer shows. A barometer is lost where it has said nothing
 * new for QUAD_BARO_S; then the climb fades with T.
 *
 * The mode: where the throttle stick was when it began is its middle (half of it on the ground). There the height is
 * held; beyond a deadband the stick asks for a climb, which ends at the ceiling and is slow near the ground.
 *
 *     climb reference = kp (height reference - height), limited
 *     U1 = (trim + kp e + ki int(e dt) - kd acceleration) / cos(tilt),  e = climb reference - climb
 *
 * with the throttle of the moment as trim and integral, the trim within half of the output limit about CLIMB_HOVER,
 * which it is from the ground. With the barometer lost in the mode the throttle is the last one with what the stick
 * moves from its middle, until the pilot leaves the mode. On the ground it is 0 until the stick asks for a climb. It
 * has landed when, asked to sink, it does not at the least throttle for a second, or in any mode when the throttle is
 * at nothing for that time. */
#ifndef QUAD_HEIGHT_H
#define QUAD_HEIGHT_H

#include <stdbool.h>
#include <stdint.h>

#define QUAD_BARO_S 0.5f

typedef struct {
    float height, climb, bias, acceleration; /* m above the take-off, m/s, m/s^2 */
    float hpa, ground_hpa, barometer;        /* last measured, at the take-off; the height of the last */
    float silent_s;                          /* since something new was measured */
    bool known;                              /* the barometer speaks */
    bool landed;
    bool holding, lost; /* the mode is on; it goes on without the barometer */
    float middle, trim, integral, reference, throttle;
    float pending_s; /* that what would change `landed` has held */
} quad_height;

void quad_height_init(quad_height *h);

/* Once a cycle: the estimate, from the specific force (3) and the attitude (3), FRD, and the pressure, NaN where there
 * is none. `set`: the parameters in force. */
void quad_height_measure(quad_height *h, const float *set, const float accel[3], const float attitude[3], float hpa,
                         bool armed, float period_s);

/* The throttle, 0..1, of the stick's, 0..1: in the mode (`wanted`) its own. `middle`: the stick counts as there. */
float quad_height_throttle(quad_height *h, const float *set, const float attitude[3], float stick, bool middle,
                           bool wanted, bool armed, float period_s);

#endif
