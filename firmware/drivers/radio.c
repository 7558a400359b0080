/* See radio.h. */
#include "radio.h"

#include <string.h>

#define SHORTEST_US 800u
#define LONGEST_US 2200u
#define GAP_US 2700u /* between two PPM frames, at the least */
#define LEAST 5u     /* channels of a PPM frame: sticks and kill switch */

void radio_start(radio *r, bool ppm)
{
    memset(r, 0, sizeof *r);
    r->ppm = ppm;
    r->next = QUAD_CHANNELS + 1;
}

static void heard(radio *r, size_t channel, float pulse_us, uint64_t now_us)
{
    r->receiver.pulse_us[channel] = pulse_us;
    if (channel < 4) {
        r->heard_us[channel] = now_us + 1; /* 0: never */
    }
}

/* A frame is taken whole or not at all. */
static void take_gap(radio *r, uint64_t now_us)
{
    for (size_t i = 0; r->next <= QUAD_CHANNELS && r->next >= LEAST && i < r->next; i++) {
        heard(r, i, r->frame_us[i], now_us);
    }
    r->next = 0;
}

static void take_ppm(radio *r, uint16_t width_us, uint64_t now_us)
{
    if (width_us >= GAP_US) {
        take_gap(r, now_us);
    } else if (width_us < SHORTEST_US || width_us > LONGEST_US) {
        r->next = QUAD_CHANNELS + 1; /* noise: wait for the next gap */
    } else if (r->next < QUAD_CHANNELS) {
        r->frame_us[r->next++] = width_us; /* channels beyond those are nobody's */
    }
}

void radio_take(radio *r, radio_edge edge, uint64_t now_us)
{
    if (edge.wire >= QUAD_CHANNELS || (r->ppm && (edge.wire > 0 || !edge.high))) {
        return;
    }
    const uint16_t width_us = (uint16_t)(edge.at_us - r->rose_us[edge.wire]);
    if (edge.high) {
        r->rose_us[edge.wire] = edge.at_us;
    }
    if (r->ppm) {
        take_ppm(r, width_us, now_us);
    } else if (!edge.high && width_us >= SHORTEST_US && width_us <= LONGEST_US) {
        heard(r, edge.wire, width_us, now_us);
    }
}

quad_receiver radio_now(const radio *r, uint64_t now_us)
{
    quad_receiver receiver = r->receiver;
    for (size_t i = 0; i < 4; i++) {
        receiver.failsafe = receiver.failsafe || r->heard_us[i] == 0 ||
                            now_us > r->heard_us[i] + RADIO_LOST_US;
    }
    return receiver;
}
