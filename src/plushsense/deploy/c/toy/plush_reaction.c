/*
 * From events to eyes and sound: see plush_reaction.h.
 *
 * The rules. An event shows its affect as soon as it begins, long before its gesture may be sure, until it ends. What is
 * shown stays for its hold time at least, so that the toy does not flicker; then it follows. Between events the eyes
 * glimmer. Warming (after the start, a gap, a clock reset) and silence (no answer for QUIET_MS: the sensors have stopped)
 * look alike: blue, breathing; sensors that cannot be believed: violet, breathing. An event whose affect nobody told has
 * its gesture's own colour and no sound.
 */
#include "plush_reaction.h"

#define QUIET_MS 500u
#define BLINK_MS 300u

/* What can be shown; from GESTURE on: GESTURE + class, of an affect that nobody told. */
enum { WARMING, FAULT, CALM, POSITIVE, NEUTRAL, NEGATIVE, GESTURE };

static const uint16_t hold_ms[] = {0, 0, 0, 1500, 500, 2500, 1000};

/* A sound: notes of NOTE_MS each, ended by 0; it plays once, when its affect begins. */
#define NOTE_MS 120u
static const uint16_t contented[] = {392, 523, 659, 0};
static const uint16_t hurt[] = {1400, 1100, 800, 600, 0};

static uint16_t note(const uint16_t *notes, uint32_t since_ms)
{
    while (*notes != 0 && since_ms >= NOTE_MS) {
        since_ms -= NOTE_MS;
        notes++;
    }
    return *notes;
}

/* A number that rises from 0 to 255 and falls again, once in a period. */
static uint8_t breathing(uint32_t ms, uint32_t period_ms)
{
    uint32_t at = ms % period_ms * 510 / period_ms;

    return (uint8_t)(at <= 255 ? at : 510 - at);
}

/* A colour for each class, evenly around the colour circle. */
static void colour(uint32_t gesture, uint32_t classes, plush_look *look)
{
    uint32_t at = gesture * 768 / classes;
    uint8_t up = (uint8_t)(at % 256), down = (uint8_t)(255 - up);

    if (at < 256) {
        look->red = down;
        look->green = up;
    } else if (at < 512) {
        look->green = down;
        look->blue = up;
    } else {
        look->blue = down;
        look->red = up;
    }
}

/* What the toy asks for now. */
static uint16_t wanted(const plush_reaction *reaction, const plush_toy *toy, uint32_t ms)
{
    if (toy->answer.state == PLUSH_FAULT)
        return FAULT;
    if (ms - reaction->answered_ms > QUIET_MS)
        return WARMING;
    if (toy->event.what != PLUSH_BEGUN && toy->event.what != PLUSH_NAMED)
        return toy->answer.state == PLUSH_WARMING ? WARMING : CALM;
    switch (toy->event.affect) {
    case PLUSH_AFFECT_POSITIVE:
        return POSITIVE;
    case PLUSH_AFFECT_NEUTRAL:
        return NEUTRAL;
    case PLUSH_AFFECT_NEGATIVE:
        return NEGATIVE;
    case PLUSH_AFFECT_NONE:
        break;
    }
    if (toy->event.gesture == PLUSH_NO_GESTURE)
        return NEUTRAL;
    return (uint16_t)(GESTURE + toy->event.gesture);
}

void plush_react(plush_reaction *reaction, const plush_toy *toy, uint32_t ms, plush_look *look)
{
    uint16_t next;
    uint32_t since;

    if (toy->answers != reaction->answers) {
        reaction->answers = toy->answers;
        reaction->answered_ms = ms;
    }
    next = wanted(reaction, toy, ms);
    if (next != reaction->shown &&
        ms - reaction->since_ms >= hold_ms[reaction->shown < GESTURE ? reaction->shown : GESTURE]) {
        reaction->shown = next;
        reaction->since_ms = ms;
    }
    since = ms - reaction->since_ms;
    look->red = look->green = look->blue = 0;
    look->tone_hz = 0;
    switch (reaction->shown) {
    case WARMING:
        look->blue = breathing(ms, 2000);
        break;
    case FAULT:
        look->red = look->blue = breathing(ms, 2000);
        break;
    case CALM:
        look->red = look->green = look->blue = 10;
        break;
    case POSITIVE:
        look->green = 255;
        look->tone_hz = note(contented, since);
        break;
    case NEUTRAL:
        look->red = look->green = look->blue = 40;
        break;
    case NEGATIVE:
        look->red = 255;
        look->tone_hz = note(hurt, since);
        break;
    default:
        colour(reaction->shown - (uint32_t)GESTURE, toy->classes, look);
        break;
    }
}

void plush_show_failure(plush_status status, uint32_t ms, plush_look *look)
{
    uint32_t at = ms / BLINK_MS % (2 * (uint32_t)status + 4);

    look->red = (uint8_t)(at < 2 * (uint32_t)status && at % 2 == 0 ? 255 : 0);
    look->green = look->blue = 0;
    look->tone_hz = 0;
}
