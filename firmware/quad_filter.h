/* Filters of a vector (3) in floats: a low-pass, a notch. No frames and no control here. */
#ifndef QUAD_FILTER_H
#define QUAD_FILTER_H

/* Second-order low-pass in terms of its change, so that a constant passes exactly in floats:
 * change = b (x + 2 x' + x'' - 4 out) + c change', out = out' + change. */
typedef struct {
    float hz, b, c;
    float last[3], before[3], change[3], out[3];
} quad_low_pass;

/* out = b (x - turn x' + x'') + b turn out' - (2 b - 1) out'', turn = 2 cos(2 pi hz sample_s). */
typedef struct {
    float hz, width_hz, b, turn;
    float last[3], before[3]; /* past inputs */
    float late[3], later[3];  /* past outputs */
} quad_notch;

/* Butterworth, bilinear and not prewarped: its delay at low frequency is the continuous filter's. Costs
 * nothing where the cut-off is as before. */
void quad_low_pass_tune(quad_low_pass *filter, float hz, float sample_s);

void quad_low_pass_settle(quad_low_pass *filter, const float value[3]);

/* Take a value; the result is in `out`. */
void quad_low_pass_pass(quad_low_pass *filter, const float value[3]);

/* A notch at `hz`, `width_hz` between its points at -3 dB (Orfanidis, Introduction to Signal Processing, 11.3.2);
 * off at 0 Hz and where its upper point is not below nine tenths of half the sampling rate. */
void quad_notch_tune(quad_notch *notch, float hz, float width_hz, float sample_s);

void quad_notch_settle(quad_notch *notch, const float value[3]);

/* Replace a value by what passes. A notch that is switched on begins with what has passed, not with zeros. */
void quad_notch_pass(quad_notch *notch, float value[3]);

#endif
