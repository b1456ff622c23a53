/* lx106 on QEMU's machine "sim": console and exit by simcall, cycles by CCOUNT. */
#include "bare.h"

#define SYS_EXIT 1
#define SYS_WRITE 4
#define STANDARD_OUTPUT 1

static int32_t simcall(int32_t number, int32_t first, int32_t second, int32_t third)
{
    register int32_t a2 __asm__("a2") = number;
    register int32_t a3 __asm__("a3") = first;
    register int32_t a4 __asm__("a4") = second;
    register int32_t a5 __asm__("a5") = third;

    __asm__ volatile("simcall" : "+a"(a2), "+a"(a3) : "a"(a4), "a"(a5) : "memory");
    return a2;
}

void machine_write(const void *bytes, uint32_t n)
{
    const uint8_t *p = bytes;

    while (n > 0) {
        int32_t done = simcall(SYS_WRITE, STANDARD_OUTPUT, (int32_t)p, (int32_t)n);

        if (done <= 0)
            machine_exit(97);
        p += done;
        n -= (uint32_t)done;
    }
}

void machine_exit(int status)
{
    simcall(SYS_EXIT, status, 0, 0);
}

void machine_begin(void)
{
}

uint32_t machine_ticks(void)
{
    uint32_t ticks;

    __asm__ volatile("rsr %0, ccount" : "=a"(ticks) : : "memory");
    return ticks;
}
