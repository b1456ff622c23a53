/*
 * What a test program may ask of the machine under it, the same on the host and on every emulator.
 * A program is an ordinary main(); what it returns is its exit status.
 */
#ifndef PLUSH_TARGET_H
#define PLUSH_TARGET_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Appends these bytes to standard output, as they are. */
void target_write(const void *bytes, uint32_t n);

/* The next bytes of standard input; at its end the program ends. Only on AVR, which has no memory for blobs. */
void target_read(void *bytes, uint32_t n);

/* Instructions since the start, modulo 2^32; two differ by what ran between them. 0 where nothing counts (host).
 * Ask at least once in 2^30 instructions. */
uint32_t target_instructions(void);

/* Paints the free stack below the caller, to find out later how deep it went; emulators only. */
void target_stack_paint(void);

/* Bytes of stack used since then below the caller, who must be the function that painted. 0 on the host. */
uint32_t target_stack_used(void);

#ifdef __cplusplus
}
#endif
#endif
