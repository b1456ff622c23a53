/*
 * Feeds frames to one toy and writes every answer, event and change of health, so that `plushsense verify` can compare
 * every number of it.
 *
 * What is fed are cases, one after the other, of 32-bit little-endian numbers: the bytes of a model, and the model, filled
 * up to whole numbers (0 bytes: the export's own); then, again and again, how many frames, and each: milliseconds, then
 * the measured channels; and what comes after them: 0, the case ends; 1, a silence; 2, a patch: its bytes, and the patch,
 * filled up (0 bytes: the model's own layer is brought back); 3, the toy is primed with a frame; 4, a sensitivity; 5, its
 * sensors are calibrated anew. What is written are rows of the same kind:
 *
 *     0, frame, ms, sample, state, gesture, affect, confidence, answer, known, counts, logits x classes,
 *         smooth x classes; while warming all from gesture to known is 0, and logits and smooth
 *     1, frame, ms, number, what, gesture, affect, source, since, 0, counts, and zeros: an event
 *     2, frame, ms, faults, state, suspect, 0, 0, 0, 0, counts, and zeros: health says something else
 *     3, frame, ms, status, 0, 0, 0, 0, 0, 0, counts, and zeros: what plush_patch() says
 *
 * The counts are restarts, invalid, bad_stamps, interpolated, interval, sparse.
 *
 * When something is wrong that no row can show, one more row is written, not whole: words that say it.
 *
 * PLUSH_HARNESS_CHANNELS and PLUSH_HARNESS_CLASSES say of how many the frames and the expected rows are,
 * PLUSH_HARNESS_MEMORY_BYTES how much memory the cases' own models need.
 * Cases are in memory, and rows go to target_write(). With PLUSH_HARNESS_KEPT_BYTES cases come from target_read(), at whose
 * end the program ends: there is room for so many bytes of models and patches. With PLUSH_HARNESS_DEVICE both go over a UART (plush_device.c), and
 * it is measured how long plush_push() takes.
 * With PLUSH_HARNESS_IMAGE the export's model is not the one compiled in (plush_model.c) but the bytes of
 * plush_model.bin, as when a model is swapped without compiling the code again; with PLUSH_HARNESS_BOTH too they must be
 * the same bytes.
 */
#include "plush_model.h"
#include "plushsense.h"

#include <string.h>

#define HEAD 16u
#define OWN_WORDS (PLUSH_HARNESS_MEMORY_BYTES / 4u)
#define MEMORY_WORDS (PLUSH_MODEL_MEMORY_WORDS > OWN_WORDS ? PLUSH_MODEL_MEMORY_WORDS : OWN_WORDS)
#define NUMBERS (2u * PLUSH_HARNESS_CLASSES)
#define GUARD_WORDS 4u
#define POISON UINT32_C(0xa5c35a3c)

/* What comes after frames. */
enum { END = 0, SILENCE = 1, PATCH = 2, PRIME = 3, SENSITIVITY = 4, RECALIBRATE = 5 };

#ifdef PLUSH_HARNESS_DEVICE
#include "plush_device.h"
#else
#ifdef __cplusplus
extern "C" {
#endif
void target_write(const void *bytes, uint32_t n);
void target_read(void *bytes, uint32_t n);
extern const uint8_t cases[], cases_end[];
#ifdef PLUSH_HARNESS_IMAGE
extern const uint8_t image[], image_end[];
#endif
#ifdef __cplusplus
}
#endif

#ifdef PLUSH_HARNESS_KEPT_BYTES
static uint8_t room[PLUSH_HARNESS_KEPT_BYTES + 1u] __attribute__((aligned(4)));
static uint32_t kept;

static int plush_device_case(void)
{
    kept = 0;
    return 1;
}

static const uint8_t *plush_device_bytes(uint32_t n, int keep)
{
    static uint8_t passing[4u * (1u + PLUSH_HARNESS_CHANNELS)];
    uint8_t *bytes = keep ? room + kept : passing;

    if (keep)
        kept += n;
    target_read(bytes, n);
    return bytes;
}
#else
static const uint8_t *next = cases;

static int plush_device_case(void)
{
    return next < cases_end;
}

/* The next bytes of the case. Those that are kept stay until it ends, others until the next call. */
static const uint8_t *plush_device_bytes(uint32_t n, int kept)
{
    const uint8_t *bytes = next;

    (void)kept;
    next += n;
    return bytes;
}
#endif

static void plush_device_row(const uint8_t *bytes, uint32_t n)
{
    target_write(bytes, n);
}

static void plush_device_words(const char *words)
{
    target_write(words, (uint32_t)strlen(words));
}

static uint32_t plush_device_cycles(void)
{
    return 0;
}
#endif

static plush_toy toy;
/* One word before and some after, which nobody may touch. */
static uint32_t memory[1u + MEMORY_WORDS + GUARD_WORDS];
static uint8_t row[4u * (HEAD + NUMBERS)];
static uint32_t answers, frame;
static uint32_t apart; /* cycles of the harness inside of plush_push() */

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

