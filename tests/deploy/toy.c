/* The C library and what tests need beside it: a shared library for ctypes, or, with ALONE, a program that reads one
 * file of cases, so that sanitizers can watch. The library is included, so that its small functions can be tried. */
#include "plushsense.c"

#include <stdio.h>
#include <stdlib.h>

#define HEAD 16u

typedef struct {
    plush_toy toy;
    uint8_t *model, *patch;
    uint32_t *memory, memory_bytes;
    int32_t *rows;
    uint32_t frame, made, most;
    int32_t ended[1][HEAD + 2u * 255u]; /* what plush_begin() ends */
} seat;

/* A row as golden/answers.bin has it: kind, frame and ms, seven that depend on the kind, the counts; zeros. */
static int32_t *row_of(seat *s, int32_t kind, uint32_t ms)
{
    uint32_t width = HEAD + 2u * s->toy.classes;
    int32_t *row = s->rows + (size_t)s->made * width;

    if (s->made >= s->most)
        return NULL;
    s->made++;
    memset(row, 0, 4u * width);
    row[0] = kind;
    row[1] = (int32_t)s->frame;
    row[2] = (int32_t)ms;
    row[10] = (int32_t)s->toy.restarts;
    row[11] = (int32_t)s->toy.invalid;
    row[12] = (int32_t)s->toy.bad_stamps;
    row[13] = (int32_t)s->toy.interpolated;
    row[14] = s->toy.interval;
    row[15] = s->toy.sparse;
    return row;
}

static void note(const plush_toy *toy, void *user)
{
    int32_t *row = row_of((seat *)user, 0, toy->answer.ms);
    uint32_t k;

    if (row == NULL)
        return;
    row[3] = (int32_t)toy->answer.sample;
    row[4] = (int32_t)toy->answer.state;
    row[5] = toy->answer.gesture;
    row[6] = (int32_t)toy->answer.affect;
    row[7] = toy->answer.confidence;
    row[8] = (int32_t)toy->answer.kind;
    row[9] = toy->answer.known;
    for (k = 0; k < toy->classes && toy->answer.state == PLUSH_TRACKING; k++) {
        row[HEAD + k] = toy->logits[k];
        row[HEAD + toy->classes + k] = toy->smooth[k];
    }
}

static void note_event(const plush_toy *toy, void *user)
{
    int32_t *row = row_of((seat *)user, 1, toy->event.ms);

    if (row == NULL)
        return;
    row[3] = (int32_t)toy->event.number;
    row[4] = (int32_t)toy->event.what;
    row[5] = toy->event.gesture;
    row[6] = (int32_t)toy->event.affect;
    row[7] = (int32_t)toy->event.source;
    row[8] = (int32_t)toy->event.since_ms;
}

static void note_health(seat *s, uint32_t ms)
{
    int32_t *row = row_of(s, 2, ms);

    if (row == NULL)
        return;
    row[3] = (int32_t)s->toy.faults;
    row[4] = (int32_t)(s->toy.answer.state != PLUSH_FAULT && s->toy.warm >= s->toy.span ? PLUSH_TRACKING
                                                                                        : s->toy.answer.state);
    row[5] = s->toy.suspect;
}

/* A toy whose model and memory have exactly the bytes they need, so that one byte too far is noticed. `too_few` bytes
 * are kept back; the memory begins `off` bytes after an aligned place. */
void *seat_new(const uint8_t *model, uint32_t bytes, int *status, uint32_t too_few, uint32_t off)
{
    seat *s = (seat *)calloc(1, sizeof *s);
    uint32_t needed;

    s->model = (uint8_t *)malloc(bytes ? bytes : 1);
    memcpy(s->model, model, bytes);
    memset(&s->toy, 0xa5, sizeof s->toy);
    needed = plush_memory_bytes(s->model, bytes);
    if (needed > (1u << 26)) {
        *status = -1; /* a giant: not tried */
        memset(&s->toy, 0, sizeof s->toy);
        return s;
    }
    s->memory_bytes = needed;
    s->memory = (uint32_t *)malloc(needed + off + 4);
    memset(s->memory, 0xc3, needed + off + 4);
    s->memory = (uint32_t *)realloc(s->memory, needed + off ? needed + off : 1);
    *status = (int)plush_begin(&s->toy, s->model, bytes, (uint8_t *)s->memory + off, needed - too_few);
    return s;
}

