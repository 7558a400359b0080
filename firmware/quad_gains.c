/* See quad_gains.h. */
#include "quad_gains.h"

#include <string.h>

#include "quad_mavlink.h"

static void copy_set(float *to, const float *from)
{
    memcpy(to, from, QUAD_PARAMETERS * sizeof(float));
}

/* True where `now` is later than `then` by more than `limit`; `now` may lie before `then`. */
static bool passed(uint64_t now_us, uint64_t then_us, uint64_t limit_us)
{
    return now_us > then_us && now_us - then_us > limit_us;
}

static void revert(quad_gains *gains)
{
    gains->staging = false;
    gains->watching = false;
    copy_set(gains->active, gains->good);
}

bool quad_gains_init(quad_gains *gains, const float *stored)
{
    memset(gains, 0, sizeof *gains);
    bool use = stored != NULL;
    for (size_t i = 0; use && i < QUAD_PARAMETERS; i++) {
        use = i == QUAD_LOOP_RATE_HZ || quad_parameter_fits(i, stored[i]);
    }
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        gains->good[i] = use ? stored[i] : quad_parameters[i].start;
    }
    copy_set(gains->active, gains->good);
    return use || stored == NULL;
}

void quad_gains_heard(quad_gains *gains, uint64_t now_us)
{
    gains->heard_us = now_us;
}

void quad_gains_write(quad_gains *gains, size_t index, float value)
{
    /* without a copy it may be one that came late: gains change as a whole or not at all */
    if (gains->staging && index < QUAD_PARAMETERS && quad_parameter_fits(index, value)) {
        gains->copy[index] = value;
    }
}

bool quad_gains_sets_up(const quad_gains *gains)
{
    const float *set = gains->staging ? gains->copy : gains->active;
    return memcmp(&set[QUAD_SET_UP], &gains->good[QUAD_SET_UP], (QUAD_PARAMETERS - QUAD_SET_UP) * sizeof(float)) != 0;
}

float quad_gains_shown(const quad_gains *gains, size_t index)
{
    return gains->staging ? gains->copy[index] : gains->active[index];
}

static uint8_t commit(quad_gains *gains, const quad_gains_request *request, uint64_t now_us)
{
    if (!gains->staging) { /* repeated after a lost answer */
        const bool same = request->checksum == quad_gains_checksum(gains->active);
        return same && gains->watching ? QUAD_GAINS_RESULT_OK : QUAD_GAINS_RESULT_CHECKSUM;
    }
    if (request->checksum != quad_gains_checksum(gains->copy)) {
        return QUAD_GAINS_RESULT_CHECKSUM;
    }
    copy_set(gains->active, gains->copy);
    gains->staging = false;
    gains->watching = true;
    gains->watch_us = 1000u * (uint64_t)request->watch_ms;
    gains->flown_us = 0;
    gains->ticked_us = now_us;
    return QUAD_GAINS_RESULT_OK;
}

static uint8_t confirm(quad_gains *gains)
{
    if (gains->watching && gains->flown_us < gains->watch_us / 2u) {
        return QUAD_GAINS_RESULT_NOT_FLOWN;
    }
    copy_set(gains->good, gains->active);
    if (gains->watching || gains->confirmed != gains->transaction) { /* else repeated after a lost answer */
        gains->confirmations++;
    }
    gains->confirmed = gains->transaction;
    gains->watching = false;
    return QUAD_GAINS_RESULT_OK;
}

static void open_copy(quad_gains *gains, uint8_t transaction)
{
    if (gains->transaction != transaction || !gains->staging) {
        copy_set(gains->copy, gains->active);
        gains->staging = true;
        gains->transaction = transaction;
    }
}

uint8_t quad_gains_act(quad_gains *gains, const quad_gains_request *request, uint64_t now_us,
                       uint8_t *answered)
{
    *answered = request->action;
    if (request->action > QUAD_GAINS_ACTION_REVERT) {
        *answered = QUAD_GAINS_ACTION_QUERY;
        return QUAD_GAINS_RESULT_WRONG_ID;
    }
    if (request->action == QUAD_GAINS_ACTION_QUERY) {
        return QUAD_GAINS_RESULT_OK;
    }
    if (request->action == QUAD_GAINS_ACTION_OPEN) {
        open_copy(gains, request->transaction);
        return QUAD_GAINS_RESULT_OK;
    }
    if (request->transaction != gains->transaction) {
        return QUAD_GAINS_RESULT_WRONG_ID;
    }
    switch (request->action) {
    case QUAD_GAINS_ACTION_COMMIT:
        return commit(gains, request, now_us);
    case QUAD_GAINS_ACTION_CONFIRM:
        return confirm(gains);
    default:
        revert(gains);
    }
    return QUAD_GAINS_RESULT_OK;
}

bool quad_gains_tick(quad_gains *gains, uint64_t now_us, bool flying, uint8_t *result)
{
    if (flying && gains->watching && now_us > gains->ticked_us) {
        gains->flown_us += now_us - gains->ticked_us;
    }
    gains->ticked_us = now_us;
    if (!gains->staging && !gains->watching) {
        return false;
    }
    if (passed(now_us, gains->heard_us, QUAD_LINK_DEAD_US)) {
        *result = QUAD_GAINS_RESULT_LINK_LOST;
    } else if (gains->watching && gains->flown_us > gains->watch_us) {
        *result = QUAD_GAINS_RESULT_NOT_CONFIRMED;
    } else {
        return false;
    }
    revert(gains);
    return true;
}

uint8_t quad_gains_phase(const quad_gains *gains)
{
    if (gains->staging) {
        return QUAD_GAINS_PHASE_STAGING;
    }
    return gains->watching ? QUAD_GAINS_PHASE_WATCH : QUAD_GAINS_PHASE_IDLE;
}

uint32_t quad_gains_checksum(const float set[QUAD_PARAMETERS])
{
    /* a table for four bits: bit by bit it would be most of the longest cycle */
    static const uint32_t nibble[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < QUAD_PARAMETERS; i++) {
        uint32_t bits;
        memcpy(&bits, &set[i], sizeof bits);
        for (unsigned shift = 0; shift < 32; shift += 8) { /* little endian on any machine */
            crc ^= (bits >> shift) & 0xFFu;
            crc = (crc >> 4) ^ nibble[crc & 15u];
            crc = (crc >> 4) ^ nibble[crc & 15u];
        }
    }
    return ~crc;
}