/* What every row has: its kind, seven numbers that depend on it, the counts; then zeros. */
static void begin_row(uint32_t kind, uint32_t ms, const uint32_t what[7])
{
    uint8_t *to = put(put(put(row, kind), frame), ms);
    uint32_t i;

    for (i = 0; i < 7; i++)
        to = put(to, what[i]);
    to = put(put(to, toy.restarts), toy.invalid);
    to = put(put(to, toy.bad_stamps), toy.interpolated);
    to = put(put(to, toy.interval), toy.sparse);
    memset(to, 0, 4u * NUMBERS);
}

static void end_row(void)
{
    plush_device_row(row, sizeof row);
}

static void on_answer(const plush_toy *of, void *user)
{
    uint32_t from = plush_device_cycles(), what[7], i;

    (void)user;
    what[0] = of->answer.sample;
    what[1] = (uint32_t)of->answer.state;
    what[2] = of->answer.gesture;
    what[3] = (uint32_t)of->answer.affect;
    what[4] = of->answer.confidence;
    what[5] = (uint32_t)of->answer.kind;
    what[6] = (uint32_t)of->answer.known;
    begin_row(0, of->answer.ms, what);
    for (i = 0; i < of->classes && of->answer.state == PLUSH_TRACKING; i++) {
        put(row + 4u * (HEAD + i), (uint32_t)of->logits[i]);
        put(row + 4u * (HEAD + of->classes + i), (uint32_t)of->smooth[i]);
    }
    end_row();
    answers++;
    apart += plush_device_cycles() - from;
}

static void on_event(const plush_toy *of, void *user)
{
    uint32_t from = plush_device_cycles(), what[7];

    (void)user;
    what[0] = of->event.number;
    what[1] = (uint32_t)of->event.what;
    what[2] = of->event.gesture;
    what[3] = (uint32_t)of->event.affect;
    what[4] = (uint32_t)of->event.source;
    what[5] = of->event.since_ms;
    what[6] = 0;
    begin_row(1, of->event.ms, what);
    end_row();
    apart += plush_device_cycles() - from;
}

static void on_health(uint32_t ms)
{
    uint32_t what[7] = {0, 0, 0, 0, 0, 0, 0};

    what[0] = toy.faults;
    what[1] = (uint32_t)toy.answer.state;
    if (toy.answer.state != PLUSH_FAULT && toy.warm >= toy.span) /* the answer is told at the end of the step */
        what[1] = PLUSH_TRACKING;
    what[2] = toy.suspect;
    begin_row(2, ms, what);
    end_row();
}

static int wrong(const char *words)
{
    plush_device_words(words);
    return 0;
}

static int status_words(plush_status status)
{
    switch (status) {
    case PLUSH_OK:
        return 1;
    case PLUSH_NOT_A_MODEL:
        return wrong("plush_begin() says PLUSH_NOT_A_MODEL.");
    case PLUSH_OTHER_VERSION:
        return wrong("plush_begin() says PLUSH_OTHER_VERSION.");
    case PLUSH_DAMAGED:
        return wrong("plush_begin() says PLUSH_DAMAGED: the checksum does not match.");
    case PLUSH_MEMORY_TOO_SMALL:
        return wrong("plush_begin() says PLUSH_MEMORY_TOO_SMALL.");
    case PLUSH_NOT_ALIGNED:
        return wrong("plush_begin() says PLUSH_NOT_ALIGNED.");
    case PLUSH_MEMORY_NOT_ALIGNED:
        return wrong("plush_begin() says PLUSH_MEMORY_NOT_ALIGNED.");
    default:
        return wrong("plush_begin() says something that it cannot say.");
    }
}

static uint32_t next_number(void)
{
    const uint8_t *p = plush_device_bytes(4, 0);

    return p == NULL ? 0 : number(p);
}

/* So many bytes of the case, filled up, that stay. */
static const uint8_t *next_kept(uint32_t bytes)
{
    return plush_device_bytes((bytes + 3u) / 4u * 4u, 1);
}

static void on_patch(uint32_t ms)
{
    uint32_t what[7] = {0, 0, 0, 0, 0, 0, 0}, bytes = next_number();

    what[0] = (uint32_t)plush_patch(&toy, bytes == 0 ? NULL : next_kept(bytes), bytes);
    begin_row(3, ms, what);
    end_row();
}

/* The next frame of the case; NULL when it did not come. */
static const int32_t *next_frame(uint32_t *ms)
{
    static int32_t values[PLUSH_HARNESS_CHANNELS];
    const uint8_t *p = plush_device_bytes(4u * (1u + PLUSH_HARNESS_CHANNELS), 0);
    uint32_t i;

    if (p == NULL)
        return NULL;
    *ms = number(p);
    for (i = 0; i < PLUSH_HARNESS_CHANNELS; i++)
        values[i] = signed_number(p + 4u + 4u * i);
    return values;
}

