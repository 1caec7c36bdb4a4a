#ifndef WIRE_STUB_H
#define WIRE_STUB_H
#include <stddef.h>
#include <stdint.h>

struct TwoWire {
    void begin();
    void setClock(uint32_t hz);
    void beginTransmission(uint8_t address);
    size_t write(uint8_t value);
    size_t write(const uint8_t *values, size_t count);
    uint8_t endTransmission();
    uint8_t endTransmission(bool stop);
    uint8_t requestFrom(uint8_t address, uint8_t count);
    int read();
};
extern TwoWire Wire;
#endif
