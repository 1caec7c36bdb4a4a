/* The parts of the Arduino core that the sketch uses, for compiling it without one, and for running it here. */
#ifndef ARDUINO_STUB_H
#define ARDUINO_STUB_H
#include <stddef.h>
#include <stdint.h>

#define OUTPUT 1
#define HIGH 1
#define LOW 0
#define LED_BUILTIN 13

void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t value);
void analogWrite(uint8_t pin, int value);
void delay(unsigned long ms);
unsigned long micros(void);

struct SerialPort {
    void begin(unsigned long baud);
    size_t write(uint8_t value);
};
extern SerialPort Serial;

void setup();
void loop();
#endif