void seat_free(void *p)
{
    seat *s = (seat *)p;

    free(s->model);
    free(s->patch);
    free(s->memory);
    free(s);
}

/* Frames, rows of ms and values, to rows as golden/answers.bin has them; returns how many there were. After a frame
 * whose number stands in `silences`, nothing is heard for a while. */
uint32_t seat_push(void *p, const int32_t *frames, uint32_t n, uint32_t channels, int32_t *rows, uint32_t most,
                   const uint32_t *silences, uint32_t silent)
{
    seat *s = (seat *)p;
    uint32_t i, answered = s->toy.answers, due = 0;

    s->rows = rows;
    s->made = 0;
    s->most = most;
    if (s->toy.user == NULL) { /* a swap keeps them */
        s->toy.on_answer = note;
        s->toy.on_event = note_event;
        s->toy.user = s;
    }
    for (i = 0; i < n; i++, s->frame++, frames += 1 + channels) {
        uint32_t fault = s->toy.answer.state == PLUSH_FAULT, suspect = s->toy.suspect;

        due += plush_push(&s->toy, (uint32_t)frames[0], frames + 1);
        if (fault != (s->toy.answer.state == PLUSH_FAULT) || suspect != s->toy.suspect)
            note_health(s, (uint32_t)frames[0]);
        if (silent > 0 && *silences == s->frame) {
            silences++;
            silent--;
            plush_silence(&s->toy);
        }
    }
    return due == s->toy.answers - answered ? s->made : UINT32_MAX;
}

/* As plush_push_many() and plush_prime() do; the rows as of seat_push(). Returns how many there were. */
uint32_t seat_push_many(void *p, const int32_t *values, uint32_t n, uint32_t last_ms, uint32_t period_us, int32_t *rows,
                        uint32_t most)
{
    seat *s = (seat *)p;
    uint32_t answered = s->toy.answers;

    s->rows = rows;
    s->made = 0;
    s->most = most;
    return plush_push_many(&s->toy, values, n, last_ms, period_us) == s->toy.answers - answered ? s->made : UINT32_MAX;
}

int seat_prime(void *p, uint32_t ms, const int32_t *values)
{
    ((seat *)p)->most = 0;
    return plush_prime(&((seat *)p)->toy, ms, values);
}

uint32_t seat_probability(void *p, uint8_t gesture)
{
    return plush_probability(&((seat *)p)->toy, gesture);
}

void seat_restart(void *p)
{
    plush_restart(&((seat *)p)->toy);
}

void seat_sensitivity(void *p, int sensitivity)
{
    ((seat *)p)->toy.sensitivity = (int8_t)sensitivity;
}

/* Every count as it is after nearly 2^32 of what it counts. */
void seat_age(void *p, uint32_t by)
{
    plush_toy *toy = &((seat *)p)->toy;

    toy->answers += by;
    toy->restarts += by;
    toy->invalid += by;
    toy->bad_stamps += by;
    toy->interpolated += by;
    toy->faults += by;
    toy->event.number += by;
    toy->answer.sample += by;
}

uint32_t seat_answers(void *p)
{
    return ((seat *)p)->toy.answers;
}

int seat_begin_again(void *p, const uint8_t *model, uint32_t bytes)
{
    seat *s = (seat *)p;
    uint32_t needed = plush_memory_bytes(model, bytes);

    s->model = (uint8_t *)realloc(s->model, bytes);
    memcpy(s->model, model, bytes);
    s->memory = (uint32_t *)realloc(s->memory, needed);
    s->memory_bytes = needed;
    s->frame = 0;
    s->rows = &s->ended[0][0];
    s->made = 0;
    s->most = 1;
    return (int)plush_begin(&s->toy, s->model, bytes, s->memory, needed);
}

/* Offers another model in the middle of a stream, in an allocation of just its bytes; its memory is that of the old one
 * where that is enough. What happens to an event is written to `rows`; returns how many there were, or UINT32_MAX when
 * a refusal changed a byte of the toy or its memory. */
