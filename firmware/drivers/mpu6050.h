/* MPU-6050: gyro +-500 deg/s and accelerometer +-8 g at 1 kHz, through its FIFO, so that no sample is
 * lost between two control cycles. Registers: RM-MPU-6000A-00 rev. 4.2. NOT YET RUN ON A BOARD. */
#ifndef MPU6050_H
#define MPU6050_H

#include "quad_attitude.h"
#include "quad_bus.h"

/* True where the chip is there and set up; it takes no time but the bus's. Call it again until it is. */
bool mpu6050_start(const quad_bus *bus);

/* Take the samples since the last call, oldest first, in chip axes. False, and no samples, where the chip
 * does not answer or more have come than fit: then its FIFO is emptied. */
bool mpu6050_read(const quad_bus *bus, quad_sensors *sensors);

/* One FIFO record (12 bytes: accelerometer, gyro, high byte first) in m/s^2 and rad/s. */
void mpu6050_convert(const uint8_t record[12], float gyro[3], float accel[3]);

#endif
