/* See ms5611.h. */
#include "ms5611.h"

#include <math.h>

#define DEVICE 0x77u
#define READ_ADC 0x00u
#define RESET 0x1Eu
#define CONVERT_PRESSURE 0x48u /* oversampled 4096 times: 9.04 ms at the most */
#define CONVERT_TEMPERATURE 0x58u
#define READ_PROM 0xA0u
#define CONVERSION_US 9100u

uint8_t ms5611_crc(const uint16_t prom[8])
{
    uint32_t rest = 0;
    for (uint32_t i = 0; i < 16; i++) {
        const uint32_t word = i < 14 ? prom[i / 2] : prom[7] & 0xFF00u;
        rest ^= i % 2 == 0 ? word >> 8 : word & 0xFFu;
        for (int bit = 0; bit < 8; bit++) {
            rest = (rest & 0x8000u) != 0 ? (rest << 1) ^ 0x3000u : rest << 1;
        }
        rest &= 0xFFFFu;
    }
    return (uint8_t)(rest >> 12);
}

bool ms5611_start(ms5611 *chip, const quad_bus *bus)
{
    static const uint8_t reset = RESET;
    chip->started = chip->converts_pressure = false;
    chip->pressure = chip->temperature = 0;
    chip->asked_us = 0;
    uint32_t any = 0;
    for (size_t i = 0; i < 8; i++) {
        uint8_t bytes[2];
        if (!bus->read(DEVICE, (uint8_t)(READ_PROM + 2 * i), bytes, sizeof bytes)) {
            return false;
        }
        chip->prom[i] = (uint16_t)(((uint32_t)bytes[0] << 8) | bytes[1]);
        any |= chip->prom[i];
    }
    if (any == 0 || ms5611_crc(chip->prom) != (chip->prom[7] & 0xFu)) {
        bus->write(DEVICE, &reset, 1); /* for the next attempt, some ms from now */
        return false;
    }
    return true;
}

void ms5611_compensate(const uint16_t prom[8], uint32_t pressure, uint32_t temperature, float *hpa,
                       float *celsius)
{
    const int64_t difference = (int64_t)temperature - ((int64_t)prom[5] << 8);
    int64_t centi = 2000 + difference * prom[6] / (1 << 23); /* 0.01 deg C */
    int64_t offset = ((int64_t)prom[2] << 16) + prom[4] * difference / (1 << 7);
    int64_t scale = ((int64_t)prom[1] << 15) + prom[3] * difference / (1 << 8);
    if (centi < 2000) {
        const int64_t low = (centi - 2000) * (centi - 2000);
        int64_t less_offset = 5 * low / 2, less_scale = 5 * low / 4;
        if (centi < -1500) {
            const int64_t lower = (centi + 1500) * (centi + 1500);
            less_offset += 7 * lower;
            less_scale += 11 * lower / 2;
        }
        centi -= difference * difference / ((int64_t)1 << 31);
        offset -= less_offset;
        scale -= less_scale;
    }
    const int64_t pascal = ((int64_t)pressure * scale / (1 << 21) - offset) / (1 << 15);
    *hpa = (float)pascal / 100.0f;
    *celsius = (float)centi / 100.0f;
}

static void begin(ms5611 *chip, const quad_bus *bus, bool pressure, uint64_t now_us)
{
    const uint8_t command = pressure ? CONVERT_PRESSURE : CONVERT_TEMPERATURE;
    chip->started = bus->write(DEVICE, &command, 1);
    chip->converts_pressure = pressure;
    chip->asked_us = now_us;
}

void ms5611_cycle(ms5611 *chip, const quad_bus *bus, uint64_t now_us, float *hpa, float *celsius)
{
    if (!chip->started) {
        begin(chip, bus, false, now_us);
    } else if (now_us - chip->asked_us >= CONVERSION_US) {
        uint8_t bytes[3];
        const bool came = bus->read(DEVICE, READ_ADC, bytes, sizeof bytes);
        const uint32_t value =
            came ? ((uint32_t)bytes[0] << 16) | ((uint32_t)bytes[1] << 8) | bytes[2] : 0;
        if (chip->converts_pressure) {
            chip->pressure = value; /* 0 is also what a chip says that has not converted */
        } else {
            chip->temperature = value;
        }
        begin(chip, bus, !chip->converts_pressure, now_us);
    }
    if (chip->pressure == 0 || chip->temperature == 0) {
        *hpa = *celsius = NAN;
    } else {
        ms5611_compensate(chip->prom, chip->pressure, chip->temperature, hpa, celsius);
    }
}
