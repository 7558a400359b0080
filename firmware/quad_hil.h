/* The second line, for hardware in the loop: settings and sensors come from a simulation, motors go
 * back. Bytes in, messages out; no line is read or written here.
 *
 *     0xA5, kind, length (2), payload (length), CRC-16/CCITT-FALSE of kind to payload (2)
 *
 * All little endian. 'B': the settings of a flight, once, first. 'S': the inputs of a cycle.
 * 'M', back: its motors, and once before all others: the board listens. The layouts stand in quad_hil.c and in quad_bridge/virtual/hil.py. */
#ifndef QUAD_HIL_H
#define QUAD_HIL_H

#include "quad_firmware.h"

#define QUAD_HIL_LARGEST 640 /* bytes of a whole frame, settings or all samples */
#define QUAD_HIL_MOTORS 42   /* bytes of a frame with motors */

typedef struct {
    uint8_t bytes[QUAD_HIL_LARGEST];
    size_t count;
    uint32_t bad;
} quad_hil;

typedef enum { QUAD_HIL_NOTHING, QUAD_HIL_BOOT, QUAD_HIL_SENSORS } quad_hil_kind;

/* What a boot frame says. */
typedef struct {
    quad_firmware_settings settings; /* `stored` points to the values below */
    float stored[QUAD_PARAMETERS];
    bool lockstep; /* time is that of the sensor frames */
} quad_hil_boot;

/* Take one byte; says what it completes, and writes that one. Numbers that are not finite where
 * they must be, and frames of the wrong length, are counted as bad. */
quad_hil_kind quad_hil_take(quad_hil *hil, uint8_t byte, quad_hil_boot *boot,
                            uint64_t *time_us, quad_inputs *inputs);

/* Write a motor frame (QUAD_HIL_MOTORS bytes). */
void quad_hil_motors(const float motors[4], uint64_t time_us, const quad_timing *timing,
                     uint8_t out[QUAD_HIL_MOTORS]);

#endif
