/* Cortex-M4 on QEMU's machine mps2-an386: console and exit by semihosting, time by its first timer. */
#include "bare.h"

#define SYS_OPEN 0x01
#define SYS_WRITE 0x05
#define SYS_EXIT_EXTENDED 0x20
#define APPLICATION_EXIT 0x20026
#define WRITE_BINARY 5

/* A 32-bit timer that counts down at 25 MHz. SysTick would wrap after 24 bits. */
#define TIMER ((volatile uint32_t *)0x40000000)
#define TIMER_CONTROL 0
#define TIMER_VALUE 1
#define TIMER_RELOAD 2

extern uint32_t stack_top[];

static uint32_t semihosting(uint32_t operation, const void *block)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = block;

    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void machine_write(const void *bytes, uint32_t n)
{
    static uint32_t console;

    if (console == 0) {
        uint32_t open[3] = {(uint32_t) ":tt", WRITE_BINARY, 3};

        console = semihosting(SYS_OPEN, open) + 1;
    }
    {
        uint32_t block[3] = {console - 1, (uint32_t)bytes, n};

        if (semihosting(SYS_WRITE, block) != 0)
            machine_exit(97);
    }
}

void machine_exit(int status)
{
    uint32_t block[2] = {APPLICATION_EXIT, (uint32_t)status};

    semihosting(SYS_EXIT_EXTENDED, block);
}

void machine_begin(void)
{
    TIMER[TIMER_RELOAD] = UINT32_MAX;
    TIMER[TIMER_VALUE] = UINT32_MAX;
    TIMER[TIMER_CONTROL] = 1;
}

uint32_t machine_ticks(void)
{
    return UINT32_MAX - TIMER[TIMER_VALUE];
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    stack_top, (const void *)bare_start, (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap,
    (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap,
    (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap,
    (const void *)bare_trap, (const void *)bare_trap, (const void *)bare_trap,
};
