// Runs the sketch for some seconds: run SECONDS [LINES]. Standard output: what it sends. Standard error: what changes on
// its pins. The clock of µs wraps after 3 s; 5 s and 9 s after the start the loop is held up, for 37 and 250 ms.
#include <Arduino.h>

#include <cstdlib>

#include "PlushToy.ino"

static uint64_t now = (uint64_t{1} << 32) - 3000000;
static const uint64_t start = now;
static std::FILE *coming;
static std::size_t length, heard;
static int pins[256]; // the value plus one; 0 before the first
static uint64_t free_at; // when the line is silent again

Port Serial;

#ifndef LOOK_US // that looking at the clock takes
#define LOOK_US 0
#endif

uint32_t micros() { return static_cast<uint32_t>(now += LOOK_US); }
uint32_t millis() { return static_cast<uint32_t>(now / 1000); }
void pinMode(uint8_t, uint8_t) {}
void analogWrite(uint8_t pin, int value)
{
    if (pins[pin] != value + 1)
        std::fprintf(stderr, "%u %u %d\n", static_cast<unsigned>((now - start) / 1000), pin, value);
    pins[pin] = value + 1;
}
void tone(uint8_t pin, unsigned int hz, unsigned long) { analogWrite(pin, static_cast<int>(hz)); }
void noTone(uint8_t pin) { analogWrite(pin, 0); }
uint16_t touchRead(uint8_t pin)
{
    now += 400;
    return static_cast<uint16_t>(100 * pin);
}
void Port::begin(unsigned long baud)
{
    if (baud != 115200)
        std::exit(3);
}
std::size_t Port::setTxBufferSize(std::size_t bytes) { return bytes; }
int Port::availableForWrite()
{
    return 1024 - static_cast<int>(free_at > now ? (free_at - now) * 11520 / 1000000 : 0);
}
std::size_t Port::write(const uint8_t *bytes, std::size_t n)
{
    free_at = (free_at > now ? free_at : now) + n * 1000000 / 11520;
    return std::fwrite(bytes, 1, n, stdout);
}
int Port::available()
{
    std::size_t come = static_cast<std::size_t>((now - start) * 11520 / 1000000);

    return static_cast<int>((come < length ? come : length) - heard);
}
int Port::read()
{
    heard++;
    return std::fgetc(coming);
}

int main(int argc, char **argv)
{
    uint64_t end = start + static_cast<uint64_t>(std::atof(argv[1]) * 1e6);
    bool held[2] = {};

    if (argc > 2) {
        coming = std::fopen(argv[2], "rb");
        std::fseek(coming, 0, SEEK_END);
        length = static_cast<std::size_t>(std::ftell(coming));
        std::rewind(coming);
    }
    setup();
    while (now < end) {
        loop();
        now += 333;
        if (!held[0] && now - start > 5000000) {
            held[0] = true;
            now += 37000;
        }
        if (!held[1] && now - start > 9000000) {
            held[1] = true;
            now += 250000;
        }
    }
}
