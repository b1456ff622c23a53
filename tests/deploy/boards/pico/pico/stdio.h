/* As much of the Pico SDK's stdio as plush_hooks.c asks for, on standard input and output. */
#pragma once
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static inline bool stdio_init_all(void)
{
    return true;
}

/* Every other time nothing has come yet. */
static inline int getchar_timeout_us(uint32_t timeout_us)
{
    static bool is_late;
    int byte;

    (void)timeout_us;
    if ((is_late = !is_late))
        return -1; /* PICO_ERROR_TIMEOUT */
    fflush(stdout);
    byte = getchar();
    if (byte == EOF)
        exit(0);
    return byte;
}

static inline int putchar_raw(int c)
{
    return putchar(c);
}
