/*
 * calib_bno055.h - BNO055 on I2C: accelerometer and gyroscope, no fusion. As it starts, its gyroscope has a new value
 * 100 times a second, and a program that asks as often gets some twice. The interface of an IMU:
 *
 *   CALIB_IMU_STEPS, _WAIT_MS   steps of its start, and the pause after each
 *   calib_imu_start(step)       one of them; false begins the start anew
 *   calib_imu_alive()           once a second: whether it still is what its start made of it
 *   calib_imu_read(f, w)        six axes, m/s^2 and rad/s; false when nothing came
 *   CALIB_IMU_FULL_...          readings from there on are at the end of its range
 */
#ifndef CALIB_IMU_H
#define CALIB_IMU_H

#include "calib_i2c.h"

#ifndef CALIB_IMU_ADDRESS
#define CALIB_IMU_ADDRESS 0x28
#endif
#define CALIB_IMU_KIND 1
#define CALIB_IMU_STEPS 4
#define CALIB_IMU_WAIT_MS 50
#define CALIB_IMU_FULL_MPS2 39.0f  /* +-4 g */
#define CALIB_IMU_FULL_RADPS 34.8f /* +-2000 deg/s */
#define CALIB_IMU_MODE 0x05        /* both sensors, no magnetometer, no fusion, which would set its own bandwidths */

static bool calib_imu_write(uint8_t place, uint8_t value) {
    return calib_i2c_write(CALIB_IMU_ADDRESS, place, value);
}

static bool calib_imu_start(uint8_t step) {
    switch (step) {
    case 0: /* registers of page 0; the right chip, out of its reset; configuration mode */
        return calib_imu_write(0x07, 0) && calib_i2c_says(CALIB_IMU_ADDRESS, 0x00, 0xA0) &&
               calib_imu_write(0x3D, 0x00);
    case 1: /* normal power; m/s^2 and rad/s */
        return calib_imu_write(0x3E, 0x00) && calib_imu_write(0x3B, 0x02);
    case 2: /* page 1: +-4 g and 62.5 Hz, +-2000 deg/s and 47 Hz, of which new values come 125 and 400 times a second */
        return calib_imu_write(0x07, 1) && calib_imu_write(0x08, 0x0D) && calib_imu_write(0x0A, 0x18) &&
               calib_i2c_says(CALIB_IMU_ADDRESS, 0x0A, 0x18) && calib_imu_write(0x07, 0);
    default: /* accelerometer and gyroscope */
        return calib_i2c_says(CALIB_IMU_ADDRESS, 0x3B, 0x02) && calib_imu_write(0x3D, CALIB_IMU_MODE);
    }
}

static bool calib_imu_alive(void) {
    return calib_i2c_says(CALIB_IMU_ADDRESS, 0x3D, CALIB_IMU_MODE) && calib_i2c_says(CALIB_IMU_ADDRESS, 0x3B, 0x02);
}

static bool calib_imu_read(float *force, float *rate) {
    uint8_t bytes[18], i; /* the magnetometer lies between the two */
    if (!calib_i2c_read(CALIB_IMU_ADDRESS, 0x08, sizeof bytes, bytes)) {
        return false;
    }
    for (i = 0; i < 3; i++) {
        const uint8_t *f = bytes + 2 * i, *w = bytes + 12 + 2 * i;
        force[i] = (float)(int16_t)(uint16_t)(f[0] | (uint16_t)((uint16_t)f[1] << 8)) * 0.01f;
        rate[i] = (float)(int16_t)(uint16_t)(w[0] | (uint16_t)((uint16_t)w[1] << 8)) * (1.0f / 900.0f);
    }
    return true;
}

#endif /* CALIB_IMU_H */
