/* What lx106 lacks on Debian: a C library, and some of the compiler's own helpers (division, 64-bit product). */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

void *memcpy(void *to, const void *from, size_t n)
{
    uint8_t *t = to;
    const uint8_t *f = from;

    if ((((uintptr_t)t | (uintptr_t)f) & 3u) == 0)
        for (; n >= 4; n -= 4, t += 4, f += 4)
            *(uint32_t *)(void *)t = *(const uint32_t *)(const void *)f;
    while (n-- > 0)
        *t++ = *f++;
    return to;
}

void *memmove(void *to, const void *from, size_t n)
{
    uint8_t *t = to;
    const uint8_t *f = from;

    if (t <= f)
        return memcpy(to, from, n);
    while (n-- > 0)
        t[n] = f[n];
    return to;
}

void *memset(void *to, int value, size_t n)
{
    uint8_t *t = to;

    /* 16 bytes at a time, as newlib does on an ESP. */
    if (((uintptr_t)t & 3u) == 0)
        for (; n >= 16; n -= 16, t += 16) {
            uint32_t *words = (uint32_t *)(void *)t;

            words[0] = words[1] = words[2] = words[3] = (uint8_t)value * UINT32_C(0x01010101);
        }
    while (n-- > 0)
        *t++ = (uint8_t)value;
    return to;
}

int memcmp(const void *a, const void *b, size_t n)
{
    const uint8_t *p = a, *q = b;

    for (; n > 0; n--, p++, q++)
        if (*p != *q)
            return *p - *q;
    return 0;
}

size_t strlen(const char *s)
{
    size_t n = 0;

    while (s[n] != 0)
        n++;
    return n;
}

/* Leading zeros of a number that is not 0. */
static inline uint32_t leading_zeros(uint32_t v)
{
    uint32_t n;

    __asm__("nsau %0, %1" : "=a"(n) : "a"(v));
    return n;
}

/* Quotient, and the rest where it is wanted; by 0: all ones. One bit at a time, but none that must be 0. */
static inline uint32_t divide(uint32_t v, uint32_t by, uint32_t *rest)
{
    uint32_t quotient = 0, n;

    if (by == 0) {
        *rest = v;
        return UINT32_MAX;
    }
    if (v >= by) {
        n = leading_zeros(by) - leading_zeros(v);
        by <<= n;
        do {
            quotient <<= 1;
            if (v >= by) {
                v -= by;
                quotient |= 1u;
            }
            by >>= 1;
        } while (n-- > 0);
    }
    *rest = v;
    return quotient;
}

uint32_t __udivsi3(uint32_t v, uint32_t by);
uint32_t __umodsi3(uint32_t v, uint32_t by);
int32_t __divsi3(int32_t v, int32_t by);
int32_t __modsi3(int32_t v, int32_t by);
uint64_t __muldi3(uint64_t a, uint64_t b);
uint64_t __umulsidi3(uint32_t a, uint32_t b);
uint64_t __udivdi3(uint64_t v, uint64_t by);
int64_t __divdi3(int64_t v, int64_t by);

uint32_t __udivsi3(uint32_t v, uint32_t by)
{
    uint32_t rest;

    return divide(v, by, &rest);
}

uint32_t __umodsi3(uint32_t v, uint32_t by)
{
    uint32_t rest;

    divide(v, by, &rest);
    return rest;
}

static inline uint32_t size_of(int32_t v)
{
    return v < 0 ? 0u - (uint32_t)v : (uint32_t)v;
}

int32_t __divsi3(int32_t v, int32_t by)
{
    uint32_t rest, quotient = divide(size_of(v), size_of(by), &rest);

    return (int32_t)((v ^ by) < 0 ? 0u - quotient : quotient);
}

int32_t __modsi3(int32_t v, int32_t by)
{
    uint32_t rest;

    divide(size_of(v), size_of(by), &rest);
    return (int32_t)(v < 0 ? 0u - rest : rest);
}

uint64_t __umulsidi3(uint32_t a, uint32_t b)
{
    uint32_t al = a & 0xffffu, ah = a >> 16, bl = b & 0xffffu, bh = b >> 16;
    uint32_t low = al * bl, one = ah * bl, two = al * bh, middle = (low >> 16) + (one & 0xffffu) + (two & 0xffffu);

    return ((uint64_t)(ah * bh + (one >> 16) + (two >> 16) + (middle >> 16)) << 32) | (middle << 16) |
           (low & 0xffffu);
}

uint64_t __muldi3(uint64_t a, uint64_t b)
{
    uint32_t cross = (uint32_t)(a >> 32) * (uint32_t)b + (uint32_t)a * (uint32_t)(b >> 32);

    return __umulsidi3((uint32_t)a, (uint32_t)b) + ((uint64_t)cross << 32);
}

/* Of models that calibrate themselves. */
uint64_t __udivdi3(uint64_t v, uint64_t by)
{
    uint64_t quotient = 0;
    uint32_t n = 0;

    while (by <= v >> 1) {
        by <<= 1;
        n++;
    }
    for (n++; n > 0; n--, by >>= 1) {
        quotient <<= 1;
        if (v >= by) {
            v -= by;
            quotient |= 1u;
        }
    }
    return quotient;
}

int64_t __divdi3(int64_t v, int64_t by)
{
    uint64_t quotient = __udivdi3(v < 0 ? 0u - (uint64_t)v : (uint64_t)v, by < 0 ? 0u - (uint64_t)by : (uint64_t)by);

    return (int64_t)((v ^ by) < 0 ? 0u - quotient : quotient);
}
