/* Cortex-M on QEMU's machines mps2-an386 and, of Armv8-M, mps2-an505: the call of semihosting, time by their first timer. */
#include "bare.h"

/* A 32-bit timer that counts down at 25 MHz, on mps2-an505 at 20 MHz. SysTick would wrap after 24 bits. */
#ifdef __ARM_ARCH_8M_MAIN__
#define TIMER ((volatile uint32_t *)0x50000000) /* its secure address */
#else
#define TIMER ((volatile uint32_t *)0x40000000)
#endif
#define TIMER_CONTROL 0
#define TIMER_VALUE 1
#define TIMER_RELOAD 2

extern uint32_t stack_top[];

uint32_t semihosting(uint32_t operation, const void *block)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = block;

    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
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
