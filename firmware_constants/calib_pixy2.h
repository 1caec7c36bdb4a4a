/*
 * calib_pixy2.h - the largest block of signature 1 of a Pixy2, on SPI as it comes, or with CALIB_PIXY2_I2C 1 on I2C.
 * The interface of a camera:
 *
 *   calib_camera_start()      once
 *   calib_camera_read(u, v)   the answer to the question before, and the next one; true once for each picture that
 *                             shows the marker. The answer is of the time of its question: a Pixy2 gives each
 *                             picture once, and says that it is busy until it has another
 *   CALIB_CAMERA_POLL_US      time between questions, four times what one takes
 */
#ifndef CALIB_CAMERA_H
#define CALIB_CAMERA_H

#ifndef CALIB_PIXY2_I2C
#define CALIB_PIXY2_I2C 0
#endif

#if CALIB_PIXY2_I2C
#include "calib_i2c.h"
#define CALIB_CAMERA_KIND 2
#define CALIB_CAMERA_ADDRESS 0x54
#define CALIB_CAMERA_POLL_US (1250000000UL / CALIB_I2C_HZ)
#else
#include <Arduino.h>
#include <SPI.h>
#define CALIB_CAMERA_KIND 1
#define CALIB_CAMERA_POLL_US 2000UL
#endif

#define CALIB_CAMERA_BLOCK 20  /* header of six bytes, block of fourteen */
#define CALIB_CAMERA_SEARCH 8  /* bytes that may lie before an answer: what was left of another */

static void calib_camera_start(void) {
#if !CALIB_PIXY2_I2C
    SPI.begin();
#endif
}

static void calib_camera_take(uint8_t *bytes, uint8_t count) {
    uint8_t i;
#if CALIB_PIXY2_I2C
    uint8_t came = Wire.requestFrom((uint8_t)CALIB_CAMERA_ADDRESS, count);
    for (i = 0; i < count; i++) {
        bytes[i] = i < came ? (uint8_t)Wire.read() : 0;
    }
#else
    for (i = 0; i < count; i++) {
        bytes[i] = SPI.transfer(0);
    }
#endif
}

static void calib_camera_ask(void) {
    static const uint8_t request[6] = {0xAE, 0xC1, 0x20, 0x02, 0x01, 0x01};
#if CALIB_PIXY2_I2C
    Wire.beginTransmission(CALIB_CAMERA_ADDRESS);
    Wire.write(request, sizeof request);
    Wire.endTransmission();
#else
    uint8_t i;
    for (i = 0; i < sizeof request; i++) {
        SPI.transfer(request[i]);
    }
#endif
}

static bool calib_camera_read(float *u_px, float *v_px) {
    uint8_t reply[CALIB_CAMERA_SEARCH + CALIB_CAMERA_BLOCK], from = 0, i;
    uint16_t sum = 0;
    bool good;
    const uint8_t *at;
#if !CALIB_PIXY2_I2C
    SPI.beginTransaction(SPISettings(2000000, MSBFIRST, SPI_MODE3));
#endif
    calib_camera_take(reply, sizeof reply);
    calib_camera_ask();
#if !CALIB_PIXY2_I2C
    SPI.endTransaction();
#endif
    while (from < CALIB_CAMERA_SEARCH && !(reply[from] == 0xAF && reply[from + 1] == 0xC1)) {
        from++;
    }
    at = reply + from;
    for (i = 6; i < CALIB_CAMERA_BLOCK; i++) {
        sum = (uint16_t)(sum + at[i]);
    }
    good = at[0] == 0xAF && at[1] == 0xC1 && at[2] == 0x21 && at[3] == CALIB_CAMERA_BLOCK - 6 &&
           sum == (uint16_t)(at[4] | (uint16_t)((uint16_t)at[5] << 8));
    if (good) {
        *u_px = (float)(uint16_t)(at[8] | (uint16_t)((uint16_t)at[9] << 8));
        *v_px = (float)(uint16_t)(at[10] | (uint16_t)((uint16_t)at[11] << 8));
    }
    return good;
}

#endif /* CALIB_CAMERA_H */
