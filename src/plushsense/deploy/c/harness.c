/*
 * Feeds frames to one toy and writes every answer, so that `plushsense verify` can compare every number of it.
 *
 * The frames are rows of 32-bit little-endian numbers: milliseconds, then the measured channels. What is written are
 * rows of the same kind, one for each answer:
 *
 *     frame, ms, sample, state, gesture, affect, confidence, restarts, invalid, logits x classes, smooth x classes
 *
 * where from gesture to smooth all is 0 while warming. When something is wrong that no row can show, one more row is
 * written, not whole: words that say it.
 *
 * PLUSH_HARNESS_CHANNELS and PLUSH_HARNESS_CLASSES say of how many the frames and the expected rows are.
 * With PLUSH_HARNESS_IMAGE the model is not the one compiled in (plush_model.c) but the bytes of plush_model.bin, as
 * when a model is swapped without compiling the code again; with PLUSH_HARNESS_BOTH too they must be the same bytes.
 */
#include "plush_model.h"
#include "plushsense.h"

#include <string.h>

#define HEAD 9u
#define MOST_CLASSES 255u
#define GUARD_WORDS 4u
#define POISON UINT32_C(0xa5c35a3c)

#ifdef __cplusplus
extern "C" {
#endif
void target_write(const void *bytes, uint32_t n);
extern const uint8_t frames[], frames_end[];
#ifdef PLUSH_HARNESS_IMAGE
extern const uint8_t image[], image_end[];
#endif
#ifdef __cplusplus
}
#endif

static plush_toy toy;
/* One word before and some after, which nobody may touch. */
static uint32_t memory[1u + PLUSH_MODEL_MEMORY_WORDS + GUARD_WORDS];
static uint8_t row[4u * (HEAD + 2u * MOST_CLASSES)];
static uint32_t rows, frame;

static uint8_t *put(uint8_t *to, uint32_t value)
{
    to[0] = (uint8_t)value;
    to[1] = (uint8_t)(value >> 8);
    to[2] = (uint8_t)(value >> 16);
    to[3] = (uint8_t)(value >> 24);
    return to + 4;
}

static uint32_t number(const uint8_t *p)
{
    return (uint32_t)p[0] | ((uint32_t)p[1] << 8) | ((uint32_t)p[2] << 16) | ((uint32_t)p[3] << 24);
}

static int32_t signed_number(const uint8_t *p)
{
    uint32_t bits = number(p);
    int32_t value;

    memcpy(&value, &bits, sizeof value);
    return value;
}

static void on_answer(const plush_toy *of, void *user)
{
    uint8_t *to = row;
    uint32_t i, told = of->answer.state == PLUSH_TRACKING;

    to = put(to, *(const uint32_t *)user);
    to = put(to, of->answer.ms);
    to = put(to, of->answer.sample);
    to = put(to, (uint32_t)of->answer.state);
    to = put(to, told ? of->answer.gesture : 0u);
    to = put(to, told ? (uint32_t)of->answer.affect : 0u);
    to = put(to, told ? of->answer.confidence : 0u);
    to = put(to, of->restarts);
    to = put(to, of->invalid);
    for (i = 0; i < of->classes; i++)
        to = put(to, told ? (uint32_t)of->logits[i] : 0u);
    for (i = 0; i < of->classes; i++)
        to = put(to, told ? (uint32_t)of->smooth[i] : 0u);
    target_write(row, (uint32_t)(to - row));
    rows++;
}

static int wrong(const char *words)
{
    target_write(words, (uint32_t)strlen(words));
    return 0;
}

int main(void)
{
#ifdef PLUSH_HARNESS_IMAGE
    const uint8_t *model = image;
    uint32_t bytes = (uint32_t)(image_end - image);
#else
    const uint8_t *model = plush_model;
    uint32_t bytes = PLUSH_MODEL_BYTES;
#endif
    const uint8_t *p;
    int32_t values[256];
    uint32_t i, due = 0;

    /* What was in the memory before must not matter. */
    for (i = 0; i < sizeof memory / sizeof memory[0]; i++)
        memory[i] = POISON;
    memset(&toy, 0xa5, sizeof toy);
    if (plush_memory_bytes(model, bytes) > PLUSH_MODEL_MEMORY_BYTES)
        return wrong("PLUSH_MODEL_MEMORY_BYTES is less than plush_memory_bytes() says.");
    if (PLUSH_MODEL_MEMORY_BYTES > 4u * PLUSH_MODEL_MEMORY_WORDS)
        return wrong("PLUSH_MODEL_MEMORY_WORDS is less than PLUSH_MODEL_MEMORY_BYTES.");
    switch (plush_begin(&toy, model, bytes, memory + 1, PLUSH_MODEL_MEMORY_BYTES)) {
    case PLUSH_OK:
        break;
    case PLUSH_NOT_A_MODEL:
        return wrong("plush_begin() says PLUSH_NOT_A_MODEL.");
    case PLUSH_OTHER_VERSION:
        return wrong("plush_begin() says PLUSH_OTHER_VERSION.");
    case PLUSH_DAMAGED:
        return wrong("plush_begin() says PLUSH_DAMAGED: the checksum does not match.");
    case PLUSH_MEMORY_TOO_SMALL:
        return wrong("plush_begin() says PLUSH_MEMORY_TOO_SMALL.");
    default:
        return wrong("plush_begin() says something that it cannot say.");
    }
    if (toy.channels != PLUSH_MODEL_CHANNELS || toy.classes != PLUSH_MODEL_CLASSES)
        return wrong("PLUSH_MODEL_CHANNELS or PLUSH_MODEL_CLASSES is not that of the model.");
    if (toy.channels != PLUSH_HARNESS_CHANNELS || toy.classes != PLUSH_HARNESS_CLASSES)
        return wrong("The model has other channels or classes than model.plush: put the files of one export together.");
    toy.on_answer = on_answer;
    toy.user = &frame;
    for (p = frames; p < frames_end; p += 4u * (1u + toy.channels), frame++) {
        for (i = 0; i < toy.channels; i++)
            values[i] = signed_number(p + 4u + 4u * i);
        due += plush_push(&toy, number(p), values);
    }
#ifdef PLUSH_HARNESS_BOTH
    if (bytes != PLUSH_MODEL_BYTES || memcmp(image, plush_model, PLUSH_MODEL_BYTES) != 0)
        return wrong("plush_model.c does not hold the bytes of plush_model.bin.");
#endif
    if (due != rows || toy.answers != rows)
        return wrong("plush_push() or toy.answers counts other answers than on_answer saw.");
    if (memory[0] != POISON)
        return wrong("A word before the toy's memory was written to.");
    for (i = 0; i < GUARD_WORDS; i++)
        if (memory[1u + PLUSH_MODEL_MEMORY_WORDS + i] != POISON)
            return wrong("A word after the toy's memory was written to.");
    return 0;
}