static int push_next(uint32_t *ms, uint32_t *due)
{
    const int32_t *values = next_frame(ms);
    int fault = toy.answer.state == PLUSH_FAULT, suspect = toy.suspect, tracking = toy.answer.state == PLUSH_TRACKING;
    uint32_t n, from;

    if (values == NULL)
        return 0;
    apart = 0;
    from = plush_device_cycles();
    n = plush_push(&toy, *ms, values);
#ifdef PLUSH_HARNESS_DEVICE
    plush_device_measure(plush_device_cycles() - from - apart, n,
                         tracking && toy.answer.state == PLUSH_TRACKING);
#else
    (void)from;
    (void)tracking;
#endif
    *due += n;
    if (fault != (toy.answer.state == PLUSH_FAULT) || suspect != toy.suspect)
        on_health(*ms);
    return 1;
}

/* Returns how many answers fell due. */
static uint32_t on_prime(void)
{
    uint32_t ms, before = toy.answers;
    const int32_t *values = next_frame(&ms);

    if (values != NULL)
        plush_prime(&toy, ms, values);
    return toy.answers - before;
}

/* The frames of a case, and what comes between them. Says whether all came, and all answers were told. */
static int feed(void)
{
    uint32_t due = 0, ms = 0, what, n;

    answers = frame = 0;
    do {
        for (n = next_number(); n > 0; n--, frame++)
            if (!push_next(&ms, &due))
                return 0;
        what = next_number();
        frame--; /* of the newest frame */
        if (what == SILENCE)
            plush_silence(&toy);
        else if (what == PATCH)
            on_patch(ms);
        else if (what == PRIME)
            due += on_prime();
        else if (what == SENSITIVITY)
            toy.sensitivity = (int8_t)((int32_t)((next_number() + 128u) & 255u) - 128);
        else if (what == RECALIBRATE)
            plush_recalibrate(&toy);
        frame++;
    } while (what != END);
    return (due == answers && toy.answers == answers) ||
           wrong("plush_push() or toy.answers counts other answers than on_answer saw.");
}

/* One case, with the export's model or its own. Says whether all was well; otherwise words were written. */
static int run(const uint8_t *model, uint32_t bytes)
{
    uint32_t own = next_number(), room, i;

    if (own != 0) {
        model = next_kept(own);
        bytes = own;
    }
    /* What was in the memory before must not matter. */
    for (i = 0; i < sizeof memory / sizeof memory[0]; i++)
        memory[i] = POISON;
    memset(&toy, 0xa5, sizeof toy);
    room = own != 0 ? plush_memory_bytes(model, bytes) : PLUSH_MODEL_MEMORY_BYTES;
    if (plush_memory_bytes(model, bytes) > room)
        return wrong("PLUSH_MODEL_MEMORY_BYTES is less than plush_memory_bytes() says.");
    if (room > 4u * MEMORY_WORDS)
        return wrong("plush_memory_bytes() says more than PlushSense does.");
    if (!status_words(plush_begin(&toy, model, bytes, memory + 1, room)))
        return 0;
    if (toy.channels != PLUSH_MODEL_CHANNELS || toy.classes != PLUSH_MODEL_CLASSES)
        return wrong("PLUSH_MODEL_CHANNELS or PLUSH_MODEL_CLASSES is not that of the model.");
    if (toy.channels != PLUSH_HARNESS_CHANNELS || toy.classes != PLUSH_HARNESS_CLASSES)
        return wrong("The model has other channels or classes than model.plush: put the files of one export together.");
    toy.on_answer = on_answer;
    toy.on_event = on_event;
    if (!feed())
        return 0;
    if (memory[0] != POISON)
        return wrong("A word before the toy's memory was written to.");
    for (i = 1u + room / 4u; i < sizeof memory / sizeof memory[0]; i++)
        if (memory[i] != POISON)
            return wrong("A word after the toy's memory was written to.");
    return 1;
}

#ifdef PLUSH_HARNESS_DEVICE
void plush_device_cases(void)
#else
int main(void)
#endif
{
#ifdef PLUSH_HARNESS_IMAGE
    const uint8_t *model = image;
    uint32_t bytes = (uint32_t)(image_end - image);
#else
    const uint8_t *model = plush_model;
    uint32_t bytes = PLUSH_MODEL_BYTES;
#endif
    int well = PLUSH_MODEL_MEMORY_BYTES <= 4u * PLUSH_MODEL_MEMORY_WORDS ||
               wrong("PLUSH_MODEL_MEMORY_WORDS is less than PLUSH_MODEL_MEMORY_BYTES.");

    while (well && plush_device_case())
        well = run(model, bytes);
#ifdef PLUSH_HARNESS_BOTH
    if (bytes != PLUSH_MODEL_BYTES || memcmp(image, plush_model, PLUSH_MODEL_BYTES) != 0)
        wrong("plush_model.c does not hold the bytes of plush_model.bin.");
#endif
#ifndef PLUSH_HARNESS_DEVICE
    return 0;
#endif
}
