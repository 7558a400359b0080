/* The excitation in force: what may be added, for how long, and why it was dropped. No frames. */
#ifndef QUAD_EXCITATION_H
#define QUAD_EXCITATION_H

#include <stdbool.h>
#include <stdint.h>

#define QUAD_DEAD_MAN_US 500000 /* nothing outlives this, whatever validity it came with */

/* Largest values that are accepted. */
#define QUAD_LIMIT_ATTITUDE 0.52359878f /* rad, 30 deg */
#define QUAD_LIMIT_RATE 5.0f            /* rad/s */
#define QUAD_LIMIT_CONTROL 0.3f         /* normalised command */

typedef struct {
    float value[3]; /* FRD, in the unit of the injection; zero where nothing is added */
    uint8_t injection, seq;
    bool stale, refused;
    uint64_t since_us, valid_us;
} quad_excitation;

void quad_excitation_init(quad_excitation *excitation);

/* Take a set-point; injection NONE ends the excitation, one beyond its limits is refused. After a refusal all are,
 * up to the next NONE: an excitation that was dropped does not go on by itself. */
void quad_excitation_take(quad_excitation *excitation, const float value[3], uint8_t injection,
                          uint8_t seq, uint16_t valid_ms, uint64_t now_us);

/* Before each cycle: drop what is too old, and all where it is not `allowed`. Returns flags. */
uint16_t quad_excitation_tick(quad_excitation *excitation, bool allowed, uint64_t now_us);

#endif
