/*
 * calib_example - the pipeline on an ATmega328P: BNO055 and Pixy2 on I2C, two pumps on pins 9 and 10.
 *
 * Keep this file in one folder with calib_constants.h, calib_pipeline.h, calib_guard.h and calib_selftest.h. Every
 * tick goes out on the serial port, 115200 baud, as a frame that `calib record` reads:
 *   A5 5A, length, payload, CRC-16 (0x1021 from 0xFFFF, over length and payload), all little-endian.
 * The pumps stay off until CALIB_EXAMPLE_MODE is set to something else than CALIB_MODE_OFF. With
 * CALIB_EXAMPLE_HEARTBEAT 1 they moreover stop where no byte came from the computer for half a second. The byte 'C'
 * clears a fault that stays.
 *
 * A loop that does not come round, as on a bus that hangs, is stopped by the watchdog: pumps off within 125 ms, then
 * a reset. A sensor that does not answer, or is not what it should be, is started anew, ever more seldom.
 */
#define CALIB_PROGMEM 1
#define CALIB_EXPECT_SCHEMA 4
#define CALIB_EXPECT_PUMP_HIGH 255

#include <Arduino.h>
#include <Wire.h>
#if defined(__AVR__)
#include <avr/interrupt.h>
#include <avr/wdt.h>
#endif

#include "calib_guard.h"
#include "calib_selftest.h"

#ifndef CALIB_EXAMPLE_MODE
#define CALIB_EXAMPLE_MODE CALIB_MODE_OFF
#endif
#ifndef CALIB_EXAMPLE_HEARTBEAT
#define CALIB_EXAMPLE_HEARTBEAT 0
#endif

static const uint8_t IMU_ADDRESS = 0x28, PIXY_ADDRESS = 0x54, PUMP_PINS[2] = {9, 10};
static const uint32_t TICK_US = 1000000000UL / CALIB_TICK_RATE_MHZ;

static calib_state state;
static calib_inputs in;
static calib_outputs out;
static calib_guard guard;
static uint16_t sequence, silent;
static uint32_t next_us;

/* Why the watchdog stopped the loop: kept over its reset and told in every frame, until the supply goes. */
#define CHECK_OF(fault) ((uint16_t)(0xC5A0u ^ (uint16_t)((fault) * 257u)))
#if defined(__AVR__)
static uint8_t kept_fault __attribute__((section(".noinit")));
static uint16_t kept_check __attribute__((section(".noinit")));

/* Before anything else: a watchdog that is still on would end the start, and its period is short. */
void calib_early(void) __attribute__((naked, used, section(".init3")));
void calib_early(void) {
    MCUSR = 0;
    wdt_disable();
}

/* The loop did not come round: pumps off. The next time-out is a reset. */
ISR(WDT_vect) {
    digitalWrite(PUMP_PINS[0], LOW);
    digitalWrite(PUMP_PINS[1], LOW);
    kept_fault = CALIB_FAULT_WATCHDOG;
    kept_check = CHECK_OF(CALIB_FAULT_WATCHDOG);
}

static void watch(void) {
    cli();
    wdt_reset();
    WDTCSR = (uint8_t)(_BV(WDCE) | _BV(WDE));
    WDTCSR = (uint8_t)(_BV(WDIE) | _BV(WDE) | WDTO_120MS);
    sei();
}

static void watched(void) {
    wdt_reset();
    /* A time-out clears the interrupt; without it the pumps would stay on until the reset. */
    WDTCSR = (uint8_t)(WDTCSR | _BV(WDIE));
}
#else
static uint8_t kept_fault;
static void watch(void) {}
static void watched(void) {}
#endif

/* Whether a slave holds the data line: nine clocks make it let go. */
static void free_bus(void) {
#if defined(__AVR__)
    uint8_t i;
    pinMode(SDA, INPUT_PULLUP);
    pinMode(SCL, INPUT_PULLUP);
    for (i = 0; i < 9 && digitalRead(SDA) == LOW; i++) {
        pinMode(SCL, OUTPUT);
        digitalWrite(SCL, LOW);
        delayMicroseconds(5);
        pinMode(SCL, INPUT_PULLUP);
        delayMicroseconds(5);
    }
#endif
}

