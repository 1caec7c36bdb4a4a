/*
 * calib_example - the pipeline on an ATmega328P: BNO055 and Pixy2 on I2C, two pumps on pins 9 and 10.
 *
 * Keep this file in one folder with calib_constants.h, calib_pipeline.h and calib_selftest.h. Every tick goes out
 * on the serial port, 115200 baud, as a frame that `calib record` reads:
 *   A5 5A, length, payload, CRC-16 (0x1021 from 0xFFFF, over length and payload), all little-endian.
 * The pumps stay off until CALIB_EXAMPLE_MODE is set to something else than CALIB_MODE_OFF.
 */
#define CALIB_PROGMEM 1
#define CALIB_EXPECT_SCHEMA 3
#define CALIB_EXPECT_PUMP_HIGH 255

#include <Arduino.h>
#include <Wire.h>

#include "calib_selftest.h"

#ifndef CALIB_EXAMPLE_MODE
#define CALIB_EXAMPLE_MODE CALIB_MODE_OFF
#endif

static const uint8_t IMU_ADDRESS = 0x28, PIXY_ADDRESS = 0x54, PUMP_PINS[2] = {9, 10};
static const uint32_t TICK_US = 1000000000UL / CALIB_TICK_RATE_MHZ;

static calib_state state;
static calib_inputs in;
static calib_outputs out;
static uint16_t sequence;
static uint32_t next_us;

static void imu_write(uint8_t place, uint8_t value) {
    Wire.beginTransmission(IMU_ADDRESS);
    Wire.write(place);
    Wire.write(value);
    Wire.endTransmission();
}

/* Two or more little-endian numbers from a register on; false when the bus failed. */
static bool imu_read(uint8_t place, uint8_t count, int16_t *values) {
    uint8_t i;
    Wire.beginTransmission(IMU_ADDRESS);
    Wire.write(place);
    if (Wire.endTransmission(false) != 0 || Wire.requestFrom(IMU_ADDRESS, (uint8_t)(2 * count)) != 2 * count) {
        return false;
    }
    for (i = 0; i < count; i++) {
        uint8_t low = (uint8_t)Wire.read(), high = (uint8_t)Wire.read();
        values[i] = (int16_t)((uint16_t)low | (uint16_t)((uint16_t)high << 8));
    }
    return true;
}

static void read_imu(void) {
    int16_t force[2], rate[3];
    in.imu_read = imu_read(0x08, 2, force) && imu_read(0x14, 3, rate);
    if (in.imu_read) {
        in.ax_mps2 = (float)force[0] * 0.01f;
        in.ay_mps2 = (float)force[1] * 0.01f;
        in.gz_radps = (float)rate[2] * (1.0f / 900.0f);
    }
}

/* The largest block of signature 1, asked for in the tick before. */
static void read_marker(void) {
    static const uint8_t request[6] = {0xAE, 0xC1, 0x20, 0x02, 0x01, 0x01};
    uint8_t reply[20], i, count;
    in.marker_seen = 0;
    count = Wire.requestFrom(PIXY_ADDRESS, (uint8_t)20);
    for (i = 0; i < 20; i++) {
        reply[i] = i < count ? (uint8_t)Wire.read() : 0;
    }
    if (count == 20 && reply[0] == 0xAF && reply[1] == 0xC1 && reply[2] == 0x21 && reply[3] >= 14) {
        uint16_t sum = 0;
        for (i = 6; i < 20; i++) {
            sum = (uint16_t)(sum + reply[i]);
        }
        if (sum == (uint16_t)(reply[4] | (uint16_t)((uint16_t)reply[5] << 8))) {
            in.u_px = (float)(uint16_t)(reply[8] | (uint16_t)((uint16_t)reply[9] << 8));
            in.v_px = (float)(uint16_t)(reply[10] | (uint16_t)((uint16_t)reply[11] << 8));
            in.marker_seen = 1;
        }
    }
    Wire.beginTransmission(PIXY_ADDRESS);
    Wire.write(request, sizeof request);
    Wire.endTransmission();
}

static uint16_t checksum;

static void send_byte(uint8_t value) {
    uint8_t bit;
    checksum = (uint16_t)(checksum ^ (uint16_t)((uint16_t)value << 8));
    for (bit = 0; bit < 8; bit++) {
        checksum = (uint16_t)((checksum & 0x8000u) ? (uint16_t)(checksum << 1) ^ 0x1021u : checksum << 1);
    }
    Serial.write(value);
}

static void send_word(uint32_t value, uint8_t bytes) {
    while (bytes--) {
        send_byte((uint8_t)value);
        value >>= 8;
    }
}

static void send_float(float value) {
    send_word(calib_bits(value), 4);
}

static void send_tick(void) {
    uint8_t i;
    uint16_t sum;
    Serial.write((uint8_t)0xA5);
    Serial.write((uint8_t)0x5A);
    checksum = 0xFFFF;
    send_byte(78);
    send_word(CALIB_ID, 4);
    send_word(CALIB_TICK_RATE_MHZ, 4);
    send_word(sequence++, 2);
    send_byte((uint8_t)(in.marker_seen | (in.imu_read << 1)));
    send_byte(in.mode);
    send_float(in.u_px);
    send_float(in.v_px);
    send_float(in.ax_mps2);
    send_float(in.ay_mps2);
    send_float(in.gz_radps);
    for (i = 0; i < 2; i++) {
        send_float(in.reference[i]);
    }
    send_float(out.phi_rad);
    for (i = 0; i < 2; i++) {
        send_float(out.marker_m[i]);
    }
    for (i = 0; i < 2; i++) {
        send_float(out.head_m[i]);
    }
    for (i = 0; i < 2; i++) {
        send_float(out.q_m[i]);
    }
    for (i = 0; i < 2; i++) {
        send_float(out.pwm[i]);
    }
    send_word(out.flags, 2);
    sum = checksum;
    Serial.write((uint8_t)sum);
    Serial.write((uint8_t)(sum >> 8));
}

void setup() {
    Serial.begin(115200);
    Wire.begin();
    Wire.setClock(400000);
    pinMode(PUMP_PINS[0], OUTPUT);
    pinMode(PUMP_PINS[1], OUTPUT);
    analogWrite(PUMP_PINS[0], 0);
    analogWrite(PUMP_PINS[1], 0);
    imu_write(0x3D, 0x00); /* to set the units: configuration mode */
    delay(25);
    imu_write(0x3B, 0x02); /* m/s^2 and rad/s */
    imu_write(0x3D, 0x07); /* accelerometer, magnetometer and gyroscope, no fusion */
    delay(25);
    if (calib_selftest() != 0) {
        /* It does not compute what it should: stay here with the pumps off. */
        pinMode(LED_BUILTIN, OUTPUT);
        for (;;) {
            digitalWrite(LED_BUILTIN, HIGH);
            delay(100);
            digitalWrite(LED_BUILTIN, LOW);
            delay(100);
        }
    }
    calib_start(&state);
    next_us = micros();
}

void loop() {
    if ((int32_t)(micros() - next_us) < 0) {
        return;
    }
    next_us += TICK_US;
    read_imu();
    read_marker();
    in.mode = CALIB_EXAMPLE_MODE;
    if (in.mode == CALIB_MODE_ORIENTATION) {
        in.reference[0] = 0.3f;
    } else {
        calib_reference_point(0.0f, CALIB_REST_LENGTH_M + 0.01f, in.reference);
    }
    calib_tick(&state, &in, &out);
    analogWrite(PUMP_PINS[0], out.duty[0]);
    analogWrite(PUMP_PINS[1], out.duty[1]);
    send_tick();
}
