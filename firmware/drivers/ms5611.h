/* MS5611: pressure and temperature with 24 bits, ten milliseconds a conversion, so that it is asked every few
 * cycles. Commands and compensation: MS5611-01BA03 datasheet (ENG 0002P1), pages 7 to 12; the PROM's
 * checksum: application note AN520. NOT YET RUN ON A BOARD. */
#ifndef MS5611_H
#define MS5611_H

#include "quad_bus.h"

typedef struct {
    uint16_t prom[8]; /* factory, C1 to C6, serial number and CRC */
    uint32_t pressure, temperature;
    bool started, converts_pressure;
    uint64_t asked_us;
} ms5611;

/* True where the chip's calibration was read whole; the chip needs 3 ms after power-on. */
bool ms5611_start(ms5611 *chip, const quad_bus *bus);

/* Once a cycle: fetches a conversion that is done and begins the next one. Writes hPa and deg C, NaN until
 * both were measured or where the chip does not answer. */
void ms5611_cycle(ms5611 *chip, const quad_bus *bus, uint64_t now_us, float *hpa, float *celsius);

/* Second-order compensation of the raw D1 (pressure) and D2 (temperature). */
void ms5611_compensate(const uint16_t prom[8], uint32_t pressure, uint32_t temperature, float *hpa,
                       float *celsius);

/* CRC-4 of the PROM, as its last word's low 4 bits should be. */
uint8_t ms5611_crc(const uint16_t prom[8]);

#endif