static void start_bus(void) {
    free_bus();
    Wire.begin();
    Wire.setClock(400000);
#if defined(WIRE_HAS_TIMEOUT)
    Wire.setWireTimeout(3000, true);
#endif
}

static bool imu_write(uint8_t place, uint8_t value) {
    Wire.beginTransmission(IMU_ADDRESS);
    Wire.write(place);
    Wire.write(value);
    return Wire.endTransmission() == 0;
}

static bool imu_bytes(uint8_t place, uint8_t count) {
    Wire.beginTransmission(IMU_ADDRESS);
    Wire.write(place);
    return Wire.endTransmission(false) == 0 && Wire.requestFrom(IMU_ADDRESS, count) == count;
}

/* Two or more little-endian numbers from a register on; false when the bus failed. */
static bool imu_read(uint8_t place, uint8_t count, int16_t *values) {
    uint8_t i;
    if (!imu_bytes(place, (uint8_t)(2 * count))) {
        return false;
    }
    for (i = 0; i < count; i++) {
        uint8_t low = (uint8_t)Wire.read(), high = (uint8_t)Wire.read();
        values[i] = (int16_t)((uint16_t)low | (uint16_t)((uint16_t)high << 8));
    }
    return true;
}

static bool imu_says(uint8_t place, uint8_t value) {
    return imu_bytes(place, 1) && (uint8_t)Wire.read() == value;
}

/* Steps of the IMU's start, with the ticks to wait after each; in the last one it measures. */
#define IMU_MEASURES 4
static uint8_t imu_step, imu_failed;
static uint16_t imu_wait, imu_pause = 6, imu_checked;

/* A step that failed begins the start anew after a pause, doubled each time up to ten seconds. */
static void imu_again(void) {
    imu_step = 0;
    imu_wait = imu_pause;
    imu_pause = imu_pause < 300 ? (uint16_t)(2 * imu_pause) : 600;
}

static void start_imu(void) {
    static const uint8_t waits[IMU_MEASURES] = {3, 3, 3, 3};
    bool done = false;
    if (imu_wait) {
        imu_wait--;
        return;
    }
    switch (imu_step) {
    case 0: /* the right chip, out of its reset; to set the units: configuration mode */
        done = imu_says(0x00, 0xA0) && imu_write(0x3D, 0x00);
        break;
    case 1: /* page 0, normal power */
        done = imu_write(0x07, 0x00) && imu_write(0x3E, 0x00);
        break;
    case 2: /* m/s^2 and rad/s */
        done = imu_write(0x3B, 0x02);
        break;
    default: /* accelerometer, magnetometer and gyroscope, no fusion */
        done = imu_says(0x3B, 0x02) && imu_write(0x3D, 0x07);
        break;
    }
    if (!done) {
        imu_again();
        return;
    }
    imu_wait = waits[imu_step];
    imu_step++;
    imu_failed = 0;
    imu_checked = 0;
}

static void read_imu(void) {
    int16_t force[2], rate[3];
    in.imu_read = 0;
    if (imu_step < IMU_MEASURES || imu_wait) {
        start_imu();
        return;
    }
    /* Once a second: it may have restarted without a word. */
    if (imu_checked++ == 60) {
        imu_checked = 0;
        if (!imu_says(0x3D, 0x07) || !imu_says(0x3B, 0x02)) {
            imu_again();
            return;
        }
        imu_pause = 6;
    }
    in.imu_read = imu_read(0x08, 2, force) && imu_read(0x14, 3, rate);
    if (in.imu_read) {
        in.ax_mps2 = (float)force[0] * 0.01f;
        in.ay_mps2 = (float)force[1] * 0.01f;
        in.gz_radps = (float)rate[2] * (1.0f / 900.0f);
    }
    imu_failed = in.imu_read ? 0 : (uint8_t)(imu_failed + 1u);
    if (imu_failed >= CALIB_GUARD_SAME || guard.imu_same >= CALIB_GUARD_SAME) {
        guard.imu_same = 0;
        imu_again();
    }
}

