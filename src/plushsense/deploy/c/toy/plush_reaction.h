/*
 * From events to eyes and sound: what this example shows, in one place. Yours to change.
 */
#ifndef PLUSH_REACTION_H
#define PLUSH_REACTION_H

#include "plushsense.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What the toy is to show now. */
typedef struct {
    uint8_t red, green, blue; /* brightness of the eyes, 0 to 255 */
    uint16_t tone_hz;         /* 0: silent */
} plush_look;

/* What it shows, and since when. Set all of it to 0 before use. */
typedef struct {
    uint16_t shown;
    uint32_t since_ms;
    uint32_t answers, answered_ms; /* the newest answer, and when it came */
} plush_reaction;

/* Call it often (every frame), with the toy's own clock. */
void plush_react(plush_reaction *reaction, const plush_toy *toy, uint32_t ms, plush_look *look);

/* plush_begin() failed: as many red blinks as its status says, then a pause. */
void plush_show_failure(plush_status status, uint32_t ms, plush_look *look);

#ifdef __cplusplus
}
#endif
#endif
