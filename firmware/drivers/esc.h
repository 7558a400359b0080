/* A motor command as the pulse that a speed controller takes. NOT YET RUN ON A BOARD. */
#ifndef ESC_H
#define ESC_H

#include <stdint.h>

#define ESC_PERIOD_US 2500u /* 400 Hz; SimonK takes a pulse in every period */

/* Pulse in us, 1000 (stopped) to 2000, of a command 0..1; 1000 for what is no number. */
static inline uint16_t esc_pulse_us(float command)
{
    const float bounded = command > 0.0f ? (command < 1.0f ? command : 1.0f) : 0.0f;
    return (uint16_t)(1000.5f + 1000.0f * bounded);
}

#endif
