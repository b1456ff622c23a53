/* RV32 on QEMU's machine "virt": a stack, where traps go, and semihosting's three instructions. */
    .section .reset, "ax"
    .global _start
_start:
    .option push
    .option norelax
    la      gp, __global_pointer$
    .option pop
    la      sp, stack_top
    la      t0, trapped
    csrw    mtvec, t0
    call    bare_start

    .balign 4
trapped:
    la      sp, stack_top
    call    bare_trap

    .text
    .balign 16
    .option push
    .option norvc
    .global semihosting
semihosting:
    slli    zero, zero, 0x1f
    ebreak
    srai    zero, zero, 7
    ret
    .option pop
