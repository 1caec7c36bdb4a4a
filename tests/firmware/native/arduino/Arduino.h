/* The parts of the Arduino core that the sketch uses, for compiling it without one, and for running it here. */
#ifndef ARDUINO_STUB_H
#define ARDUINO_STUB_H
#include <stddef.h>
#include <stdint.h>

#define OUTPUT 1
#define INPUT_PULLUP 2
#define SDA 18
#define SCL 19
#define HIGH 1
#define LOW 0
#define LED_BUILTIN 13

void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t value);
int digitalRead(uint8_t pin);
void analogWrite(uint8_t pin, int value);
void delay(unsigned long ms);
void delayMicroseconds(unsigned us);
unsigned long micros(void);
unsigned long millis(void);

struct SerialPort {
    void begin(unsigned long baud);
    size_t write(uint8_t value);
    int available();
    int read();
};
extern SerialPort Serial;

void setup();
void loop();
#endif
