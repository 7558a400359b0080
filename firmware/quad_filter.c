/* See quad_filter.h. */
#include "quad_filter.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

#define PI_F 3.14159265f
#define HIGHEST 0.45f /* share of the sampling rate */

void quad_low_pass_tune(quad_low_pass *filter, float hz, float sample_s)
{
    if (filter->hz == hz) {
        return;
    }
    const float k = PI_F * hz * sample_s, root = 1.41421356f * k;
    const float norm = 1.0f / (1.0f + root + k * k);
    filter->hz = hz;
    filter->b = k * k * norm;
    filter->c = (1.0f - root + k * k) * norm;
}

void quad_low_pass_settle(quad_low_pass *filter, const float value[3])
{
    for (size_t i = 0; i < 3; i++) {
        filter->last[i] = filter->before[i] = filter->out[i] = value[i];
        filter->change[i] = 0.0f;
    }
}

void quad_low_pass_pass(quad_low_pass *filter, const float value[3])
{
    for (size_t i = 0; i < 3; i++) {
        const float input = (value[i] - filter->out[i]) + 2.0f * (filter->last[i] - filter->out[i]) +
                            (filter->before[i] - filter->out[i]);
        filter->change[i] = filter->b * input + filter->c * filter->change[i];
        filter->out[i] += filter->change[i];
        filter->before[i] = filter->last[i];
        filter->last[i] = value[i];
    }
}

void quad_notch_tune(quad_notch *notch, float hz, float width_hz, float sample_s)
{
    if (notch->hz == hz && notch->width_hz == width_hz) {
        return;
    }
    const bool on = hz > 0.0f && (hz + 0.5f * width_hz) * sample_s < HIGHEST;
    notch->hz = hz;
    notch->width_hz = width_hz;
    notch->b = on ? 1.0f / (1.0f + tanf(PI_F * width_hz * sample_s)) : 1.0f;
    notch->turn = on ? 2.0f * cosf(2.0f * PI_F * hz * sample_s) : 0.0f;
}

void quad_notch_settle(quad_notch *notch, const float value[3])
{
    for (size_t i = 0; i < 3; i++) {
        notch->last[i] = notch->before[i] = notch->late[i] = notch->later[i] = value[i];
    }
}

void quad_notch_pass(quad_notch *notch, float value[3])
{
    const float b = notch->b, turn = notch->turn;
    for (size_t i = 0; i < 3; i++) {
        /* in terms of what differs from the input: a constant passes exactly */
        const float out = b < 1.0f ? value[i] - (1.0f - b) * (value[i] - notch->later[i]) +
                                         b * ((notch->before[i] - notch->later[i]) -
                                              turn * (notch->last[i] - notch->late[i]))
                                   : value[i];
        notch->before[i] = notch->last[i];
        notch->last[i] = value[i];
        notch->later[i] = notch->late[i];
        notch->late[i] = out;
        value[i] = out;
    }
}
