/* The sets of parameters: in force, the copy that is being written, the last confirmed one.
 *
 * The bridge opens a copy, writes it, commits it with a checksum and confirms it after a watch, whose
 * time passes in flight only: what has not flown for half of it cannot be confirmed. Without its
 * word, or with a dead link, the confirmed set comes back by itself: a bad set never outlives the
 * link that brought it. No frames here. */
#ifndef QUAD_GAINS_H
#define QUAD_GAINS_H

#include <stdbool.h>
#include <stdint.h>

#include "quad_parameters.h"

#define QUAD_LINK_DEAD_US 2000000 /* silence after which the bridge counts as gone */

typedef struct {
    float active[QUAD_PARAMETERS];
    float good[QUAD_PARAMETERS]; /* to be kept in flash when `confirmations` has changed */
    float copy[QUAD_PARAMETERS];
    bool staging, watching;
    uint8_t transaction, confirmed; /* the running one, and the last that was confirmed */
    uint32_t confirmations;
    uint64_t watch_us, flown_us; /* the set on trial: its watch, and the time it has flown */
    uint64_t ticked_us, heard_us;
} quad_gains;

/* One QUAD_GAINS message. */
typedef struct {
    uint8_t action, transaction;
    uint16_t watch_ms;
    uint32_t checksum;
} quad_gains_request;

/* `stored`: QUAD_PARAMETERS values kept from before; where one of them does not fit, or NULL: the table's, all.
 * False where they are there and do not fit. */
bool quad_gains_init(quad_gains *gains, const float *stored);

/* A frame of the bridge has come. */
void quad_gains_heard(quad_gains *gains, uint64_t now_us);

/* PARAM_SET: into the copy, or into force where none is open; nothing where it does not fit. */
void quad_gains_write(quad_gains *gains, size_t index, float value);

/* Whether the copy, or what is on trial, changes how the aircraft is built (QUAD_SET_UP). */
bool quad_gains_sets_up(const quad_gains *gains);

/* What PARAM_VALUE says. */
float quad_gains_shown(const quad_gains *gains, size_t index);

/* Act on a request. Returns a QUAD_GAINS_RESULT; `answered` is the action that was understood. */
uint8_t quad_gains_act(quad_gains *gains, const quad_gains_request *request, uint64_t now_us,
                       uint8_t *answered);

/* Once a cycle, `flying` where it is armed and the throttle is up. True where the confirmed set has
 * come back by itself; then `result` says why. */
bool quad_gains_tick(quad_gains *gains, uint64_t now_us, bool flying, uint8_t *result);

/* A QUAD_GAINS_PHASE. */
uint8_t quad_gains_phase(const quad_gains *gains);

/* CRC-32 (IEEE) over a set as float32, little endian, in the order of the index. */
uint32_t quad_gains_checksum(const float set[QUAD_PARAMETERS]);

#endif
