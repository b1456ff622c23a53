/* lx106: the reset vector, the other vectors at multiples of 16 behind it, and a stack. */
    .section .reset, "ax"
    .global _start
_start:
    j       begin

    .macro  vector at
    .org    \at
    j       trapped
    .endm
    vector  0x10
    vector  0x20
    vector  0x30
    vector  0x50
    vector  0x70

    .org    0x80
    .text
    .align  4
begin:
    movi    a0, 0
    wsr     a0, ps                  /* out of the exception mode that reset leaves */
    movi    a0, _start
    wsr     a0, vecbase
    rsync
    movi    a1, stack_top
    call0   bare_start

    .align  4
trapped:
    movi    a0, 0
    wsr     a0, ps
    rsync
    movi    a1, stack_top
    call0   bare_trap
