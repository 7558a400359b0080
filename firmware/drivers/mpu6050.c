/* See mpu6050.h. */
#include "mpu6050.h"

#define DEVICE 0x68u
#define RECORD 12u
#define RAD_S_PER_LSB (0.017453292f / 65.5f)
#define M_S2_PER_LSB (9.80665f / 4096.0f)

enum { /* sections 4.4 to 4.32 */
    SMPLRT_DIV = 0x19,
    CONFIG = 0x1A,
    GYRO_CONFIG = 0x1B,
    ACCEL_CONFIG = 0x1C,
    FIFO_EN = 0x23,
    INT_PIN_CFG = 0x37,
    USER_CTRL = 0x6A,
    PWR_MGMT_1 = 0x6B,
    FIFO_COUNT = 0x72,
    FIFO_R_W = 0x74,
    WHO_AM_I = 0x75
};

static bool put(const quad_bus *bus, uint8_t reg, uint8_t value)
{
    const uint8_t bytes[2] = {reg, value};
    return bus->write(DEVICE, bytes, sizeof bytes);
}

static bool empty(const quad_bus *bus)
{
    return put(bus, USER_CTRL, 0x04) && put(bus, USER_CTRL, 0x40);
}

bool mpu6050_start(const quad_bus *bus)
{
    uint8_t who = 0;
    return bus->read(DEVICE, WHO_AM_I, &who, 1) && who == DEVICE &&
           put(bus, PWR_MGMT_1, 0x01) &&   /* awake, clock of the x gyro */
           put(bus, CONFIG, 0x00) &&       /* gyro 256 Hz, accelerometer 260 Hz; 8 kHz */
           put(bus, SMPLRT_DIV, 7) &&      /* 8 kHz / 8 */
           put(bus, GYRO_CONFIG, 0x08) &&  /* +-500 deg/s */
           put(bus, ACCEL_CONFIG, 0x10) && /* +-8 g */
           put(bus, INT_PIN_CFG, 0x02) &&  /* the compass behind it joins the bus */
           put(bus, FIFO_EN, 0x78) && empty(bus);
}

static float word(const uint8_t *bytes)
{
    return (float)(int16_t)(uint16_t)(((uint32_t)bytes[0] << 8) | bytes[1]);
}

void mpu6050_convert(const uint8_t record[12], float gyro[3], float accel[3])
{
    for (size_t i = 0; i < 3; i++) {
        accel[i] = M_S2_PER_LSB * word(&record[2 * i]);
        gyro[i] = RAD_S_PER_LSB * word(&record[6 + 2 * i]);
    }
}

bool mpu6050_read(const quad_bus *bus, quad_sensors *sensors)
{
    uint8_t bytes[QUAD_MOST_SAMPLES * RECORD];
    sensors->samples = 0;
    if (!bus->read(DEVICE, FIFO_COUNT, bytes, 2)) {
        return false;
    }
    const size_t samples = (((size_t)bytes[0] << 8) | bytes[1]) / RECORD;
    if (samples > QUAD_MOST_SAMPLES) {
        empty(bus);
        return false;
    }
    if (samples > 0 && !bus->read(DEVICE, FIFO_R_W, bytes, samples * RECORD)) {
        empty(bus); /* half a record may be gone */
        return false;
    }
    for (size_t i = 0; i < samples; i++) {
        mpu6050_convert(&bytes[i * RECORD], sensors->gyro[i], sensors->accel[i]);
    }
    sensors->samples = samples;
    return true;
}
