/* plushsense verify --device on an Arduino: plush_device.h. Nothing else may write to Serial. */
#include "plush_device.h"

void plush_hook_begin(void)
{
    Serial.begin(115200);
}

uint8_t plush_hook_read(void)
{
    int byte;

    while ((byte = Serial.read()) < 0)
        yield();
    return (uint8_t)byte;
}

void plush_hook_write(uint8_t byte)
{
    Serial.write(&byte, 1);
}

void setup()
{
    plush_device_run();
}

void loop()
{
}
