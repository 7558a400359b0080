/* See radio.h. */
#include "radio.h"

#include <string.h>

#define SHORTEST_US 800u
#define LONGEST_US 2200u
#define GAP_US 2700u /* between two PPM frames, at the least */
#define LEAST 5u     /* channels of a PPM frame: sticks and kill switch */
#define MOST 20u

void radio_start(radio *r, bool ppm)
{
    memset(r, 0, sizeof *r);
    r->ppm = ppm;
    r->next = RADIO_NO_FRAME;
}

static void heard(radio *r, size_t channel, float pulse_us, uint64_t now_us)
{
    r->receiver.pulse_us[channel] = pulse_us;
    r->heard_us[channel] = now_us + 1; /* 0: never */
}

static bool silent(const radio *r, size_t channel, uint64_t now_us)
{
    return r->heard_us[channel] == 0 || now_us > r->heard_us[channel] + RADIO_LOST_US;
}

/* A frame is accepted whole or not at all, and only with as many channels as all others: an edge too few or too many
 * would shift the rest, arming switch and throttle included. Two alike say how many, at first and after silence. */
static void take_gap(radio *r, uint64_t now_us)
{
    const size_t count = r->next;
    const bool whole = count >= LEAST && count <= MOST;
    if (silent(r, 0, now_us)) {
        r->channels = whole && count == r->last ? count : 0;
    }
    for (size_t i = 0; whole && count == r->channels && i < count && i < QUAD_CHANNELS; i++) {
        heard(r, i, r->frame_us[i], now_us);
    }
    r->last = count;
    r->next = 0;
}

static void take_ppm(radio *r, uint16_t width_us, uint64_t now_us)
{
    if (width_us >= GAP_US) {
        take_gap(r, now_us);
    } else if (width_us < SHORTEST_US || width_us > LONGEST_US) {
        r->next = RADIO_NO_FRAME; /* noise: wait for the next gap */
    } else if (r->next < RADIO_NO_FRAME) {
        if (r->next < QUAD_CHANNELS) { /* those beyond are counted only */
            r->frame_us[r->next] = width_us;
        }
        r->next++;
    }
}

void radio_take(radio *r, radio_edge edge, uint64_t now_us)
{
    if (edge.wire >= QUAD_CHANNELS || (r->ppm && (edge.wire > 0 || !edge.high))) {
        return;
    }
    const uint16_t width_us = (uint16_t)(edge.at_us - r->rose_us[edge.wire]);
    const bool falls = !edge.high && r->up[edge.wire];
    r->up[edge.wire] = edge.high;
    if (edge.high) {
        r->rose_us[edge.wire] = edge.at_us;
    }
    if (r->ppm) {
        take_ppm(r, width_us, now_us);
    } else if (falls && width_us >= SHORTEST_US && width_us <= LONGEST_US) {
        heard(r, edge.wire, width_us, now_us);
    }
}

quad_receiver radio_now(const radio *r, uint64_t now_us)
{
    quad_receiver receiver = r->receiver;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        const bool wire = !r->ppm && r->heard_us[i] > 0; /* a switch on a loose wire would stay as it was */
        receiver.failsafe = receiver.failsafe || ((i < 4 || wire) && silent(r, i, now_us));
    }
    return receiver;
}
