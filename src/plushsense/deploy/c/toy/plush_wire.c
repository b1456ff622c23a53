/*
 * The toy's lines: see plush_wire.h.
 */
#include "plush_wire.h"

#include <string.h>

#define DEVICE_MS (-1)
#define DELAY_MS (-2)
#define FIELDS @n_fields@
#define MOST UINT64_C(1000000000000000000) /* a larger number stands as this one */
#define LIMIT (UINT64_C(1) << 53)          /* beyond it a number is noise */
@if delay_only@
#define LONGEST_DELAY (UINT64_C(1) << 31)
@end@

/* What stands where in a line: a channel, or one of the clocks. */
static const int16_t order[FIELDS] = {
@order@
};
@if decimal@

/* How a channel's integer is written: times `times`, with so many decimals. */
static const struct {
    uint32_t times;
    uint8_t decimals;
} written[PLUSH_MODEL_CHANNELS] = {
@written@
};
@end@
@if decimal@

/* How far a power of ten ("e-4") was read. */
enum { POWER = 1, POWER_SIGN, POWER_DIGIT, POWER_FULL };
@end@

static char *write_number(char *at, int negative, @number@ size, uint32_t decimals)
{
    char digits[24];
    uint32_t n = 0;

    do {
        digits[n++] = (char)('0' + (int)(size % 10));
        size /= 10;
        if (n == decimals)
            digits[n++] = '.';
    } while (size != 0 || (decimals != 0 && n < decimals + 2));
    if (negative)
        *at++ = '-';
    while (n > 0)
        *at++ = digits[--n];
    return at;
}

uint32_t plush_wire_write(char line[PLUSH_WIRE_BYTES], uint32_t ms, uint32_t delay_ms, const int32_t *values)
{
    char *at = line;
    uint32_t i;

    for (i = 0; i < FIELDS; i++) {
        if (i > 0)
            *at++ = ' ';
        if (order[i] == DEVICE_MS) {
            at = write_number(at, 0, ms, 0);
        } else if (order[i] == DELAY_MS) {
            at = write_number(at, 0, delay_ms, 0);
        } else {
            int32_t v = values[order[i]];
            uint32_t size = v < 0 ? 0u - (uint32_t)v : (uint32_t)v;

@if decimal@
            at = write_number(at, v < 0, (uint64_t)size * written[order[i]].times, written[order[i]].decimals);
@end@
@if integer@
            at = write_number(at, v < 0, size, 0);
@end@
        }
    }
    *at++ = '\n';
    *at = 0;
    return (uint32_t)(at - line);
}

/* A number is complete: into its place. Returns 0 where it does not fit there. */
static int take(plush_wire *wire)
{
    uint64_t size = wire->number;
    int negative = wire->sign == '-', channel;
@if decimal@
    int places = wire->decimals > 0 ? wire->decimals - 1 : 0, whole = wire->decimals == 0 && wire->power == 0;
    uint64_t unit, left;
@end@

    if (wire->digits == 0 || wire->field >= FIELDS)
        return 0;
    channel = order[wire->field++];
    if (channel < 0) {
@if decimal@
        if (!whole)
            return 0;
@end@
        if (negative || size > LIMIT)
            return 0;
        if (channel == DEVICE_MS)
            wire->ms = (uint32_t)size; /* a longer clock wraps, as the toy's own does */
@if delay_only@
        else if (size > LONGEST_DELAY)
            return 0;
        else
            wire->ms = wire->heard ? wire->clock + (uint32_t)size : 0;
@end@
        return 1;
    }
@if decimal@
    if (written[channel].times == 1 && written[channel].decimals == 0) {
        if (!whole)
            return 0;
    } else {
        if (wire->power == POWER || wire->power == POWER_SIGN)
            return 0;
        places += wire->down ? wire->exponent : -wire->exponent;
        /* To one place more than is written, to round by; then to the nearest step, from the middle to the even one. */
        for (; places <= written[channel].decimals; places++)
            size = size > MOST / 10 ? MOST : size * 10;
        for (; places > written[channel].decimals + 1; places--, size /= 10)
            wire->rest |= size % 10 != 0;
        unit = UINT64_C(10) * written[channel].times;
        left = 2 * (size % unit);
        size /= unit;
        size += left > unit || (left == unit && (wire->rest || size % 2 != 0));
    }
@end@
    if (size > LIMIT)
        return 0;
    if (size > INT32_MAX)
        wire->values[channel] = negative ? INT32_MIN : INT32_MAX;
    else
        wire->values[channel] = negative ? -(int32_t)size : (int32_t)size;
    return 1;
}

int plush_wire_read(plush_wire *wire, char c, uint32_t *ms, int32_t *values)
{
    int end = c == '\n' || c == '\r', whole;

    if (c >= '0' && c <= '9') {
        uint32_t digit = (uint32_t)(c - '0');

        wire->begun = 1;
@if decimal@
        if (wire->power != 0) {
            if (wire->power == POWER_FULL)
                wire->bad = 1;
            wire->exponent = (uint8_t)(wire->exponent * 10u + digit);
            wire->power = wire->power == POWER_DIGIT ? POWER_FULL : POWER_DIGIT;
            return 0;
        }
        wire->digits = 1;
        if (wire->number < MOST / 10 && wire->decimals < 100) {
            wire->number = wire->number * 10 + digit;
            wire->decimals = (uint8_t)(wire->decimals + (wire->decimals > 0));
        } else if (wire->decimals > 0) {
            wire->rest |= digit != 0;
        } else {
            wire->number = MOST;
        }
@end@
@if integer@
        wire->digits = 1;
        wire->number = wire->number < MOST / 10 ? wire->number * 10 + digit : MOST;
@end@
        return 0;
    }
    if ((c == '-' || c == '+') && !wire->begun) {
        wire->begun = 1;
        wire->sign = c;
        return 0;
    }
@if decimal@
    if (c == '.' && wire->decimals == 0 && wire->power == 0) {
        wire->begun = wire->decimals = 1;
        return 0;
    }
    if ((c == 'e' || c == 'E') && wire->digits && wire->power == 0) {
        wire->power = POWER;
        return 0;
    }
    if ((c == '-' || c == '+') && wire->power == POWER) {
        wire->power = POWER_SIGN;
        wire->down = c == '-';
        return 0;
    }
@end@
    if (!end && c != ' ' && c != '\t' && c != ',' && c != ';')
        wire->bad = 1;
    else if (wire->begun && !take(wire))
        wire->bad = 1;
    wire->begun = wire->digits = 0;
@if decimal@
    wire->decimals = wire->rest = wire->power = wire->exponent = wire->down = 0;
@end@
    wire->sign = 0;
    wire->number = 0;
    if (!end)
        return 0;
    whole = wire->joined && !wire->bad && wire->field == FIELDS;
    wire->joined = 1;
    wire->bad = 0;
    wire->field = 0;
    if (!whole)
        return 0;
@if delay_only@
    wire->clock = wire->ms;
    wire->heard = 1;
@end@
    *ms = wire->ms;
    memcpy(values, wire->values, sizeof wire->values);
    return 1;
}