uint32_t seat_swap(void *p, const uint8_t *model, uint32_t bytes, uint32_t too_few, int *status, int32_t *rows,
                   uint32_t most)
{
    seat *s = (seat *)p;
    uint8_t *copy = (uint8_t *)malloc(bytes ? bytes : 1), *before = (uint8_t *)malloc(s->memory_bytes + 1);
    plush_toy toy = s->toy;
    uint32_t *memory = s->memory, needed;
    int same;

    memcpy(copy, model, bytes);
    memcpy(before, s->memory, s->memory_bytes);
    needed = plush_memory_bytes(copy, bytes);
    if (needed > (1u << 26))
        needed = 0; /* a giant: refused */
    if (needed > s->memory_bytes) {
        memory = (uint32_t *)malloc(needed);
        memset(memory, 0xc3, needed);
    }
    s->rows = rows;
    s->made = 0;
    s->most = most;
    *status = (int)plush_swap(&s->toy, copy, bytes, memory, needed - (needed > 0 ? too_few : 0));
    if (*status == PLUSH_OK) {
        free(s->model);
        s->model = copy;
        free(s->patch); /* no longer read */
        s->patch = NULL;
        if (memory != s->memory) {
            free(s->memory);
            s->memory = memory;
            s->memory_bytes = needed;
        }
        free(before);
        return s->made;
    }
    same = memcmp(&toy, &s->toy, sizeof toy) == 0 && memcmp(before, s->memory, s->memory_bytes) == 0;
    if (memory != s->memory)
        free(memory);
    free(copy);
    free(before);
    return same && s->made == 0 ? 0 : UINT32_MAX;
}

/* Offers a patch in the middle of a stream, in an allocation of just its bytes, or none of no bytes. Returns the status,
 * or -1 when a refusal changed a byte of the toy or its memory. */
int seat_patch(void *p, const uint8_t *patch, uint32_t bytes)
{
    seat *s = (seat *)p;
    uint8_t *copy = patch == NULL ? NULL : (uint8_t *)malloc(bytes ? bytes : 1);
    uint8_t *before = (uint8_t *)malloc(s->memory_bytes + 1);
    plush_toy toy = s->toy;
    int status, same;

    if (copy != NULL)
        memcpy(copy, patch, bytes);
    memcpy(before, s->memory, s->memory_bytes);
    status = (int)plush_patch(&s->toy, copy, bytes);
    if (status == PLUSH_OK) {
        toy.dense = s->toy.dense;
        toy.dense_weights = s->toy.dense_weights;
        free(s->patch);
        s->patch = copy;
    } else {
        free(copy);
    }
    same = memcmp(&toy, &s->toy, sizeof toy) == 0 && memcmp(before, s->memory, s->memory_bytes) == 0;
    free(before);
    return same ? status : -1;
}

const char *seat_name(void *p, uint8_t gesture)
{
    return plush_gesture_name(&((seat *)p)->toy, gesture);
}

const char *seat_title(void *p)
{
    return plush_model_title(&((seat *)p)->toy);
}

uint32_t seat_made(void *p)
{
    return ((seat *)p)->made;
}

uint32_t seat_reading(void *p)
{
    return ((seat *)p)->toy.reading;
}

/* The small functions. */
uint32_t try_checksum(const uint8_t *bytes, uint32_t n) { return checksum(bytes, n); }
int32_t try_shift_down(int32_t v, uint32_t n) { return shift_down(v, n); }
int32_t try_as_signed(uint32_t v) { return as_signed(v); }
uint32_t try_root(uint64_t v) { return square_root(v); }
uint64_t try_square(int32_t v) { return square(v); }
uint32_t try_exponential(int32_t d) { return exponential(d); }
uint32_t try_requantize(int32_t sum, const uint8_t *scale) {
    return requantize(sum, le16(scale + 4), scale[6], scale[7]);
}
uint32_t try_part_of(uint32_t distance, uint32_t into, uint32_t by, uint32_t add, uint32_t narrow)
{
    return part_of(distance, into, by, add, narrow);
}

#ifdef ALONE
static seat *s; /* reachable at the end, for the sanitizer of leaks */

static uint32_t word(FILE *f)
{
    uint8_t b[4];

    if (fread(b, 1, 4, f) != 4)
        exit(0);
    return le32(b);
}

#define OFFERED 16u
#define MOST_BYTES 65536u
#define MOST_ROWS_ONCE 256u

static uint32_t drawn = 2463534242u;

/* A random number below `n`. */
static uint32_t draw(uint32_t n)
{
    drawn ^= drawn << 13;
    drawn ^= drawn >> 17;
    drawn ^= drawn << 5;
    return drawn % n;
}

/* An image as a bad transfer, another toy or another version leaves it, in `out`; returns its bytes. `whole` is the image
 * that it was made of, and stays it (but for the memory that `too_few` keeps back) only if this sets `sound`. */
