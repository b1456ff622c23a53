/* RV32 on QEMU's machine "virt": instructions by minstret. The call of semihosting is in riscv32_start.S. */
#include "bare.h"

void machine_begin(void)
{
}

uint32_t machine_ticks(void)
{
    uint32_t count;

    __asm__ volatile("csrr %0, minstret" : "=r"(count) : : "memory");
    return count;
}
