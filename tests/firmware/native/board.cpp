/*
 * A board around the sketch: BNO055 and Pixy2 on its bus, its serial port on stdout. The sensors follow a slow
 * swing; every 50th block of the camera is damaged, and from tick 30 to 39 the IMU does not answer.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "Arduino.h"
#include "Wire.h"

SerialPort Serial;
TwoWire Wire;

static unsigned long now;
static int ticks, at, length, place;
static uint8_t address, reply[32], registers[256];

void pinMode(uint8_t, uint8_t) {}
void digitalWrite(uint8_t, uint8_t) {}
void analogWrite(uint8_t, int value) {
    if (value < 0 || value > 255) {
        abort();
    }
}
void delay(unsigned long ms) {
    now += 1000 * ms;
    if (now > 100000000UL) {
        exit(9);
    }
}
unsigned long micros() { return now; }
int digitalRead(uint8_t) { return HIGH; }
void delayMicroseconds(unsigned) {}

void SerialPort::begin(unsigned long) {}
size_t SerialPort::write(uint8_t value) { return (size_t)(putchar(value) != EOF); }
int SerialPort::available() { return 0; }
int SerialPort::read() { return -1; }

void TwoWire::begin() {}
void TwoWire::setClock(uint32_t) {}
void TwoWire::beginTransmission(uint8_t to) {
    address = to;
    place = -1;
}
size_t TwoWire::write(uint8_t value) {
    if (place < 0) {
        place = value;
    } else if (address == 0x28) {
        registers[place] = value;
    }
    return 1;
}
size_t TwoWire::write(const uint8_t *, size_t count) { return count; }
uint8_t TwoWire::endTransmission() { return 0; }
uint8_t TwoWire::endTransmission(bool) { return ticks >= 30 && ticks < 40 && address == 0x28; }

static void put(int where, double value) {
    int16_t whole = (int16_t)lrint(value);
    reply[where] = (uint8_t)(uint16_t)whole;
    reply[where + 1] = (uint8_t)((uint16_t)whole >> 8);
}

uint8_t TwoWire::requestFrom(uint8_t from, uint8_t count) {
    double phi = 0.4 * sin(0.05 * ticks);
    memset(reply, 0, sizeof reply);
    at = 0;
    length = count;
    if (from == 0x28 && place == 0x08) {
        put(0, 981.0 * cos(phi));
        put(2, 981.0 * sin(phi));
    } else if (from == 0x28 && place != 0x14) {
        reply[0] = place ? registers[place] : 0xA0;
    } else if (from == 0x28) {
        put(4, -900.0 * 0.4 * 0.05 * 60.0 * cos(0.05 * ticks));
    } else {
        unsigned sum = 0;
        reply[0] = 0xAF;
        reply[1] = 0xC1;
        reply[2] = 0x21;
        reply[3] = 14;
        put(6, 1);
        put(8, 158 + 40 * sin(0.05 * ticks));
        put(10, 90);
        for (int i = 6; i < 20; i++) {
            sum += reply[i];
        }
        put(4, (double)(sum + (ticks % 50 == 49)));
    }
    return count;
}
int TwoWire::read() { return at < length ? reply[at++] : -1; }

int main(int argc, char **argv) {
    int wanted = argc > 1 ? atoi(argv[1]) : 200;
    setup();
    while (ticks < wanted) {
        now += 16667;
        loop();
        ticks++;
    }
    return 0;
}
