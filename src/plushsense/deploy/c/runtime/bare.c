/* Start, output, exit, instruction counter and stack depth of an emulated machine. */
#include "bare.h"

extern int main(void);
extern uint32_t stack_low[]; /* of the linker script */

#define PAINT UINT32_C(0xa5c3965a)
#define TRAPPED 98

static uint8_t waiting[32768];
static uint32_t n_waiting;
static uint32_t painted_from;

void target_write(const void *bytes, uint32_t n)
{
    const uint8_t *p = bytes;

    while (n-- > 0) {
        waiting[n_waiting++] = *p++;
        if (n_waiting == sizeof waiting) {
            machine_write(waiting, n_waiting);
            n_waiting = 0;
        }
    }
}

static void finish(int status)
{
    if (n_waiting > 0)
        machine_write(waiting, n_waiting);
    for (;;)
        machine_exit(status);
}

void bare_start(void)
{
    machine_begin();
    finish(main());
}

void bare_trap(void)
{
    finish(TRAPPED);
}

uint32_t target_instructions(void)
{
    static uint32_t before, rest, instructions;
    uint32_t now = machine_ticks(), ticks = now - before;

    before = now;
    rest += ticks % TICKS_PER * INSTRUCTIONS_PER;
    instructions += ticks / TICKS_PER * INSTRUCTIONS_PER + rest / TICKS_PER;
    rest %= TICKS_PER;
    return instructions;
}

static inline uint32_t stack_pointer(void)
{
    uint32_t sp;

#if defined(__XTENSA__)
    __asm__ volatile("mov %0, a1" : "=a"(sp));
#elif defined(__arm__)
    __asm__ volatile("mov %0, sp" : "=r"(sp));
#else
    __asm__ volatile("mv %0, sp" : "=r"(sp));
#endif
    return sp;
}

__attribute__((noinline)) void target_stack_paint(void)
{
    volatile uint32_t *p = stack_low;

    painted_from = stack_pointer();
    while ((uint32_t)p < painted_from)
        *p++ = PAINT;
}

__attribute__((noinline)) uint32_t target_stack_used(void)
{
    const volatile uint32_t *p = stack_low;

    while ((uint32_t)p < painted_from && *p == PAINT)
        p++;
    return painted_from - (uint32_t)p;
}
