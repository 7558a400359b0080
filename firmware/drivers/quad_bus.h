/* The I2C bus that the chips' drivers speak over; the board brings it (boards/stm32f405/i2c.c, or a test).
 * A call waits for its transfer, for a bounded time; false where the chip does not answer. */
#ifndef QUAD_BUS_H
#define QUAD_BUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct {
    bool (*write)(uint8_t device, const uint8_t *bytes, size_t count);
    /* Write one byte, a register or a command, then read without letting the bus go. */
    bool (*read)(uint8_t device, uint8_t reg, uint8_t *bytes, size_t count);
} quad_bus;

#endif
