/* The few functions of <string.h> that a program on lx106 gets here: Debian has no C library for it. */
#ifndef PLUSH_XTENSA_STRING_H
#define PLUSH_XTENSA_STRING_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

void *memcpy(void *to, const void *from, size_t n);
void *memmove(void *to, const void *from, size_t n);
void *memset(void *to, int value, size_t n);
int memcmp(const void *a, const void *b, size_t n);
size_t strlen(const char *s);

#ifdef __cplusplus
}
#endif
#endif
