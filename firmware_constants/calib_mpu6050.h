/*
 * calib_mpu6050.h - MPU6050 on I2C, +-4 g, +-2000 deg/s, 44 Hz, a new value each ms; interface as in calib_bno055.h.
 */
#ifndef CALIB_IMU_H
#define CALIB_IMU_H

#include "calib_i2c.h"

#ifndef CALIB_IMU_ADDRESS
#define CALIB_IMU_ADDRESS 0x68
#endif
#define CALIB_IMU_KIND 2
#define CALIB_IMU_STEPS 4
#define CALIB_IMU_WAIT_MS 100
#define CALIB_IMU_FULL_MPS2 39.0f
#define CALIB_IMU_FULL_RADPS 34.8f

static bool calib_imu_start(uint8_t step) {
    switch (step) {
    case 0: /* the right chip; reset */
        return calib_i2c_says(CALIB_IMU_ADDRESS, 0x75, 0x68) && calib_i2c_write(CALIB_IMU_ADDRESS, 0x6B, 0x80);
    case 1: /* awake, on the gyroscope's clock */
        return calib_i2c_write(CALIB_IMU_ADDRESS, 0x6B, 0x01);
    case 2: /* filter, rate, ranges */
        return calib_i2c_write(CALIB_IMU_ADDRESS, 0x1A, 0x03) && calib_i2c_write(CALIB_IMU_ADDRESS, 0x19, 0) &&
               calib_i2c_write(CALIB_IMU_ADDRESS, 0x1B, 0x18) && calib_i2c_write(CALIB_IMU_ADDRESS, 0x1C, 0x08);
    default:
        return calib_i2c_says(CALIB_IMU_ADDRESS, 0x1C, 0x08) && calib_i2c_says(CALIB_IMU_ADDRESS, 0x1B, 0x18);
    }
}

static bool calib_imu_alive(void) {
    return calib_i2c_says(CALIB_IMU_ADDRESS, 0x6B, 0x01) && calib_i2c_says(CALIB_IMU_ADDRESS, 0x1B, 0x18);
}

static bool calib_imu_read(float *force, float *rate) {
    uint8_t bytes[14], i; /* the temperature lies between the two; high bytes first */
    if (!calib_i2c_read(CALIB_IMU_ADDRESS, 0x3B, sizeof bytes, bytes)) {
        return false;
    }
    for (i = 0; i < 3; i++) {
        const uint8_t *f = bytes + 2 * i, *w = bytes + 8 + 2 * i;
        force[i] = (float)(int16_t)(uint16_t)(f[1] | (uint16_t)((uint16_t)f[0] << 8)) * (9.80665f / 8192.0f);
        rate[i] = (float)(int16_t)(uint16_t)(w[1] | (uint16_t)((uint16_t)w[0] << 8)) * (0.0174532925f / 16.384f);
    }
    return true;
}

#endif /* CALIB_IMU_H */
