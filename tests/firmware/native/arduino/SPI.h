#ifndef SPI_STUB_H
#define SPI_STUB_H
#include <stdint.h>

#define MSBFIRST 1
#define SPI_MODE3 0x0C

struct SPISettings {
    SPISettings(uint32_t, uint8_t, uint8_t) {}
};

struct SPIClass {
    void begin();
    void beginTransaction(SPISettings settings);
    void endTransaction();
    uint8_t transfer(uint8_t value);
};
extern SPIClass SPI;
#endif
