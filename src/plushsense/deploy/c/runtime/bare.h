/* What the three emulated machines have in common (bare.c), and what each of them has to offer it. */
#ifndef PLUSH_BARE_H
#define PLUSH_BARE_H

#include "target.h"

/* Of the machine: */
void machine_write(const void *bytes, uint32_t n); /* to standard output of the emulator */
void machine_exit(int status);
void machine_begin(void);                          /* starts whatever counts */
uint32_t machine_ticks(void);                      /* of that */

/* Of a machine that leaves the first two to semihosting.c: */
uint32_t semihosting(uint32_t operation, const void *block);

/* Every TICKS_PER ticks are INSTRUCTIONS_PER instructions: the emulator runs on a clock of its own (-icount). */
#if defined(__XTENSA__)
#define TICKS_PER 32u       /* 25 ns each, an instruction takes 32 ns */
#define INSTRUCTIONS_PER 25u
#elif defined(__ARM_ARCH_8M_MAIN__)
#define TICKS_PER 32u       /* 50 ns each, an instruction takes 64 ns */
#define INSTRUCTIONS_PER 25u
#elif defined(__arm__)
#define TICKS_PER 8u        /* 40 ns each, an instruction takes 64 ns */
#define INSTRUCTIONS_PER 5u
#else
#define TICKS_PER 1u        /* minstret */
#define INSTRUCTIONS_PER 1u
#endif

/* Of bare.c, for the start-up code: */
void bare_start(void);
void bare_trap(void); /* an exception: ends with status 98 */

#endif
