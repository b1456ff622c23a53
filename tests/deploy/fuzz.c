/* Entry points of the C library for libFuzzer: models (of the library for self-calibration, too), frames, swaps and
 * patches, and lines. PLUSHSENSE_ENTRY chooses one by its first letter (m, c, f, s, p, l), and PLUSHSENSE_MODEL is the image that toys run. With FILES it is a program
 * that tries each of the files given to it once. */
#include "toy.c"
#include "plush_wire.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define MOST_IMAGE 65536u
#define MOST_INPUT 16384u
#define ROWS 512u
#define MOST_CHANNELS 255u

static uint8_t base[MOST_IMAGE];
static uint32_t base_bytes;
static int entry;
static int32_t rows[ROWS * (HEAD + 2u * 255u)], given[64 * (1 + MOST_CHANNELS)];

static void fail(void)
{
    abort();
}

static void start(void)
{
    FILE *f = fopen(getenv("PLUSHSENSE_MODEL"), "rb");

    entry = getenv("PLUSHSENSE_ENTRY")[0];
    if (f == NULL)
        fail();
    base_bytes = (uint32_t)fread(base, 1, sizeof base, f);
    fclose(f);
}

static void put32(uint8_t *at, uint32_t value)
{
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
    at[2] = (uint8_t)(value >> 16);
    at[3] = (uint8_t)(value >> 24);
}

/* Makes the length and the checksum in a head right, so that what follows is looked at. */
static void seal(uint8_t *image, uint32_t bytes)
{
    if (bytes < HEAD_BYTES)
        return;
    put32(image + 8, bytes);
    put32(image + 12, checksum(image + HEAD_BYTES, bytes - HEAD_BYTES));
}

/* Frames from bytes: small steps of the clock, values of one byte, some of four. Returns how many there are. */
static uint32_t frames_of(const uint8_t *data, uint32_t size, uint32_t channels)
{
    static uint32_t now;
    uint32_t n = 0, i, at = 0;

    while (n < 64 && at < size) {
        int32_t *frame = given + (size_t)n++ * (1 + channels);
        uint8_t how = data[at++];

        now += how < 250 ? how % 16u : how < 253 ? 1000u : how < 255 ? 0u - 5000u : 0x7fffffffu;
        frame[0] = (int32_t)now;
        for (i = 0; i < channels; i++) {
            if (at + 5 <= size && data[at] == 0x80) {
                frame[1 + i] = (int32_t)le32(data + at + 1);
                at += 5;
            } else {
                frame[1 + i] = at < size ? (int32_t)data[at] * 64 - 8192 : 0;
                at += at < size;
            }
        }
    }
    return n;
}

static void push(seat *s, const uint8_t *data, uint32_t size)
{
    uint32_t n = frames_of(data, size, s->toy.channels), silence = 20;

    if (seat_push(s, given, n, s->toy.channels, rows, ROWS, &silence, 1) == UINT32_MAX)
        fail();
    s->frame = 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size_)
{
    static seat *running; /* goes from input to input, as a toy does */
    static uint8_t image[MOST_INPUT];
    static plush_wire wire;
    uint32_t size = size_ < MOST_INPUT ? (uint32_t)size_ : MOST_INPUT, i;
    int status = 0;

    if (base_bytes == 0)
        start();
    if (entry == 'l') {
        uint32_t ms;
        int32_t values[PLUSH_MODEL_CHANNELS];

        for (i = 0; i < size; i++)
            (void)plush_wire_read(&wire, (char)data[i], &ms, values);
        return 0;
    }
    memcpy(image, data, size);
    if (size > 0 && image[size - 1] % 8 != 0)
        seal(image, size);
    if (entry == 'm' || entry == 'c') {
        seat *s = (seat *)seat_new(image, size, &status, 0, 0);

        if (status == PLUSH_OK) {
            push(s, data, size < 256 ? size : 256);
            for (i = 0; i < s->toy.classes; i++)
                (void)strlen(seat_name(s, (uint8_t)i));
            (void)strlen(seat_title(s));
        }
        seat_free(s);
        return 0;
    }
    if (running == NULL)
        running = (seat *)seat_new(base, base_bytes, &status, 0, 0);
    if (entry == 'f') {
        push(running, data, size);
        if (size > 0 && data[0] == 0xff)
            seat_restart(running);
    } else if (entry == 's') {
        push(running, data, size < 64 ? size : 64);
        if (seat_swap(running, image, size, size > 9 ? data[9] % 2u : 0, &status, rows, ROWS) == UINT32_MAX)
            fail();
    } else if (entry == 'p') {
        push(running, data, size < 64 ? size : 64);
        if (seat_patch(running, size > 0 && data[0] == 0 ? NULL : image, size) < 0)
            fail();
    } else {
        fail();
    }
    return 0;
}

#ifdef FILES
int main(int argc, char **argv)
{
    static uint8_t data[MOST_INPUT];
    int n;

    for (n = 1; n < argc; n++) {
        FILE *f = fopen(argv[n], "rb");

        if (f == NULL)
            return 2;
        LLVMFuzzerTestOneInput(data, fread(data, 1, sizeof data, f));
        fclose(f);
    }
    return 0;
}
#endif