static uint32_t spoil(uint8_t *out, const uint8_t *whole, uint32_t bytes, uint32_t *too_few, int *sound)
{
    uint32_t i, at, n;

    memcpy(out, whole, bytes);
    *too_few = 0;
    *sound = 0;
    switch (draw(8)) {
    case 0: /* an image for other channels or of another version; but seldom one that may take over */
        *sound = 1;
        *too_few = draw(16) == 0 ? 0 : 1 + draw(9);
        return bytes;
    case 1: /* bits that are wrong */
        for (i = draw(3) + 1, at = draw(8 * bytes); i > 0; i--, at = (at + 1 + draw(bytes)) % (8 * bytes))
            out[at / 8] = (uint8_t)(out[at / 8] ^ (1u << at % 8));
        return bytes;
    case 2: /* what has not come yet, as erased flash or not at all */
        at = draw(bytes);
        memset(out + at, 0xff, bytes - at);
        return draw(2) == 0 && memcmp(out, whole, bytes) != 0 ? bytes : at;
    case 3: /* older and newer ones; two more is the version with deviations */
        out[4] = (uint8_t)(PLUSH_IMAGE_VERSION + (draw(2) == 0 ? 3 + draw(97) : 256 - 1 - draw(PLUSH_IMAGE_VERSION)));
        return bytes;
    case 4: /* a piece that comes twice, or not, and all after it in the wrong place */
        at = HEAD_BYTES + draw(bytes - HEAD_BYTES - 8);
        n = 1 + draw(bytes - at - 2);
        memmove(out + at, out + at + 1, n);
        out[at + n] = (uint8_t)(whole[at + n] ^ (1u + draw(255)));
        return bytes;
    case 5: /* something else */
        for (i = 0; i < bytes; i++)
            out[i] = (uint8_t)draw(256);
        if (draw(2) == 0)
            memcpy(out, whole, draw(13));
        return bytes;
    case 6: /* another length or checksum in its head */
        out[8 + draw(8)] ^= (uint8_t)(1u + draw(255));
        return bytes;
    default: /* nothing, or less than a head */
        return draw(HEAD_BYTES);
    }
}

/* `offers` images, most of them spoilt, between the frames of one toy; another toy reads the same frames and is offered
 * only what takes over. The first case is the model with its frames; the others are images, with as many frames of no
 * column as is the status that they deserve. Ends with status 3 when a refusal changes a byte, 4 when a wrong image is
 * taken or a sound one has another status, 5 when a swap does not end the open event once, or ends one where none is open,
 * 6 when the two say something else, 7 when an event begins in another, ends without one or has not the next number. Writes
 * how many frames, events, ends by a swap, and offers by status there were. */
