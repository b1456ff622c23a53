// As much of an Arduino core as PlushToy.ino and verify_device.ino ask for, on a clock of the test's own.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>

#define OUTPUT 1

uint32_t micros();
uint32_t millis();
void yield();
void pinMode(uint8_t pin, uint8_t mode);
void analogWrite(uint8_t pin, int value);
void tone(uint8_t pin, unsigned int hz, unsigned long ms = 0);
void noTone(uint8_t pin);
uint16_t touchRead(uint8_t pin);

struct Port {
    void begin(unsigned long baud);
    std::size_t setTxBufferSize(std::size_t bytes);
    int availableForWrite();
    std::size_t write(const uint8_t *bytes, std::size_t n);
    int available();
    int read();
};
extern Port Serial;
