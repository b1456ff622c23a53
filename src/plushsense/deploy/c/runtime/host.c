/* The machine that PlushSense runs on. */
#include "target.h"

#include <stdio.h>
#include <stdlib.h>
#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#endif

void target_write(const void *bytes, uint32_t n)
{
#ifdef _WIN32
    static int binary;

    if (!binary++)
        _setmode(_fileno(stdout), _O_BINARY);
#endif
    if (fwrite(bytes, 1, n, stdout) != n)
        exit(97);
}

uint32_t target_instructions(void)
{
    return 0;
}

void target_stack_paint(void)
{
}

uint32_t target_stack_used(void)
{
    return 0;
}
