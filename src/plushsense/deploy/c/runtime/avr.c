/* An ATmega1284 in simavr (simavr.c): bytes go in and out through registers that serve nothing else. */
#include "target.h"

#include <avr/io.h>

void target_write(const void *bytes, uint32_t n)
{
    const uint8_t *p = bytes;

    while (n-- > 0)
        GPIOR0 = *p++;
}

void target_read(void *bytes, uint32_t n)
{
    uint8_t *p = bytes;

    while (n-- > 0)
        *p++ = GPIOR1;
}

/* After main() and exit(), which leave the status in r24. */
__attribute__((naked, used, section(".fini1"))) void target_finish(void);
void target_finish(void)
{
    __asm__ volatile("out %0, r24" : : "I"(_SFR_IO_ADDR(GPIOR2)));
}
