/* HMC5883L: compass, +-1.3 gauss at 75 Hz. Registers: Honeywell 900405 rev. E. NOT YET RUN ON A BOARD. */
#ifndef HMC5883_H
#define HMC5883_H

#include "quad_bus.h"

/* True where the chip is there and measures. */
bool hmc5883_start(const quad_bus *bus);

/* The last measurement in gauss, chip axes x, y, z; NaN where it does not answer. */
void hmc5883_read(const quad_bus *bus, float gauss[3]);

/* Registers 3 to 8 in gauss; NaN on an axis beyond its range. */
void hmc5883_convert(const uint8_t bytes[6], float gauss[3]);

#endif