static int drill(FILE *f, uint32_t offers)
{
    static uint8_t images[OFFERED][MOST_BYTES], image[MOST_BYTES];
    static int32_t rows[2][MOST_ROWS_ONCE * (HEAD + 2u * 255u)], swapped[2][4u * (HEAD + 2u * 255u)];
    uint32_t sizes[OFFERED], deserved[OFFERED], n = 0, frames = 0, columns = 0, i, k, told[3 + 7] = {0}, open = 0, at = 0, offered = 0;
    static int32_t *stream; /* reachable after an early end, for the sanitizer of leaks */
    static seat *toys[2];
    int status;

    for (; n < OFFERED && fread(&sizes[n], 4, 1, f) == 1; n++) {
        uint32_t shape[2];
        int32_t *read;

        if (sizes[n] > MOST_BYTES || fread(images[n], 1, sizes[n], f) != sizes[n] || fread(shape, 4, 2, f) != 2)
            return 2;
        read = (int32_t *)malloc((size_t)4 * shape[0] * shape[1] + 4);
        if (fread(read, 4, (size_t)shape[0] * shape[1], f) != (size_t)shape[0] * shape[1])
            return 2;
        deserved[n] = n > 0 ? shape[0] : PLUSH_OK;
        if (n > 0) {
            free(read);
            continue;
        }
        stream = read;
        frames = shape[0];
        columns = shape[1];
    }
    for (i = 0; i < 2; i++)
        toys[i] = (seat *)seat_new(images[0], sizes[0], &status, 0, 0);
    for (; offered < offers; at = (at + 1) % frames) {
        for (k = draw(5) == 0 ? draw(24) : 0; k > 0; k--) {
            uint32_t of = draw(n), too_few, made[2];
            int sound, other;
            uint32_t bytes = spoil(image, images[of], sizes[of], &too_few, &sound);

            made[0] = seat_swap(toys[0], image, bytes, too_few, &status, swapped[0], 4);
            offered++;
            told[3 + status]++;
            if (made[0] == UINT32_MAX)
                return 3;
            if (sound ? too_few == 0 && (uint32_t)status != deserved[of] : status == PLUSH_OK)
                return 4;
            if (status != PLUSH_OK)
                continue;
            if (made[0] != open || (open && (swapped[0][4] != PLUSH_ENDED || (uint32_t)swapped[0][3] != told[1])))
                return 5;
            told[2] += open;
            open = 0;
            made[1] = seat_swap(toys[1], image, bytes, too_few, &other, swapped[1], 4);
            if (made[1] != made[0] || memcmp(swapped[0], swapped[1], 4u * made[0] * HEAD) != 0)
                return 6;
        }
        for (i = 0; i < 2; i++)
            seat_push(toys[i], stream + (size_t)at * columns, 1, columns - 1, rows[i], MOST_ROWS_ONCE, NULL, 0);
        told[0]++;
        k = HEAD + 2u * toys[0]->toy.classes;
        if (toys[0]->made != toys[1]->made || memcmp(rows[0], rows[1], (size_t)4 * k * toys[0]->made) != 0)
            return 6;
        for (i = 0; i < toys[0]->made; i++) {
            const int32_t *row = rows[0] + (size_t)k * i;

            if (row[0] != 1)
                continue;
            told[1] += row[4] == PLUSH_BEGUN;
            if (open != (row[4] != PLUSH_BEGUN) || (uint32_t)row[3] != told[1])
                return 7;
            open = row[4] != PLUSH_ENDED;
        }
    }
    for (i = 0; i < 2; i++)
        seat_free(toys[i]);
    free(stream);
    fwrite(told, 4, sizeof told / 4, stdout);
    return 0;
}

/* Cases, one after the other: bytes of the model, the model, frames, columns, the frames. Writes of each: status,
 * answers, and the answers' rows. With a second argument the first toy whose model is good goes on with all further
 * cases, and is offered their models, or with `patch` as the second argument their patches. With `drill` and a number
 * see drill(). */
int main(int argc, char **argv)
{
    FILE *f = argc > 1 ? fopen(argv[1], "rb") : NULL;

    if (f == NULL)
        return 2;
    if (argc > 3 && strcmp(argv[2], "drill") == 0) {
        int found = drill(f, (uint32_t)strtoul(argv[3], NULL, 10));

        fclose(f);
        return found;
    }
    for (;;) {
        uint32_t bytes = word(f), n, columns, told = 0, fit, width;
        uint8_t *model = (uint8_t *)malloc(bytes ? bytes : 1);
        int32_t *frames, *rows, ended[HEAD + 2u * 255u];
        int status;

        if (fread(model, 1, bytes, f) != bytes)
            return 2;
        n = word(f);
        columns = word(f);
        frames = (int32_t *)malloc((size_t)4 * n * columns + 4);
        if (fread(frames, 4, (size_t)n * columns, f) != (size_t)n * columns)
            return 2;
        if (s == NULL)
            s = (seat *)seat_new(model, bytes, &status, 0, 0);
        else if (strcmp(argv[2], "patch") == 0)
            status = seat_patch(s, model, bytes);
        else if (seat_swap(s, model, bytes, 0, &status, ended, 1) == UINT32_MAX)
            return 3;
        free(model);
        width = HEAD + 2u * s->toy.classes;
        rows = (int32_t *)malloc((size_t)4 * width * 16384);
        /* A damaged model may have more channels than the frames. */
        fit = s->toy.channels + 1u > columns ? 0 : n;
        seat_push(s, frames, fit, columns - 1, rows, 16384, NULL, 0);
        for (n = 0; n < s->toy.classes; n++)
            told += (uint32_t)(plush_gesture_name(&s->toy, (uint8_t)n)[0] == 1);
        told += (uint32_t)(plush_model_title(&s->toy)[0] == 1);
        if (told == UINT32_MAX)
            return 2;
        fwrite(&status, 4, 1, stdout);
        fwrite(&s->made, 4, 1, stdout);
        fwrite(rows, 4, (size_t)width * s->made, stdout);
        free(frames);
        free(rows);
        if (argc < 3 || s->toy.held == NULL) {
            seat_free(s);
            s = NULL;
        }
    }
}
#endif
