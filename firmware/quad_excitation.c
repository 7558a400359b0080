/* See quad_excitation.h. */
#include "quad_excitation.h"

#include <string.h>

#include "quad_mavlink.h"

static void drop(quad_excitation *excitation)
{
    memset(excitation->value, 0, sizeof excitation->value);
    excitation->injection = QUAD_INJECTION_NONE;
    excitation->seq = 0;
}

static float limit_of(uint8_t injection)
{
    switch (injection) {
    case QUAD_INJECTION_ATTITUDE:
        return QUAD_LIMIT_ATTITUDE;
    case QUAD_INJECTION_RATE:
        return QUAD_LIMIT_RATE;
    case QUAD_INJECTION_CONTROL:
    case QUAD_INJECTION_THRUST:
        return QUAD_LIMIT_CONTROL;
    default:
        return -1.0f; /* unknown: nothing fits */
    }
}

void quad_excitation_init(quad_excitation *excitation)
{
    memset(excitation, 0, sizeof *excitation);
}

void quad_excitation_take(quad_excitation *excitation, const float value[3], uint8_t injection,
                          uint8_t seq, uint16_t valid_ms, uint64_t now_us)
{
    const bool refused = excitation->refused && injection != QUAD_INJECTION_NONE;
    quad_excitation_init(excitation);
    excitation->refused = refused;
    if (refused || injection == QUAD_INJECTION_NONE) {
        return;
    }
    const float limit = limit_of(injection);
    for (int i = 0; i < 3; i++) {
        if (!(value[i] >= -limit && value[i] <= limit)) { /* NaN as well */
            excitation->refused = true;
            return;
        }
    }
    memcpy(excitation->value, value, sizeof excitation->value);
    excitation->injection = injection;
    excitation->seq = seq;
    excitation->since_us = now_us;
    excitation->valid_us = 1000u * (uint64_t)valid_ms;
    if (excitation->valid_us > QUAD_DEAD_MAN_US) {
        excitation->valid_us = QUAD_DEAD_MAN_US;
    }
}

uint16_t quad_excitation_tick(quad_excitation *excitation, bool allowed, uint64_t now_us)
{
    const uint64_t since_us = excitation->since_us;
    uint16_t flags = 0;
    if (excitation->injection != QUAD_INJECTION_NONE) {
        if (now_us > since_us && now_us - since_us > excitation->valid_us) {
            excitation->stale = true;
            drop(excitation);
        } else if (!allowed) {
            excitation->refused = true;
            drop(excitation);
        } else {
            flags |= QUAD_FLAG_EXCITATION;
        }
    }
    flags |= excitation->stale ? QUAD_FLAG_STALE_SETPOINT : 0u;
    flags |= excitation->refused ? QUAD_FLAG_EXCITATION_REFUSED : 0u;
    return flags;
}