/* The largest block of signature 1, asked for in the tick before. */
static void read_marker(void) {
    static const uint8_t request[6] = {0xAE, 0xC1, 0x20, 0x02, 0x01, 0x01};
    uint8_t reply[26], i, count, from = 0;
    in.marker_seen = 0;
    count = Wire.requestFrom(PIXY_ADDRESS, (uint8_t)sizeof reply);
    for (i = 0; i < sizeof reply; i++) {
        reply[i] = i < count ? (uint8_t)Wire.read() : 0;
    }
    /* The reply may begin behind what was left of an earlier one. */
    while (from < sizeof reply - 20 && !(reply[from] == 0xAF && reply[from + 1] == 0xC1)) {
        from++;
    }
    if (reply[from] == 0xAF && reply[from + 1] == 0xC1 && reply[from + 2] == 0x21 && reply[from + 3] >= 14) {
        const uint8_t *at = reply + from;
        uint16_t sum = 0;
        for (i = 6; i < 20; i++) {
            sum = (uint16_t)(sum + at[i]);
        }
        if (sum == (uint16_t)(at[4] | (uint16_t)((uint16_t)at[5] << 8))) {
            in.u_px = (float)(uint16_t)(at[8] | (uint16_t)((uint16_t)at[9] << 8));
            in.v_px = (float)(uint16_t)(at[10] | (uint16_t)((uint16_t)at[11] << 8));
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
    send_byte(83);
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
    send_byte(out.duty[0]);
    send_byte(out.duty[1]);
    send_byte(guard.state);
    send_byte(guard.fault);
    send_byte(kept_fault);
    sum = checksum;
    Serial.write((uint8_t)sum);
    Serial.write((uint8_t)(sum >> 8));
}

/* Bytes of the computer: each is a sign of life. */
static void listen(void) {
    if (silent < 0xFFFFu) {
        silent++;
    }
    while (Serial.available() > 0) {
        if (Serial.read() == 'C') {
            calib_guard_clear(&guard);
        }
        silent = 0;
    }
    if (CALIB_EXAMPLE_HEARTBEAT && silent > CALIB_TICK_RATE_MHZ / 2000UL && guard.state == CALIB_RUN) {
        calib_guard_fault(&guard, CALIB_FAULT_HOST);
    }
}

void setup() {
    uint8_t i;
    for (i = 0; i < 2; i++) {
        digitalWrite(PUMP_PINS[i], LOW);
        pinMode(PUMP_PINS[i], OUTPUT);
    }
    calib_guard_start(&guard);
#if defined(__AVR__)
    if (kept_check != CHECK_OF(kept_fault)) {
        kept_fault = CALIB_FAULT_NONE;
    }
#endif
    Serial.begin(115200);
    if (calib_selftest() != 0 || calib_guard_selftest() != 0) {
        /* It does not compute what it should: stay here with the pumps off. */
        calib_guard_ready(&guard, 0);
        pinMode(LED_BUILTIN, OUTPUT);
        for (;;) {
            digitalWrite(LED_BUILTIN, HIGH);
            delay(100);
            digitalWrite(LED_BUILTIN, LOW);
            delay(100);
        }
    }
    watch();
    start_bus();
    calib_start(&state);
    calib_guard_ready(&guard, 1);
    next_us = micros();
}

void loop() {
    if ((int32_t)(micros() - next_us) < 0) {
        return;
    }
    watched();
    next_us += TICK_US;
    if ((int32_t)(micros() - next_us) > (int32_t)TICK_US) {
        /* More than two ticks behind: what was missed is not made up for. */
        calib_guard_fault(&guard, CALIB_FAULT_LATE);
        next_us = micros();
    }
    listen();
    read_imu();
    read_marker();
    if (CALIB_EXAMPLE_MODE == CALIB_MODE_ORIENTATION) {
        in.reference[0] = 0.3f;
    } else {
        calib_reference_point(0.0f, CALIB_REST_LENGTH_M + 0.01f, in.reference);
    }
    in.mode = calib_guard_mode(&guard, CALIB_EXAMPLE_MODE, in.reference);
    calib_tick(&state, &in, &out);
    calib_guard_tick(&guard, &state, &in, &out);
    analogWrite(PUMP_PINS[0], out.duty[0]);
    analogWrite(PUMP_PINS[1], out.duty[1]);
    send_tick();
}
