/* See hmc5883.h. */
#include "hmc5883.h"

#include <math.h>

#define DEVICE 0x1Eu
#define LSB_PER_GAUSS 1090.0f
#define BEYOND (-4096)

bool hmc5883_start(const quad_bus *bus)
{
    /* configuration A: mean of 8, 75 Hz; B: +-1.3 gauss; mode: continuous */
    static const uint8_t settings[4] = {0x00, 0x78, 0x20, 0x00};
    uint8_t who[3];
    return bus->read(DEVICE, 10, who, sizeof who) && who[0] == 'H' && who[1] == '4' &&
           who[2] == '3' && bus->write(DEVICE, settings, sizeof settings);
}

void hmc5883_convert(const uint8_t bytes[6], float gauss[3])
{
    static const size_t axis[3] = {0, 2, 1}; /* the registers' order is x, z, y */
    for (size_t i = 0; i < 3; i++) {
        const int value = (int16_t)(uint16_t)(((uint32_t)bytes[2 * i] << 8) | bytes[2 * i + 1]);
        gauss[axis[i]] = value == BEYOND ? NAN : (float)value / LSB_PER_GAUSS;
    }
}

void hmc5883_read(const quad_bus *bus, float gauss[3])
{
    uint8_t bytes[6];
    if (bus->read(DEVICE, 3, bytes, sizeof bytes)) {
        hmc5883_convert(bytes, gauss);
    } else {
        gauss[0] = gauss[1] = gauss[2] = NAN;
    }
}
