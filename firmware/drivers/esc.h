/* A motor command as the pulse that a speed controller takes. NOT YET RUN ON A BOARD. */
#ifndef ESC_H
#define ESC_H

#include <stdint.h>

#define ESC_LEAST_US 1000.0f /* pulse at rest, and at full throttle, by default */
#define ESC_MOST_US 2000.0f
#define ESC_PERIOD_US 2500u /* 400 Hz; SimonK takes a pulse in every period */

/* Pulse in us, `least_us` (stopped) to `most_us`, of a command 0..1; the least for what is no number. */
static inline uint16_t esc_pulse_us(float command, float least_us, float most_us)
{
    const float bounded = command > 0.0f ? (command < 1.0f ? command : 1.0f) : 0.0f;
    return (uint16_t)(least_us + 0.5f + (most_us - least_us) * bounded);
}

#endif
