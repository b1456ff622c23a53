/*
 * The toy's lines, as `plushsense record` and `plushsense live` read them. A frame is a line of numbers:
 *
@fields@
 *
 * device_ms is the sender's clock in ms (here it wraps at 2^32), delay_ms the time since the frame before.
@if decimal@
 * Numbers may have any decimals and a power of ten, and are rounded to the channel's steps; one that lies just in the
 * middle between two steps may come out one step away from the computer's, which divides floating-point numbers.
@end@
 */
#ifndef PLUSH_WIRE_H
#define PLUSH_WIRE_H

#include "plush_model.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PLUSH_WIRE_BYTES @line_bytes@ /* the longest line, its end and a 0 */

/* A line that is being read. Set all of it to 0 before the first character. */
typedef struct {
    uint8_t joined;    /* a line end was heard: what follows is a whole line */
    uint8_t bad;       /* something in this line is no number */
    uint8_t begun;     /* a number is being read */
    uint8_t digits;    /* it has a digit */
@if decimal@
    uint8_t decimals;  /* 0: no point yet; else 1 + its places */
    uint8_t rest;      /* places that are not kept were not all 0 */
    uint8_t power;     /* of the power of ten: how far it was read */
    uint8_t exponent;
    uint8_t down;      /* it is negative */
@end@
    char sign;
    uint16_t field;    /* of the line, from 0 */
    uint64_t number;
@if delay_only@
    uint8_t heard;     /* a frame has come: `clock` runs */
    uint32_t clock;    /* the delays, added up: these lines carry no clock */
@end@
    uint32_t ms;
    int32_t values[PLUSH_MODEL_CHANNELS];
} plush_wire;

/* Writes a frame, ended by \n and a 0; returns its characters without the 0. */
uint32_t plush_wire_write(char line[PLUSH_WIRE_BYTES], uint32_t ms, uint32_t delay_ms, const int32_t *values);

/* Takes one character in. Returns 1 when it ended a whole frame, which is then in `ms` and `values`. Half a line (also
 * the first, where one joins in the middle), noise and lines of another length are left out. */
int plush_wire_read(plush_wire *wire, char c, uint32_t *ms, int32_t *values);

#ifdef __cplusplus
}
#endif
#endif
