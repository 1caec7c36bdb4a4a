/*
 * calib_i2c.h - registers of a chip on Wire, and a bus that comes back.
 */
#ifndef CALIB_I2C_H
#define CALIB_I2C_H

#include <Arduino.h>
#include <Wire.h>

#ifndef CALIB_I2C_HZ
#define CALIB_I2C_HZ 400000
#endif
/* What a byte may take on a bus that hangs; 0: for ever, where the watchdog ends it. */
#ifndef CALIB_I2C_LIMIT_US
#define CALIB_I2C_LIMIT_US 3000
#endif

/* Where the core can break off. No macro tells: Arduino's cores have the function, but not WIRE_HAS_TIMEOUT. */
template <typename Bus> static auto calib_i2c_limit(Bus *bus, uint32_t us) -> decltype(bus->setWireTimeout(us, true)) {
    bus->setWireTimeout(us, true);
}
static inline void calib_i2c_limit(void *, uint32_t) {}

/* A slave that holds the data line lets it go after nine clocks. */
static void calib_i2c_start(void) {
#if defined(SDA) && defined(SCL)
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
    Wire.begin();
    Wire.setClock(CALIB_I2C_HZ);
    calib_i2c_limit(&Wire, CALIB_I2C_LIMIT_US);
}

static bool calib_i2c_write(uint8_t address, uint8_t place, uint8_t value) {
    Wire.beginTransmission(address);
    Wire.write(place);
    Wire.write(value);
    return Wire.endTransmission() == 0;
}

/* Bytes from a register on; false when the bus failed. */
static bool calib_i2c_read(uint8_t address, uint8_t place, uint8_t count, uint8_t *bytes) {
    uint8_t i;
    Wire.beginTransmission(address);
    Wire.write(place);
    if (Wire.endTransmission(false) != 0 || Wire.requestFrom(address, count) != count) {
        return false;
    }
    for (i = 0; i < count; i++) {
        bytes[i] = (uint8_t)Wire.read();
    }
    return true;
}

static bool calib_i2c_says(uint8_t address, uint8_t place, uint8_t value) {
    uint8_t is;
    return calib_i2c_read(address, place, 1, &is) && is == value;
}

#endif /* CALIB_I2C_H */
