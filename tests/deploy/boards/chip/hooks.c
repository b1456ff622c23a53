/* The UARTs of QEMU's machines for plushsense verify --device, or standard input and output; and the program that serves
 * it. */
#include "plush_device.h"

#if defined(__arm__) /* mps2-an386: Arm's CMSDK UART */
#define UART ((volatile uint32_t *)0x40004000)

void plush_hook_begin(void)
{
    UART[4] = 16; /* the least divider of the clock */
    UART[2] = 3;  /* sends and receives */
}

uint8_t plush_hook_read(void)
{
    while ((UART[1] & 2u) == 0) {
    }
    return (uint8_t)UART[0];
}

void plush_hook_write(uint8_t byte)
{
    while ((UART[1] & 1u) != 0) {
    }
    UART[0] = byte;
}
#elif defined(__riscv) /* virt: a 16550 */
#define UART ((volatile uint8_t *)0x10000000)

void plush_hook_begin(void)
{
    UART[2] = 7; /* the queues of bytes, empty */
}

uint8_t plush_hook_read(void)
{
    while ((UART[5] & 1u) == 0) {
    }
    return UART[0];
}

void plush_hook_write(uint8_t byte)
{
    while ((UART[5] & 32u) == 0) {
    }
    UART[0] = byte;
}
#elif defined(__XTENSA__) /* lx60-nommu: a 16550 whose registers are words */
#define UART ((volatile uint32_t *)0x9d050020)

void plush_hook_begin(void)
{
    UART[2] = 7; /* the queues of bytes, empty */
}

uint8_t plush_hook_read(void)
{
    while ((UART[5] & 1u) == 0) {
    }
    return (uint8_t)UART[0];
}

void plush_hook_write(uint8_t byte)
{
    while ((UART[5] & 32u) == 0) {
    }
    UART[0] = byte;
}
#else
#include <stdio.h>
#include <stdlib.h>

void plush_hook_begin(void)
{
}

uint8_t plush_hook_read(void)
{
    int byte;

    fflush(stdout);
    byte = getchar();
    if (byte == EOF)
        exit(0);
    return (uint8_t)byte;
}

void plush_hook_write(uint8_t byte)
{
    putchar(byte);
}
#endif

int main(void)
{
    plush_device_run();
    return 0;
}
