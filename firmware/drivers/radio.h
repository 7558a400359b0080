/* The pilot's receiver by its pulses' edges: nine channels on one wire (PPM), or a wire each (PWM). Pure: the
 * board's timer brings the edges. NOT YET RUN ON A BOARD. */
#ifndef RADIO_H
#define RADIO_H

#include "quad_firmware.h"

#define RADIO_LOST_US 100000u /* failsafe after so long without one of the first four channels or, of wires, of any
                               * that has been heard */

#define RADIO_NO_FRAME 1000u

/* An edge as a timer captured it. */
typedef struct {
    uint16_t at_us; /* on a counter that wraps */
    uint8_t wire;   /* from 0 */
    bool high;      /* it rose */
} radio_edge;

typedef struct {
    bool ppm;               /* wire 0 carries all channels, rising edge to rising edge */
    quad_receiver receiver; /* 0 where a channel has not come: no pulse */
    uint16_t rose_us[QUAD_CHANNELS];
    bool up[QUAD_CHANNELS]; /* it rose, and has not fallen since */
    float frame_us[QUAD_CHANNELS]; /* the present PPM frame */
    size_t next;                   /* channel of it, however many there are; RADIO_NO_FRAME before its gap */
    size_t last, channels;         /* in the last frame; in all frames, 0 if not known */
    uint64_t heard_us[QUAD_CHANNELS];
} radio;

void radio_start(radio *r, bool ppm);

/* Take an edge that was fetched at now_us. */
void radio_take(radio *r, radio_edge edge, uint64_t now_us);

/* What the receiver says now. */
quad_receiver radio_now(const radio *r, uint64_t now_us);

#endif
