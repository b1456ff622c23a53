/*
 * PlushSense: what a soft toy feels, in whole numbers. See plushsense.h for how to use it.
 *
 * From top to bottom: small arithmetic - reading the model - what differs from core to core - layers - pooling, dense
 * layer, probabilities - events - health - inputs, samples and frames - the functions that others call.
 *
 * Every rule here is stated in PlushSense's Python too (windows/clock, windows/features, runtime/fixed,
 * runtime/vectors, runtime/integer, runtime/events, runtime/gate, runtime/health), which defines what is right.
 */
#include "plushsense.h"

#include <stddef.h>
#include <string.h>

#define GROUP 4u            /* filters computed together, channels read together */
#define HEAD_BYTES 16u
#define SHAPE_BYTES 28u     /* the first section of a model: how many of what */
#define SCALE_BYTES 8u      /* bias, multiplier and two shifts of one filter */
#define RANGE_BYTES 12u     /* lowest and highest valid value of a channel, and its zero */
#define INPUT_BYTES 12u     /* offset, bias, multiplier and two shifts of one channel of the network */
#define LOGIT_LIMIT 16384
#define SPARE 4u            /* rows for new samples, before those under the taps move */
#define WEIGHT_ZERO 128u    /* weights are stored with this added: some cores cannot load a signed byte */

/* Not copied to where it is called: for the registers of a loop, or for the flash. */
#if defined(__GNUC__)
#define PLUSH_APART __attribute__((noinline)) PLUSH_CODE
#define PLUSH_SMALL_APART __attribute__((noinline, cold))
#define PLUSH_SMALL __attribute__((cold)) /* compiled for size */
#else
#define PLUSH_APART PLUSH_CODE
#define PLUSH_SMALL_APART
#define PLUSH_SMALL
#endif

/* Where the code of a step, and its tables, are placed: nothing, or an attribute such as IRAM_ATTR and DRAM_ATTR. */
#ifndef PLUSH_CODE
#define PLUSH_CODE
#endif
#ifndef PLUSH_CONST
#define PLUSH_CONST
#elif defined(__AVR__) || (defined(ESP8266) && !defined(NON32XFER_HANDLER))
#error "The library reads constants with plain loads of bytes, which cannot read this chip's flash: leave out PLUSH_CONST."
#endif

/* What a model may ask for, so that every sum, size and address below is sure to fit. */
#define MOST_UNITS (UINT32_C(1) << 22) /* of the clock's gap and period: see part_of() */
#define MOST_UNITS_PER_MS 1000u
#define MOST_BRIDGED 1000u             /* samples in a gap, as nobody can wait longer for plush_push() */
#define MOST_STEP 257u                 /* 257 x 255 is the most that 16 bits hold */
#define MOST_ROWS 65531u /* and SPARE more */
#define MOST_FILTERS 4096u
#define MOST_SHIFT 30u
#define MOST_INPUT_SHIFT 16u
#define MOST_MULTIPLIER 32767u
#define MOST_INPUT_BIAS (INT32_C(1) << 30)
#define MOST_HEALTH_MS 60000u
#define MOST_VECTORS 8u
#define MOST_KERNELS 64u
#define MOST_TAPS 255u
#define MOST_AXIS_SHIFT 16u
#define MOST_MEAN_SHIFT 15u
#define MOST_GRAVITY (UINT32_C(1) << 19) /* so that a running mean and its changes fit 32 bits */

/* How an input comes from the measured channels. */
enum { CHANNEL = 0, MAGNITUDE = 1, GRAVITY = 2 };

/* Running means have 10 fraction bits, and are given with 4. Unit vectors have 14. */
#define MEAN_BITS 10u
#define MEAN_SHOWN_BITS 4u
#define UNIT_BITS 14u
#define AXIS_LIMIT 32767

/* What stands where in the plan of events, each of 16 bits. */
enum {
    ENTER = 0,
    LEAVE = 2,
    ENTER_AFFECT = 4,
    LEAVE_AFFECT = 6,
    SURE = 8,
    KNOWN = 10,
    LEAST = 12,
    SWITCH = 14,
    END = 16,
    HOLD = 18,
    REST = 20,
    WAIT = 22,
    EVENT_BYTES = 24
};

/* And in that of health; after the times, whether there are limits. */
enum { FAULT_MS = 0, STILL_MS = 2, RECOVER_MS = 4, LIMITS = 6, HEALTH_BYTES = 8 };

/* In the gate's plan: a rule without its terms (terms, affect, gesture, within, deaf), and a term (signal, sign, times,
 * 0, threshold). */
#define RULE_BYTES 6u
#define TERM_BYTES 8u
#define SIGN_ABOVE 1u
#define SIGN_BELOW 255u
#define GATE_HELD (INT32_C(1) << 20)
#define GATE_DOUBT 10u /* suspect samples in a row, after which it begins anew */
#define MOST_GATE_SIGNALS 32u
#define MOST_GATE_RULES 16u
#define MOST_GATE_TERMS 8u
#define MOST_GATE_LAG 16u
#define MOST_GATE_SHIFT 24u
#define MOST_GATE_WEIGHT 15u
#define MOST_GATE_SIZE (UINT32_C(32) << 20) /* 16 times a deviation of 2^21 over a floor of 1 */

/* What the gate remembers of a signal: baseline and noise with 8 more bits; the size has the deviation's sign. */
enum { BASELINE, NOISE, SIZE, SIGNAL_WORDS };

/* How a class is told: its affect, and whether it is idle. */
#define TOLD_AFFECT 3u
#define TOLD_IDLE 4u

#define KEPT_BYTES offsetof(plush_toy, layers) /* of a toy, when its model is another one */

struct plush_aligned {
    uint8_t byte;
    uint32_t word;
};

/* ---- Small arithmetic ------------------------------------------------------------------------------------------ */

static uint32_t le16(const uint8_t *p)
{
    return (uint32_t)p[0] | ((uint32_t)p[1] << 8);
}

PLUSH_CODE
static uint32_t le32(const uint8_t *p)
{
    return le16(p) | (le16(p + 2) << 16);
}

/* The same at a multiple of 4. */
#if defined(__GNUC__) && defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
__attribute__((always_inline)) /* also where one debugs */
static inline uint32_t aligned_le32(const uint8_t *p)
{
    uint32_t v;

    __builtin_memcpy(&v, __builtin_assume_aligned(p, GROUP), sizeof v);
    return v;
}
#else
#define aligned_le32 le32
#endif

/* The number with these bits in two's complement. */
static int32_t as_signed(uint32_t bits)
{
    return bits <= INT32_MAX ? (int32_t)bits : -(int32_t)(UINT32_MAX - bits) - 1;
}

static int is_aligned(const void *p)
{
    return (uintptr_t)p % offsetof(struct plush_aligned, word) == 0;
}

static uint32_t bits_of(int32_t v)
{
    return (uint32_t)v;
}

/* Floor division by 2^n, also of negative numbers. */
static int32_t shift_down(int32_t v, uint32_t n)
{
    return v >= 0 ? v >> n : ~(~v >> n);
}

/* The same of a word in two's complement: GCC says that it keeps the bits and shifts the sign in, and where it inlines
 * nothing (-Og) the functions would take most of the time. */
#ifdef __GNUC__
#define PLUSH_DOWN(v, n) ((uint32_t)((int32_t)(v) >> (n)))
#else
#define PLUSH_DOWN(v, n) bits_of(shift_down(as_signed(v), n))
#endif

static int32_t within(int32_t v, int32_t low, int32_t high)
{
    return v < low ? low : v > high ? high : v;
}

/* The setting `known` of a plan of events. */
static int32_t known_least(const uint8_t *plan)
{
    int32_t bits = (int32_t)le16(plan + KNOWN);

    return bits < 32768 ? bits : bits - 65536;
}

static uint32_t half(uint32_t shift)
{
    return (UINT32_C(1) << shift) >> 1;
}

/* floor((distance * into + add) / by) for into <= by <= 2 MOST_UNITS and add <= by / 2. The product may need more than
 * 32 bits: then it is divided by hand, a byte of the distance at a time (`rest` stays below 2^8 by + 2^8 into). */
PLUSH_APART
static uint32_t part_of(uint32_t distance, uint32_t into, uint32_t by, uint32_t add, uint32_t narrow)
{
    uint32_t quotient = 0, rest = 0, place;

    if (distance <= narrow)
        return (distance * into + add) / by;
    for (place = 4; place > 0; place--, distance <<= 8) {
        rest = (rest << 8) + (distance >> 24) * into;
        quotient = (quotient << 8) + rest / by;
        rest %= by;
    }
    return quotient + (rest + add) / by;
}

PLUSH_APART
static int same(const int32_t *one, const int32_t *other, uint32_t n)
{
    while (n > 0 && *one == *other) {
        one++;
        other++;
        n--;
    }
    return n == 0;
}

static uint64_t square(int32_t v)
{
    uint32_t size = v < 0 ? 0u - (uint32_t)v : (uint32_t)v;
    uint32_t high = size >> 16, low = size & 0xffffu;

    return ((uint64_t)(high * high) << 32) + ((uint64_t)(high * low) << 17) + (uint64_t)(low * low);
}

static uint32_t square_root(uint64_t v)
{
    uint64_t root = 0, bit = UINT64_C(1) << 62;

    while (bit > v)
        bit >>= 2;
    for (; bit != 0; bit >>= 2) {
        if (v >= root + bit) {
            v -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return (uint32_t)root;
}

/* The square root, rounded down. */
PLUSH_CODE
static uint32_t short_root(uint32_t v)
{
    uint32_t root = 0, bit = UINT32_C(1) << 30;

    while (bit > v)
        bit >>= 2;
    for (; bit != 0; bit >>= 2) {
        if (v >= root + bit) {
            v -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return root;
}

static uint32_t distance_of(int32_t one, int32_t other)
{
    return one >= other ? (uint32_t)one - (uint32_t)other : (uint32_t)other - (uint32_t)one;
}

PLUSH_SMALL_APART
static uint32_t word_at(const uint8_t *p)
{
    return le32(p);
}

/* ---- The model ------------------------------------------------------------------------------------------------- */

/* CRC-32, as zip and Ethernet have it, four bits at a time. */
PLUSH_SMALL_APART
static uint32_t checksum(const uint8_t *bytes, uint32_t n)
{
    static const uint32_t table[16] = {
        UINT32_C(0x00000000), UINT32_C(0x1db71064), UINT32_C(0x3b6e20c8), UINT32_C(0x26d930ac),
        UINT32_C(0x76dc4190), UINT32_C(0x6b6b51f4), UINT32_C(0x4db26158), UINT32_C(0x5005713c),
        UINT32_C(0xedb88320), UINT32_C(0xf00f9344), UINT32_C(0xd6d6a3e8), UINT32_C(0xcb61b38c),
        UINT32_C(0x9b64c2b0), UINT32_C(0x86d3d2d4), UINT32_C(0xa00ae278), UINT32_C(0xbdbdf21c)
    };
    uint32_t sum = UINT32_MAX;

    for (; n > 0; n--) {
        sum ^= *bytes++;
        sum = (sum >> 4) ^ table[sum & 15u];
        sum = (sum >> 4) ^ table[sum & 15u];
    }
    return ~sum;
}

/* Whether the dense layer of a model reads deviations, too. */
PLUSH_SMALL static int deviates(const uint8_t *model)
{
    return word_at(model + 4) == PLUSH_IMAGE_VERSION + 2;
}

/* A model, or a patch of one: they begin with the same head but for its first four bytes. */
PLUSH_SMALL_APART
static plush_status check(const uint8_t *model, uint32_t bytes, const char *magic)
{
    if (model == NULL || bytes < HEAD_BYTES || memcmp(model, magic, 4) != 0)
        return PLUSH_NOT_A_MODEL;
    if (word_at(model + 4) != PLUSH_IMAGE_VERSION && !deviates(model)) /* 16 bits, and 16 zeros */
        return PLUSH_OTHER_VERSION;
    if (word_at(model + 8) > bytes || word_at(model + 8) <= HEAD_BYTES ||
        checksum(model + HEAD_BYTES, word_at(model + 8) - HEAD_BYTES) != word_at(model + 12))
        return PLUSH_DAMAGED;
    return PLUSH_OK;
}

/* How many numbers the dense layer reads: of each feature the mean, and for some models the deviation. */
static uint32_t pooled(const plush_toy *toy)
{
    return (uint32_t)toy->features << toy->deviations;
}

PLUSH_SMALL static uint32_t fill_up(uint32_t n)
{
    return (n + GROUP - 1) / GROUP * GROUP;
}

/* What is left to read of a model. */
typedef struct {
    const uint8_t *at;
    uint32_t left;
} source;

/* The next bytes of a model; NULL when it has not so many. */
PLUSH_SMALL static const uint8_t *next_bytes(source *from, uint32_t bytes)
{
    const uint8_t *start = from->at;

    if (bytes > from->left)
        return NULL;
    from->at += bytes;
    from->left -= bytes;
    return start;
}

/* A piece of the memory; only reckoned while there is none. */
PLUSH_SMALL static void *take(uint8_t *memory, uint32_t *used, uint32_t bytes)
{
    void *piece = memory == NULL ? NULL : memory + *used;

    *used += fill_up(bytes);
    return piece;
}

/* Sensors that find their offset and scale themselves need code and memory; all others are read as they are. */
#ifdef PLUSH_CALIBRATE
#include "plush_calibrate.h"
#else
#define read_sensors(toy, from) 1
#define share_sensors(toy, memory, used) ((void)0)
#define begin_sensors(toy) ((void)0)
#define calibrate(toy) ((void)0)
#endif

/* Zeros, up to a multiple of 4 bytes: what follows may be loaded in words. */
PLUSH_SMALL static int next_fill(source *from)
{
    while ((uintptr_t)from->at % GROUP != 0) {
        const uint8_t *fill = next_bytes(from, 1);

        if (fill == NULL || *fill != 0)
            return 0;
    }
    return 1;
}

/* The next text of a model; NULL when it does not end. */
PLUSH_SMALL static const uint8_t *next_text(source *from)
{
    const uint8_t *start = from->at;

    while (from->left > 0) {
        from->left--;
        if (*from->at++ == 0)
            return start;
    }
    return NULL;
}

/* The scales of so many filters or classes. */
PLUSH_SMALL static const uint8_t *next_scales(source *from, uint32_t n)
{
    const uint8_t *scales = next_bytes(from, SCALE_BYTES * n), *scale = scales;

    if (scales == NULL)
        return NULL;
    for (; n > 0; n--, scale += SCALE_BYTES)
        if (le16(scale + 4) > MOST_MULTIPLIER || scale[6] > MOST_SHIFT || scale[7] > MOST_SHIFT)
            return NULL;
    return scales;
}

PLUSH_SMALL static int read_head(plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, SHAPE_BYTES);
    uint32_t i;

    if (p == NULL)
        return 0;
    toy->layers = p[0];
    toy->channels = p[1];
    toy->inputs = p[2];
    toy->classes = p[3];
    toy->step = (uint16_t)le16(p + 4);
    toy->blocks = (uint16_t)le16(p + 6);
    toy->span = word_at(p + 8);
    toy->period = word_at(p + 12);
    toy->gap = word_at(p + 16);
    toy->units_per_ms = word_at(p + 20);
    toy->smoothing = (uint16_t)le16(p + 24);
    toy->layout = (uint16_t)le16(p + 26);
    toy->ranges = next_bytes(from, RANGE_BYTES * toy->channels);
    if (toy->layers == 0 || toy->layers > PLUSH_MAX_LAYERS || toy->channels == 0 || toy->inputs == 0 ||
        toy->classes == 0 || toy->step == 0 || toy->step > MOST_STEP || toy->blocks == 0 || toy->period == 0 ||
        toy->period > MOST_UNITS || toy->gap == 0 || toy->gap > MOST_UNITS || toy->gap / toy->period > MOST_BRIDGED ||
        toy->units_per_ms == 0 || toy->units_per_ms > MOST_UNITS_PER_MS ||
        toy->smoothing == 0 || toy->smoothing > PLUSH_ONE || toy->ranges == NULL)
        return 0;
    toy->narrow = (UINT32_MAX - toy->gap) / (2 * toy->gap);
    for (i = 0; i < toy->channels; i++) {
        const uint8_t *range = toy->ranges + RANGE_BYTES * i;
        int32_t low = as_signed(word_at(range)), high = as_signed(word_at(range + 4)), zero = as_signed(word_at(range + 8));

        if ((low < zero && distance_of(low, zero) > UINT32_C(1) << 31) ||
            (high > zero && distance_of(high, zero) > (uint32_t)INT32_MAX))
            return 0;
    }
    return 1;
}

/* Whether a running mean of this channel fits 32 bits. */
PLUSH_SMALL static int mean_fits(const plush_toy *toy, uint32_t channel)
{
    const uint8_t *range = toy->ranges + RANGE_BYTES * channel;
    int32_t zero = as_signed(word_at(range + 8));

    return distance_of(as_signed(word_at(range)), zero) <= MOST_GRAVITY &&
           distance_of(as_signed(word_at(range + 4)), zero) <= MOST_GRAVITY;
}

PLUSH_SMALL static int read_input_plan(plush_toy *toy, source *from)
{
    uint32_t i, n;

    toy->input_plan = from->at;
    toy->means = 0;
    for (i = 0; i < toy->inputs; i++) {
        const uint8_t *head = next_bytes(from, 3);
        const uint8_t *parts = head == NULL ? NULL : next_bytes(from, head[1]);

        if (parts == NULL || head[0] > GRAVITY || head[1] == 0 || (head[0] != MAGNITUDE && head[1] != 1) ||
            head[2] > (head[0] == GRAVITY ? MOST_MEAN_SHIFT : 0u))
            return 0;
        for (n = 0; n < head[1]; n++)
            if (parts[n] >= toy->channels)
                return 0;
        if (head[0] == GRAVITY) {
            if (!mean_fits(toy, parts[0]))
                return 0;
            toy->means++;
        }
    }
    return 1;
}

/* One kernel of a vector layer; its sums are sure to fit. */
PLUSH_SMALL static int read_kernel(const plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, 1u + toy->vector_taps);
    uint32_t sum = 0, n;

    if (p == NULL || p[0] > MOST_SHIFT)
        return 0;
    for (n = 1; n <= toy->vector_taps; n++)
        sum += p[n] >= WEIGHT_ZERO ? p[n] - WEIGHT_ZERO : WEIGHT_ZERO - p[n];
    return p[0] + UNIT_BITS > 31 || sum * (uint32_t)AXIS_LIMIT <= UINT32_C(1) << (p[0] + UNIT_BITS);
}

/* The vector layer, if there is one, and the scales of what the first layer reads. */
PLUSH_SMALL static int read_vectors(plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, 4), *scale;
    uint32_t i;

    if (p == NULL)
        return 0;
    toy->vectors = p[0];
    toy->vector_kernels = p[1];
    toy->vector_taps = (uint8_t)p[2];
    toy->vector_plan = from->at;
    toy->features = toy->inputs;
    if (toy->vectors == 0) {
        if (p[1] != 0 || p[2] != 0 || p[3] != 0)
            return 0;
    } else {
        uint32_t axes = 3u * toy->vectors + 3u, v, k;

        if (toy->vectors > MOST_VECTORS || p[1] < 2 || p[1] > MOST_KERNELS || p[2] == 0 || p[3] != 0 ||
            toy->inputs < axes)
            return 0;
        toy->features = (uint16_t)(toy->inputs - axes + toy->vectors * 3u * toy->vector_kernels);
        for (v = 0; v < toy->vectors; v++) {
            const uint8_t *shift = next_bytes(from, 1);

            if (shift == NULL || *shift > 2 * MOST_AXIS_SHIFT)
                return 0;
            for (k = 0; k < toy->vector_kernels; k++)
                if (!read_kernel(toy, from))
                    return 0;
        }
    }
    if (!next_fill(from))
        return 0;
    toy->input_scales = scale = next_bytes(from, INPUT_BYTES * toy->features);
    if (scale == NULL)
        return 0;
    for (i = 0; i < toy->features; i++, scale += INPUT_BYTES) {
        int32_t bias = as_signed(word_at(scale + 4));

        if (bias < -MOST_INPUT_BIAS || bias >= MOST_INPUT_BIAS || le16(scale + 8) > MOST_MULTIPLIER ||
            scale[10] > MOST_INPUT_SHIFT || scale[11] > MOST_SHIFT)
            return 0;
    }
    return 1;
}

/* A layer that reads so many channels. */
PLUSH_SMALL static int read_layer(plush_layer *layer, uint32_t channels, source *from)
{
    const uint8_t *p = next_bytes(from, 8);
    uint32_t row = fill_up(channels), filters, rows;

    if (p == NULL)
        return 0;
    filters = le16(p + 6);
    if (le16(p) == 0 || le16(p + 2) == 0 || le16(p + 4) != channels || filters == 0 || filters > MOST_FILTERS)
        return 0;
    layer->kernel = (uint16_t)le16(p);
    layer->dilation = (uint16_t)(layer->kernel > 1 ? le16(p + 2) : 1u);
    rows = layer->kernel - 1u;
    rows = rows * layer->dilation + 1u;
    layer->scales = next_scales(from, filters);
    if (rows > MOST_ROWS || layer->scales == NULL || layer->kernel * row > from->left / fill_up(filters))
        return 0;
    layer->groups = (uint16_t)(row / GROUP);
    layer->filters = (uint16_t)filters;
    layer->row = layer->kernel;
    layer->weights = next_bytes(from, layer->kernel * row * fill_up(filters));
    return 1;
}

PLUSH_SMALL static int read_dense_and_names(plush_toy *toy, source *from)
{
    uint32_t i;

    toy->dense = next_scales(from, toy->classes);
    toy->dense_weights = next_bytes(from, toy->classes * pooled(toy));
    toy->classes_told = next_bytes(from, toy->classes);
    if (toy->dense == NULL || toy->dense_weights == NULL || toy->classes_told == NULL)
        return 0;
    for (i = 0; i < toy->classes; i++)
        if (toy->classes_told[i] > (TOLD_IDLE | TOLD_AFFECT) || next_text(from) == NULL)
            return 0;
    return next_text(from) != NULL;
}

PLUSH_SMALL static int read_event_plan(plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, EVENT_BYTES);
    uint32_t at;

    toy->event_plan = p;
    if (p == NULL || le16(p + LEAST) == 0 || le16(p + SWITCH) == 0 || le16(p + END) == 0)
        return 0;
    for (at = ENTER; at <= SURE; at += 2)
        if (le16(p + at) > PLUSH_ONE + 1)
            return 0;
    return known_least(p) >= -LOGIT_LIMIT && known_least(p) <= LOGIT_LIMIT;
}

PLUSH_SMALL static int read_health_plan(plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, HEALTH_BYTES);
    uint32_t i;

    toy->health_plan = p;
    if (p == NULL || le16(p + FAULT_MS) > MOST_HEALTH_MS || le16(p + STILL_MS) > MOST_HEALTH_MS ||
        le16(p + RECOVER_MS) > MOST_HEALTH_MS || p[LIMITS] > 1 || p[LIMITS + 1] != 0)
        return 0;
    toy->limits = NULL;
    if (p[LIMITS] == 0)
        return 1;
    toy->limits = next_bytes(from, 8u * toy->channels);
    if (toy->limits == NULL)
        return 0;
    for (i = 0; i < toy->channels; i++)
        if (as_signed(word_at(toy->limits + 8 * i)) > as_signed(word_at(toy->limits + 8 * i + 4)))
            return 0;
    return 1;
}

/* The gate's signals: what is watched, and how. */
PLUSH_SMALL static int read_signal(plush_toy *toy, source *from)
{
    const uint8_t *head = next_bytes(from, 2);
    const uint8_t *parts = head == NULL ? NULL : next_bytes(from, head[1]);
    const uint8_t *how = parts == NULL ? NULL : next_bytes(from, 8); /* lag, shift, baseline, noise, floor */
    uint32_t n, floor;

    if (how == NULL || head[0] > 1 || head[1] == 0 || (head[0] == 0 && head[1] != 1))
        return 0;
    for (n = 0; n < head[1]; n++)
        if (parts[n] >= toy->inputs)
            return 0;
    floor = word_at(how + 4);
    if (how[0] == 0 || how[0] > MOST_GATE_LAG || how[1] > MOST_GATE_SHIFT || how[2] == 0 || how[2] > MOST_GATE_WEIGHT ||
        how[3] == 0 || how[3] > MOST_GATE_WEIGHT || floor == 0 || floor > (uint32_t)GATE_HELD)
        return 0;
    if (head[0] == 1 && how[0] > toy->gate_past)
        toy->gate_past = how[0];
    return 1;
}

PLUSH_SMALL static int read_rule(plush_toy *toy, source *from)
{
    const uint8_t *rule = next_bytes(from, RULE_BYTES);
    uint32_t n;

    if (rule == NULL || rule[0] == 0 || rule[0] > MOST_GATE_TERMS || rule[1] > PLUSH_AFFECT_NEGATIVE ||
        (rule[2] >= toy->classes && rule[2] != PLUSH_NO_GESTURE))
        return 0;
    for (n = 0; n < rule[0]; n++) {
        const uint8_t *term = next_bytes(from, TERM_BYTES);

        if (term == NULL || term[0] >= toy->gate_signals ||
            (term[1] != 0 && term[1] != SIGN_ABOVE && term[1] != SIGN_BELOW) || term[2] == 0 || term[3] != 0 ||
            word_at(term + 4) == 0 || word_at(term + 4) > MOST_GATE_SIZE)
            return 0;
    }
    toy->gate_terms = (uint16_t)(toy->gate_terms + rule[0]);
    return 1;
}

PLUSH_SMALL static int read_gate_plan(plush_toy *toy, source *from)
{
    const uint8_t *head = next_bytes(from, 2);
    uint32_t n;

    if (head == NULL || head[0] > MOST_GATE_SIGNALS || head[1] > MOST_GATE_RULES || (head[1] == 0 && head[0] != 0))
        return 0;
    toy->gate_signals = head[0];
    toy->gate_rules = head[1];
    toy->gate_past = 1;
    toy->gate_terms = 0;
    toy->gate_plan = from->at;
    for (n = 0; n < head[0]; n++)
        if (!read_signal(toy, from))
            return 0;
    toy->gate_first_rule = from->at;
    for (n = 0; n < head[1]; n++)
        if (!read_rule(toy, from))
            return 0;
    return 1;
}

/* Reads a model that check() found good; says whether all that stands in it holds together. */
PLUSH_SMALL static int read_model(plush_toy *toy, const uint8_t *model)
{
    source from;
    uint32_t span, i;

    from.at = model + HEAD_BYTES;
    from.left = word_at(model + 8) - HEAD_BYTES;
    toy->deviations = (uint8_t)deviates(model);
    if (!read_head(toy, &from) || !read_input_plan(toy, &from) || !read_sensors(toy, &from) || !read_vectors(toy, &from))
        return 0;
    span = (uint32_t)toy->step * toy->blocks + (toy->vectors != 0 ? toy->vector_taps - 1u : 0u);
    for (i = 0; i < toy->layers; i++) {
        if (!read_layer(&toy->layer[i], toy->features, &from))
            return 0;
        toy->features = toy->layer[i].filters;
        span += (toy->layer[i].kernel - 1u) * (uint32_t)toy->layer[i].dilation;
    }
    return toy->span == span && read_dense_and_names(toy, &from) && read_event_plan(toy, &from) &&
           read_health_plan(toy, &from) && read_gate_plan(toy, &from) && from.left == 0;
}

/* Whether health asks for the frame before. */
PLUSH_SMALL static int last_matters(const plush_toy *toy)
{
    return toy->limits != NULL || le16(toy->health_plan + STILL_MS) != 0;
}

PLUSH_SMALL static int has_gate(const plush_toy *toy)
{
    return toy->gate_rules != 0;
}

/* How many rows a phase has room for. */
static uint32_t phase_rows(const plush_layer *layer)
{
    return (uint32_t)layer->kernel + SPARE; /* an int may have 16 bits */
}

/* Hands out the memory of a model that was read. Returns the bytes of it. */
PLUSH_SMALL static uint32_t share_out(plush_toy *toy, uint8_t *memory)
{
    uint32_t used = 0, i;

    toy->held = (int32_t *)take(memory, &used, 4u * toy->channels);
    toy->before = (int32_t *)take(memory, &used, 4u * toy->channels);
    toy->sample = (int32_t *)take(memory, &used, 4u * toy->channels);
    toy->raw = (int32_t *)take(memory, &used, has_gate(toy) || toy->vectors == 0 ? 0 : 4u * toy->inputs);
    toy->mean = (int32_t *)take(memory, &used, 4u * toy->means);
    toy->axes = (int16_t *)take(memory, &used, UINT32_C(6) * toy->vectors * toy->vector_taps);
    toy->across = (int32_t *)take(memory, &used, UINT32_C(12) * toy->vector_kernels);
    for (i = 0; i < toy->layers; i++) {
        plush_layer *layer = &toy->layer[i];

        layer->ring = (uint32_t *)take(memory, &used, layer->dilation * phase_rows(layer) * layer->groups * GROUP);
        layer->tap_sums = (uint32_t *)take(memory, &used, UINT32_C(4) * layer->dilation);
    }
    toy->sums = (uint16_t *)take(memory, &used, UINT32_C(2) * toy->features * toy->blocks);
    toy->total = (uint32_t *)take(memory, &used, 4u * pooled(toy));
    toy->logits = (int32_t *)take(memory, &used, 4u * toy->classes);
    toy->smooth = (int32_t *)take(memory, &used, 4u * (toy->classes + 1u));
    if (has_gate(toy)) {
        uint32_t start;

        toy->gate_inputs = (int32_t *)take(memory, &used, UINT32_C(4) * toy->inputs * (toy->gate_past + 1u));
        start = used;
        toy->gate_state = (int32_t *)take(memory, &used, 4u * SIGNAL_WORDS * toy->gate_signals);
        toy->gate_hold = (uint16_t *)take(memory, &used, 2u * toy->gate_terms);
        toy->gate_in_row = (uint8_t *)take(memory, &used, toy->gate_terms);
        toy->gate_bytes = (uint16_t)(used - start);
    }
    toy->valid = (uint8_t *)take(memory, &used, toy->channels);
    toy->top = (uint8_t *)take(memory, &used, 2u * toy->features);
    toy->last = (int32_t *)take(memory, &used, last_matters(toy) ? 4u * toy->channels : 0);
    share_sensors(toy, memory, &used);
    return used;
}

/* ---- What differs from core to core ----------------------------------------------------------------------------- */

/* The weights of four filters for one channel are the bytes of a word: 128 is added to the first three. Three products of
 * 32 bits stand for four of 8 bits, as no sum of a convolution has more than 24. Modulo 2^32, the sums over all channels
 *
 *     of the activation * the word                   are  a = s0 + 2^8 s1 + 2^16 s2 + 2^24 s3
 *     of the activation * its high half, signed      are  b = s2 + 2^8 s3
 *     of the activation * the two bytes between      are  c = s1 + 2^8 s2
 *
 * and the low 24 bits of a - 2^8 c are s0, from which the others follow: see activations(). Other instructions may have other
 * sums.
 *
 *     PLUSH_ALONE(i)         4 activations at `x` + i, times the next weights of 4 filters at `w`: words of the channels
 *                            0, 2, 1 and 3
 *     PLUSH_PAIR(i)          the same at `x` and at `y`: a weight is loaded once for two positions
 *     PLUSH_SUMS(s)          what is summed up at `x`, and `t` at `y`; PLUSH_GIVE puts it into `sum`
 *     PLUSH_SUM_BYTES(s, v)  the four bytes of a word, into `s`
 *     PLUSH_RELU(v, n)       a number, at least 0, divided by 2^n; it goes to PLUSH_LIMIT
 *     PLUSH_LIMIT(v, bits)   a number below 2^31, at most the highest of so many bits
 *
 * PLUSH_PLAIN asks for plain C everywhere. */
#if defined(__GNUC__) && defined(__ARM_FEATURE_DSP) && defined(__thumb2__) && !defined(PLUSH_PLAIN)

#define PLUSH_DSP
#define PLUSH_SUM_BYTES(s, v) __asm__("usada8 %0, %1, %2, %0" : "+r"(s) : "r"(v), "r"(0))
#define PLUSH_RELU(v, n) ((uint32_t)((v) >> (n))) /* PLUSH_LIMIT makes a negative number 0 */
#define PLUSH_LIMIT(v, bits) __asm__("usat %0, %1, %0" : "+r"(v) : "i"(bits))

/* Two halves in a register, of two channels: weights of filters 0 and 1 in `a`, of 2 and 3 in `b`, of 1 and 2 in `c`. A
 * half is signed: its highest bit is turned where 128 was added. */
#define PLUSH_WEIGHTS                                                                                      \
    __asm__ volatile("ldrd %[c], %[d], [%[w]], #8\n\t"                                                     \
                     "pkhbt %[a], %[c], %[d], lsl #16\n\teor %[a], %[a], #0x80008000\n\t"                  \
                     "pkhtb %[b], %[d], %[c], asr #16\n\t"                                                 \
                     "lsr %[c], %[c], #8\n\tpkhbt %[c], %[c], %[d], lsl #8\n\teor %[c], %[c], #0x80008000" \
                     : [w] "+&r"(w), [a] "=&r"(a), [b] "=&r"(b), [c] "=&r"(c), [d] "=&r"(d)                \
                     :                                                                                     \
                     : "memory")
#define PLUSH_PRODUCTS(x, next, turn, s, t, u)                                                             \
    __asm__ volatile("ldr %[d], [%[p]]" next "\n\tuxtb16 %[d], %[d]" turn "\n\t"                           \
                     "smlad %[i], %[d], %[a], %[i]\n\tsmlad %[j], %[d], %[b], %[j]\n\t"                    \
                     "smlad %[k], %[d], %[c], %[k]"                                                        \
                     : [p] "+&r"(x), [i] "+&r"(s), [j] "+&r"(t), [k] "+&r"(u), [d] "=&r"(d)                \
                     : [a] "r"(a), [b] "r"(b), [c] "r"(c)                                                  \
                     : "memory")
#define PLUSH_ALONE(i)                                             \
    do {                                                           \
        uint32_t a, b, c, d;                                       \
        PLUSH_WEIGHTS;                                             \
        PLUSH_PRODUCTS(x, "", "", s0, s1, s2);                     \
        PLUSH_WEIGHTS;                                             \
        PLUSH_PRODUCTS(x, ", #4", ", ror #8", s0, s1, s2);         \
    } while (0)
#define PLUSH_PAIR(i)                                              \
    do {                                                           \
        uint32_t a, b, c, d;                                       \
        PLUSH_WEIGHTS;                                             \
        PLUSH_PRODUCTS(x, "", "", s0, s1, s2);                     \
        PLUSH_PRODUCTS(y, "", "", t0, t1, t2);                     \
        PLUSH_WEIGHTS;                                             \
        PLUSH_PRODUCTS(x, ", #4", ", ror #8", s0, s1, s2);         \
        PLUSH_PRODUCTS(y, ", #4", ", ror #8", t0, t1, t2);         \
    } while (0)

#elif defined(__SSE2__) && !defined(PLUSH_PLAIN)

#include <emmintrin.h>

/* Products of 16 bits, of two channels of a filter side by side; each sum by itself. */
#define PLUSH_EACH
#define PLUSH_SUMS(s) __m128i s = _mm_setzero_si128()
#define PLUSH_GIVE(s, sum) memcpy(sum, &(s), sizeof(s))
#define PLUSH_WEIGHTS                                                                                         \
    __m128i v = _mm_loadu_si128((const __m128i *)(const void *)w), zero = _mm_setzero_si128(), b, c;          \
    v = _mm_xor_si128(v, _mm_set1_epi32(INT32_MIN)); /* 128 is added to the last filter's, too */             \
    v = _mm_unpacklo_epi8(v, _mm_unpackhi_epi64(v, v));                                                       \
    b = _mm_unpacklo_epi8(v, zero);                                                                           \
    c = _mm_unpackhi_epi8(v, zero);                                                                           \
    w += 16
#define PLUSH_PRODUCTS(x, s)                                                            \
    do {                                                                                \
        int32_t four;                                                                   \
        __m128i a;                                                                      \
        memcpy(&four, x, 4);                                                            \
        a = _mm_unpacklo_epi8(_mm_cvtsi32_si128(four), zero);                           \
        (s) = _mm_add_epi32(s, _mm_madd_epi16(_mm_shuffle_epi32(a, 0x00), b));          \
        (s) = _mm_add_epi32(s, _mm_madd_epi16(_mm_shuffle_epi32(a, 0x55), c));          \
    } while (0)
#define PLUSH_ALONE(i)        \
    do {                      \
        PLUSH_WEIGHTS;        \
        PLUSH_PRODUCTS(x, s); \
    } while (0)
#define PLUSH_PAIR(i)         \
    do {                      \
        PLUSH_WEIGHTS;        \
        PLUSH_PRODUCTS(x, s); \
        PLUSH_PRODUCTS(y, t); \
    } while (0)

#else

/* Keeps a value in a register, and what is done to it in the written order: otherwise compilers add products up in trees,
 * for which small cores have too few registers. (clang gives no number of 32 bits to a register of AVR.) */
#if defined(__GNUC__) && defined(__thumb__) && !defined(__thumb2__) && defined(__OPTIMIZE__)
#define PLUSH_KEEP(v) __asm__ volatile("" : "+l"(v))
#ifndef __OPTIMIZE_SIZE__ /* for which gcc keeps nothing in the high registers */
/* Eight registers multiply, and the others can be added to. */
#define PLUSH_ADD(s, v) __asm__ volatile("add %0, %1" : "+h"(s) : "l"(v))
#endif
#define PLUSH_NEXT_WORD(v) __asm__ volatile("ldmia %0!, {%1}" : "+l"(w), "=l"(v) : : "memory")
#elif defined(__GNUC__) && !defined(__x86_64__) && !defined(__aarch64__) && !(defined(__AVR__) && defined(__clang__))
#define PLUSH_KEEP(v) __asm__ volatile("" : "+r"(v))
#endif
#ifndef PLUSH_ADD
#define PLUSH_ADD(s, v) \
    do {                \
        (s) += (v);     \
        PLUSH_KEEP(s);  \
    } while (0)
#endif
#ifndef PLUSH_NEXT_WORD
#define PLUSH_NEXT_WORD(v) ((v) = aligned_le32(w), w += 4)
#endif
#ifdef __AVR__
/* A product of two bytes fits an int without sign of 16 bits, which is quicker than fewer products of 32. */
#define PLUSH_EACH
#define PLUSH_SUMS(s) uint32_t s##0 = 0, s##1 = 0, s##2 = 0, s##3 = 0
#define PLUSH_GIVE(s, sum)   \
    do {                     \
        (sum)[0] = s##0;     \
        (sum)[1] = s##1;     \
        (sum)[2] = s##2;     \
        (sum)[3] = s##3;     \
    } while (0)
#define PLUSH_CHANNEL(i)                          \
    do {                                          \
        unsigned a = x[i];                        \
        PLUSH_ADD(s0, a * w[0]);                  \
        PLUSH_ADD(s1, a * w[1]);                  \
        PLUSH_ADD(s2, a * w[2]);                  \
        PLUSH_ADD(s3, a * (w[3] ^ WEIGHT_ZERO));  \
        w += 4;                                   \
    } while (0)
#else
#define PLUSH_HIGH(v) PLUSH_DOWN(v, 16)
#define PLUSH_CHANNEL(i)            \
    do {                            \
        uint32_t v, a = x[i], p;    \
        PLUSH_NEXT_WORD(v);         \
        p = PLUSH_HIGH(v) * a;      \
        PLUSH_ADD(s1, p);           \
        p = (v >> 8 & 0xffffu) * a; \
        PLUSH_ADD(s2, p);           \
        a *= v;                     \
        PLUSH_ADD(s0, a);           \
    } while (0)
#endif
#define PLUSH_ALONE(i)          \
    do {                        \
        PLUSH_CHANNEL(i);       \
        PLUSH_CHANNEL((i) + 2); \
        PLUSH_CHANNEL((i) + 1); \
        PLUSH_CHANNEL((i) + 3); \
    } while (0)
#ifndef __AVR__
#if defined(__thumb__) && !defined(__thumb2__)
/* A product takes the place of a factor: in this order, one more copy is enough. */
#define PLUSH_CHANNEL_OF_PAIR(i)    \
    do {                            \
        uint32_t v, a = x[i], p, c; \
        PLUSH_NEXT_WORD(v);         \
        p = PLUSH_HIGH(v) * a;      \
        PLUSH_ADD(s1, p);           \
        c = v >> 8 & 0xffffu;       \
        p = c * a;                  \
        PLUSH_ADD(s2, p);           \
        a *= v;                     \
        PLUSH_ADD(s0, a);           \
        PLUSH_KEEP(v);              \
        a = y[i];                   \
        p = PLUSH_HIGH(v) * a;      \
        PLUSH_ADD(t1, p);           \
        c *= a;                     \
        PLUSH_ADD(t2, c);           \
        a *= v;                     \
        t0 += a;                    \
        PLUSH_KEEP(t0);             \
    } while (0)
#else
/* In this order, 14 registers are enough for the loop. */
#define PLUSH_CHANNEL_OF_PAIR(i)       \
    do {                               \
        uint32_t v, a = x[i], b, p, q; \
        PLUSH_NEXT_WORD(v);            \
        q = PLUSH_HIGH(v);             \
        p = q * a;                     \
        PLUSH_ADD(s1, p);              \
        b = y[i];                      \
        PLUSH_KEEP(b);                 \
        q *= b;                        \
        PLUSH_ADD(t1, q);              \
        p = v * a;                     \
        PLUSH_ADD(s0, p);              \
        p = v * b;                     \
        PLUSH_ADD(t0, p);              \
        v = v >> 8 & 0xffffu;          \
        a *= v;                        \
        PLUSH_ADD(s2, a);              \
        b *= v;                        \
        PLUSH_ADD(t2, b);              \
    } while (0)
#endif
#define PLUSH_PAIR(i)                   \
    do {                                \
        PLUSH_CHANNEL_OF_PAIR(i);       \
        PLUSH_CHANNEL_OF_PAIR((i) + 2); \
        PLUSH_CHANNEL_OF_PAIR((i) + 1); \
        PLUSH_CHANNEL_OF_PAIR((i) + 3); \
    } while (0)

#endif

#endif

#ifndef PLUSH_SUMS
#define PLUSH_SUMS(s) uint32_t s##0 = 0, s##1 = 0, s##2 = 0
#define PLUSH_GIVE(s, sum)   \
    do {                     \
        (sum)[0] = s##0;     \
        (sum)[1] = s##1;     \
        (sum)[2] = s##2;     \
    } while (0)
#endif
#ifndef PLUSH_KEEP
#define PLUSH_KEEP(v) ((void)0)
#endif
#ifdef PLUSH_DSP /* whose loads set the pointers on */
#define PLUSH_MOVE(by) ((void)0)
#define PLUSH_MOVE_BOTH(by) ((void)0)
#else
#define PLUSH_MOVE(by) (x += (by))
#define PLUSH_MOVE_BOTH(by) (x += (by), y += (by))
#endif
/* All activations up to `end`, 4 a turn; on Thumb, where a turn costs much, 8: an odd 4 begin in the middle. */
#ifdef __thumb__
#define PLUSH_TURNS(four, move)   \
    do {                          \
        if ((end - x) % 8 != 0) { \
            move(-4);             \
            goto middle;          \
        }                         \
        do {                      \
            four(0);              \
        middle:                   \
            four(4);              \
            move(8);              \
        } while (x != end);       \
    } while (0)
#else
#define PLUSH_TURNS(four, move) \
    do {                        \
        four(0);                \
        move(4);                \
    } while (x != end)
#endif
#ifndef PLUSH_DSP
#define PLUSH_SUM_BYTES(s, v)                                                      \
    do {                                                                           \
        uint32_t four = (v), two = (four & 0xff00ffu) + ((four >> 8) & 0xff00ffu); \
        (s) += two * 0x10001u >> 16;                                               \
    } while (0)
#define PLUSH_RELU(v, n) ((uint32_t)((v) > 0 ? (v) : 0) >> (n))
#define PLUSH_LIMIT(v, bits)                     \
    do {                                         \
        if ((v) >> (bits) != 0)                  \
            (v) = (UINT32_C(1) << (bits)) - 1u;  \
    } while (0)
#endif

/* ---- The network ----------------------------------------------------------------------------------------------- */

/* The newest row under these taps. */
PLUSH_CODE
static uint32_t *newest_row(const plush_layer *layer, uint32_t *taps)
{
    return taps + (layer->kernel - 1u) * (uint32_t)layer->groups;
}

/* Room for a new sample. Samples `dilation` apart follow each other in the memory of their phase, so that all rows under
 * the taps are one piece. When a phase is full, the newest `kernel` rows move to its beginning. */
PLUSH_CODE
static uint8_t *next_row(plush_layer *layer)
{
    uint32_t width = layer->groups, *phase;

    layer->taps[1] = layer->taps[0];
    if (++layer->phase >= layer->dilation) {
        layer->phase = 0;
        if (++layer->row >= phase_rows(layer))
            layer->row = layer->kernel;
    }
    phase = layer->ring + layer->phase * phase_rows(layer) * width;
    if (layer->row == layer->kernel) {
        uint32_t *to = phase, *from = phase + SPARE * width, *end = from + layer->kernel * width;

        do
            *to++ = *from++;
        while (from != end);
    }
    layer->taps[0] = phase + (layer->row + 1u - layer->kernel) * width;
    if (layer->dilation == 1) /* then the row before may have moved, too */
        layer->taps[1] = layer->taps[0] - width;
    return (uint8_t *)newest_row(layer, layer->taps[0]);
}

/* What every weight's + 128 adds to the sums of a position: 128 times all activations under the taps. Their sum is that
 * of `dilation` samples ago, less the row that has left, plus the one that has come. */
PLUSH_CODE
static uint32_t surplus(plush_layer *layer, uint32_t back)
{
    uint32_t phase = back <= layer->phase ? layer->phase - back : layer->dilation - 1u, *sum = layer->tap_sums + phase;
    const uint32_t *left = layer->taps[back], *come = newest_row(layer, layer->taps[back]);
    uint32_t plus = *sum, minus = 0, n = layer->groups;

    do {
        PLUSH_SUM_BYTES(plus, *come++);
        PLUSH_SUM_BYTES(minus, *left++);
    } while (--n > 0);
    *sum = plus - minus;
    return plus * WEIGHT_ZERO;
}

/* What is summed up of four filters at one position. By itself, so that its loop has all registers. */
PLUSH_APART
static void alone(const uint8_t *x, const uint8_t *end, const uint8_t *w, uint32_t sum[GROUP])
{
    PLUSH_SUMS(s);

    PLUSH_TURNS(PLUSH_ALONE, PLUSH_MOVE);
    PLUSH_GIVE(s, sum);
}

/* The same at two positions, `x` first. */
PLUSH_APART
static void pair(const uint8_t *x, const uint8_t *end, const uint8_t *y, const uint8_t *w, uint32_t sum[2 * GROUP])
{
#ifdef PLUSH_PAIR
    PLUSH_SUMS(s);
    PLUSH_SUMS(t);

    PLUSH_TURNS(PLUSH_PAIR, PLUSH_MOVE_BOTH);
    PLUSH_GIVE(s, sum);
    PLUSH_GIVE(t, sum + GROUP);
#else
    alone(x, end, w, sum);
    alone(y, y + (end - x), w, sum + GROUP);
#endif
}

/* ReLU, and a sum to 8 bits; rounded half up, also where `after` is 0. */
PLUSH_CODE
static uint32_t requantize(int32_t sum, uint32_t times, uint32_t before, uint32_t after)
{
    uint32_t t = PLUSH_RELU(sum, before);

    PLUSH_LIMIT(t, 16);
    t = ((2u * t * times >> after) + 1u) >> 1;
    PLUSH_LIMIT(t, 8);
    return t;
}

/* The activations at one position of four filters, or of the `n` that there are; `sum` is what was summed up of them, and
 * `extra` what surplus() says. */
PLUSH_APART
static void activations(uint32_t sum[GROUP], uint32_t extra, const uint8_t *scale, uint32_t n, uint8_t *out)
{
#ifdef PLUSH_EACH
    uint32_t i;

    for (i = 0; i < GROUP; i++)
        sum[i] -= extra;
#else
#ifdef PLUSH_DSP
    uint32_t b = sum[1] - extra, c = sum[2] - extra, a = sum[0] - extra + (b << 16);
#else
    uint32_t b = sum[1] - extra, c = sum[2] - extra * 257u, a = sum[0] - extra * UINT32_C(0x10101);
#endif

    sum[0] = PLUSH_DOWN((a - (c << 8)) << 8, 8);
    sum[1] = PLUSH_DOWN(a - (b << 16) - sum[0], 8);
    sum[2] = PLUSH_DOWN(c - sum[1], 8);
    sum[3] = PLUSH_DOWN(b - sum[2], 8);
#endif
    for (; n > 0; n--, scale += SCALE_BYTES) {
        int32_t total = as_signed(*sum++ + aligned_le32(scale));
        uint32_t v = requantize(total, aligned_le32(scale + 4) & 0xffffu, scale[6], scale[7]);

        PLUSH_KEEP(v); /* below 256: gcc does not see it */
        *out++ = (uint8_t)v;
    }
}

/* A new position of a layer, (filters) activations, or two: then `before` are those of the older one. */
PLUSH_CODE
static void advance(plush_layer *layer, int two, uint8_t *newest, uint8_t *before)
{
    const uint8_t *x = (const uint8_t *)layer->taps[0], *y = (const uint8_t *)layer->taps[1];
    const uint8_t *weights = layer->weights, *scale = layer->scales;
    uint32_t size = (uint32_t)layer->kernel * layer->groups * GROUP, sum[2 * GROUP], f;
    uint32_t extra_before = two ? surplus(layer, 1) : 0, extra = surplus(layer, 0);

    for (f = 0; f < layer->filters; f += GROUP, weights += size * GROUP, scale += GROUP * SCALE_BYTES) {
        uint32_t n = layer->filters - f < GROUP ? layer->filters - f : GROUP;

        if (two) {
            pair(x, x + size, y, weights, sum);
            activations(sum + GROUP, extra_before, scale, n, before + f);
        } else {
            alone(x, x + size, weights, sum);
        }
        activations(sum, extra, scale, n, newest + f);
    }
}

/* One new sample, whose quantized inputs are in the first ring. It waits for the next one, and both go through all layers
 * into the pooling together; one alone only when the step ends with it. */
PLUSH_APART
static void network_sample(plush_toy *toy)
{
    uint32_t features = toy->features, i, f;
    int two = toy->waiting;
    uint16_t *sums = toy->sums + (uint32_t)toy->block * features;

    toy->waiting = !two && toy->filled + 1u < toy->step;
    if (toy->waiting)
        return;
    for (i = 0; i < toy->layers; i++) {
        plush_layer *layer = &toy->layer[i], *next = layer + 1;
        uint8_t *newest = toy->top, *before = toy->top + features;

        if (i + 1u < toy->layers) {
            newest = next_row(next);
            if (two) {
                newest = next_row(next);
                before = (uint8_t *)newest_row(next, next->taps[1]);
            }
        }
        advance(layer, two, newest, before);
    }
    for (f = 0; f < features; f++) {
        uint32_t v = toy->top[f] + (two ? toy->top[features + f] : 0u);

        sums[f] = (uint16_t)(sums[f] + v);
        toy->total[f] += v;
    }
}

/* ---- From pooled sums to an answer ----------------------------------------------------------------------------- */

/* round(65535 exp(-i / 4)) and round(65535 exp(-i / 256)) */
PLUSH_CONST static const uint16_t coarse[64] = {
    65535, 51039, 39749, 30957, 24109, 18776, 14623, 11388, 8869, 6907, 5379, 4190, 3263, 2541, 1979, 1541,
    1200, 935, 728, 567, 442, 344, 268, 209, 162, 127, 99, 77, 60, 47, 36, 28,
    22, 17, 13, 10, 8, 6, 5, 4, 3, 2, 2, 1, 1, 1, 1, 1,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0
};
PLUSH_CONST static const uint16_t fine[64] = {
    65535, 65280, 65025, 64771, 64519, 64267, 64017, 63767, 63519, 63271, 63024, 62779, 62534, 62290, 62047, 61805,
    61564, 61324, 61085, 60847, 60610, 60374, 60138, 59904, 59670, 59438, 59206, 58975, 58745, 58516, 58288, 58061,
    57834, 57609, 57384, 57161, 56938, 56716, 56495, 56274, 56055, 55837, 55619, 55402, 55186, 54971, 54757, 54543,
    54330, 54119, 53908, 53697, 53488, 53280, 53072, 52865, 52659, 52454, 52249, 52045, 51842, 51640, 51439, 51238
};

static uint32_t affect_of(const plush_toy *toy, uint32_t gesture)
{
    return toy->classes_told[gesture] & TOLD_AFFECT;
}

static int is_idle(const plush_toy *toy, uint32_t gesture)
{
    return (toy->classes_told[gesture] & TOLD_IDLE) != 0;
}

static uint32_t larger(uint32_t a, uint32_t b)
{
    return a > b ? a : b;
}

/* Of each feature, twice what the sums of its blocks exceed their mean by: how much it changes over time. */
PLUSH_APART
static void deviations(plush_toy *toy)
{
    uint32_t features = toy->features, f, left;

    for (f = 0; f < features; f++) {
        const uint16_t *sum = toy->sums + f;
        uint32_t mean = toy->total[f] / toy->blocks, all = 0;

        /* The larger of both, and the mean subtracted once: an instruction less within the loop. */
        for (left = toy->blocks; left > 1; left -= 2, sum += 2 * features)
            all += larger(sum[0], mean) + larger(sum[features], mean);
        if (left != 0)
            all += larger(sum[0], mean);
        toy->total[features + f] = 2 * (all - toy->blocks * mean);
    }
}

static void dense(plush_toy *toy)
{
    const uint8_t *scale = toy->dense, *w = toy->dense_weights;
    uint32_t inputs = pooled(toy), all = 0, k, f;

    if (toy->deviations)
        deviations(toy);
    for (f = 0; f < inputs; f++)
        all += toy->total[f];
    for (k = 0; k < toy->classes; k++, scale += SCALE_BYTES) {
        uint32_t sum = le32(scale) - WEIGHT_ZERO * all; /* modulo 2^32 */
        int32_t t;

        for (f = 0; f < inputs; f++)
            sum += toy->total[f] * *w++;
        t = within(shift_down(as_signed(sum), scale[6]), -32768, 32767);
        t = shift_down(t * (int32_t)le16(scale + 4) + (int32_t)half(scale[7]), scale[7]);
        toy->logits[k] = within(t, -LOGIT_LIMIT, LOGIT_LIMIT);
    }
}

/* exp of a logit below the highest one by `distance`, in steps of 2^-16 */
static uint32_t exponential(int32_t distance)
{
    return distance < 4096 ? ((uint32_t)coarse[distance >> 6] * fine[distance & 63]) >> 16 : 0;
}

/* What a number of a step becomes when it is smoothed: an exponential mean, in steps of 2^-12 of the number. */
static int32_t smoothed(const plush_toy *toy, int32_t mean, int32_t now)
{
    /* (now - mean) * weight / 2^15, in two halves so that 32 bits will do */
    int32_t d = now - mean, high = shift_down(d, 16);
    uint32_t low = (uint32_t)d & 0xffffu;

    return toy->started ? mean + high * 2 * toy->smoothing + (int32_t)((low * toy->smoothing + 16384u) >> 15) : now;
}

/* How clearly the best gesture stands out: its logit less the third highest. Idle classes are left out. */
static int32_t known_score(const plush_toy *toy)
{
    int32_t first = -LOGIT_LIMIT, second = -LOGIT_LIMIT, third = -LOGIT_LIMIT;
    uint32_t k;

    for (k = 0; k < toy->classes; k++) {
        int32_t logit = is_idle(toy, k) ? -LOGIT_LIMIT : toy->logits[k];

        if (logit > first) {
            third = second;
            second = first;
            first = logit;
        } else if (logit > second) {
            third = second;
            second = logit;
        } else if (logit > third) {
            third = logit;
        }
    }
    return within(first - third, 0, LOGIT_LIMIT);
}

/* Smoothed probabilities, and with them the known score. Returns the best class. */
static uint32_t decide(plush_toy *toy)
{
    int32_t highest = -LOGIT_LIMIT, *known = toy->smooth + toy->classes;
    uint32_t total = 0, best = 0, k;

    for (k = 0; k < toy->classes; k++)
        if (toy->logits[k] > highest)
            highest = toy->logits[k];
    for (k = 0; k < toy->classes; k++)
        total += exponential(highest - toy->logits[k]);
    for (k = 0; k < toy->classes; k++) {
        uint32_t e = exponential(highest - toy->logits[k]);

        toy->smooth[k] = smoothed(toy, toy->smooth[k], (int32_t)(((e << 15) + (total >> 1)) / total) * 4096);
        if (toy->smooth[k] > toy->smooth[best])
            best = k;
    }
    *known = smoothed(toy, *known, known_score(toy) * 4096);
    toy->started = 1;
    toy->answer.gesture = (uint8_t)best;
    toy->answer.affect = (plush_affect)affect_of(toy, best);
    toy->answer.confidence = (uint16_t)(toy->smooth[best] >> 12);
    toy->answer.known = (int16_t)shift_down(*known, 12);
    return best;
}

/* ---- Events ---------------------------------------------------------------------------------------------------- */

PLUSH_CODE
static uint32_t setting(const plush_toy *toy, uint32_t which)
{
    return le16(toy->event_plan + which);
}

/* A probability that an event asks for: 1/512 less for each step of the sensitivity. Settings above 1 are never reached. */
PLUSH_APART
static int32_t least_share(const plush_toy *toy, uint32_t which)
{
    int32_t trained = (int32_t)setting(toy, which);

    return trained > PLUSH_ONE ? trained : trained - toy->sensitivity * 64;
}

/* No setting asks for more than 16 bits can count. */
PLUSH_CODE
static void count_up(uint16_t *count)
{
    if (*count < UINT16_MAX)
        ++*count;
}

static uint32_t share_of(const plush_toy *toy, uint32_t gesture)
{
    return (uint32_t)toy->smooth[gesture] >> 12;
}

/* The share of all classes of an affect together; idle ones are nobody's. */
PLUSH_CODE
static uint32_t mass_of(const plush_toy *toy, uint32_t affect)
{
    uint32_t sum = 0, k;

    for (k = 0; k < toy->classes; k++)
        if (toy->classes_told[k] == affect)
            sum += share_of(toy, k);
    return sum;
}

PLUSH_APART
static plush_kind kind_of(const plush_toy *toy, uint32_t best)
{
    uint32_t sure = setting(toy, SURE), members = 0, affects = 0, k;

    if (is_idle(toy, best))
        return PLUSH_IDLE;
    if (toy->answer.known < known_least(toy->event_plan))
        return PLUSH_UNKNOWN;
    for (k = 0; k < toy->classes; k++)
        if (share_of(toy, k) >= sure) {
            members++;
            affects |= UINT32_C(1) << (is_idle(toy, k) ? 0u : affect_of(toy, k));
        }
    if (members == 1)
        return PLUSH_SURE_GESTURE;
    if (affects == 1u << PLUSH_AFFECT_POSITIVE || affects == 1u << PLUSH_AFFECT_NEUTRAL ||
        affects == 1u << PLUSH_AFFECT_NEGATIVE)
        return PLUSH_SURE_AFFECT;
    return PLUSH_UNSURE;
}

static int going_on(const plush_toy *toy)
{
    return toy->event.what == PLUSH_BEGUN || toy->event.what == PLUSH_NAMED;
}

PLUSH_CODE
static void tell(plush_toy *toy, plush_what what, uint32_t since, uint32_t ms)
{
    toy->event.what = what;
    toy->event.since_ms = since;
    toy->event.ms = ms;
    if (toy->on_event != NULL)
        toy->on_event(toy, toy->user);
}

PLUSH_APART
static void begin_event(plush_toy *toy, uint32_t affect, uint32_t gesture, plush_source by, uint32_t since,
                        uint32_t ms)
{
    toy->event.number++;
    toy->event.affect = (plush_affect)affect;
    toy->event.gesture = (uint8_t)gesture;
    toy->event.source = by;
    toy->lasted = toy->away = toy->wait = 0;
    tell(toy, PLUSH_BEGUN, since, ms);
}

PLUSH_APART
static void end_event(plush_toy *toy, uint32_t since, uint32_t ms)
{
    toy->resting = (uint16_t)setting(toy, REST);
    tell(toy, PLUSH_ENDED, since, ms);
}

/* The signal is gone: what is going on ends, all but the count of events is forgotten. */
PLUSH_SMALL_APART
static void lose(plush_toy *toy, uint32_t ms)
{
    if (going_on(toy))
        end_event(toy, ms, ms);
    toy->started = 0;
    toy->resting = 0;
    toy->wanted = toy->wanted_for = toy->named_for = 0;
    toy->named = PLUSH_NO_GESTURE;
}

/* A step in which nothing spoke for the event. */
PLUSH_CODE
static void miss(plush_toy *toy, uint32_t ms)
{
    if (toy->away == 0)
        toy->away_ms = ms;
    count_up(&toy->away);
    if (toy->away >= setting(toy, END) && toy->lasted >= setting(toy, HOLD))
        end_event(toy, toy->away_ms, ms);
}

/* A step without an answer, while the network is warming. */
static void blind_step(plush_toy *toy, uint32_t ms)
{
    if (!going_on(toy))
        return;
    count_up(&toy->lasted);
    if (toy->wait > 0)
        toy->wait--;
    else
        miss(toy, ms);
}

/* The affect whose classes together are wanted, or none. */
static uint32_t affect_alone(const plush_toy *toy)
{
    uint32_t most = mass_of(toy, PLUSH_AFFECT_POSITIVE), affect = PLUSH_AFFECT_POSITIVE, other;

    for (other = PLUSH_AFFECT_NEUTRAL; other <= PLUSH_AFFECT_NEGATIVE; other++) {
        uint32_t mass = mass_of(toy, other);

        if (mass > most) {
            most = mass;
            affect = other;
        }
    }
    return (int32_t)most >= least_share(toy, ENTER_AFFECT) ? affect : 0u;
}

/* How many steps in a row the same was wanted. */
static void count_wanted(plush_toy *toy, uint32_t said, uint32_t affect, uint32_t ms)
{
    uint32_t wanted = affect != PLUSH_AFFECT_NONE ? affect : said != PLUSH_NO_GESTURE ? 4 + said : 0;

    if (wanted != toy->wanted) {
        toy->wanted = (uint16_t)wanted;
        toy->wanted_for = 0;
        toy->wanted_ms = ms;
    }
    if (wanted != 0)
        count_up(&toy->wanted_for);
    if (said != toy->named) {
        toy->named = (uint8_t)said;
        toy->named_for = 0;
    }
    if (said != PLUSH_NO_GESTURE)
        count_up(&toy->named_for);
}

/* A gesture that was wanted for long enough to give its name to an event. */
static uint32_t long_enough(const plush_toy *toy, uint32_t said)
{
    return toy->named_for >= setting(toy, LEAST) ? said : PLUSH_NO_GESTURE;
}

static void closed_step(plush_toy *toy, uint32_t said, uint32_t affect, uint32_t ms)
{
    if (toy->resting > 0)
        toy->resting--;
    else if ((said != PLUSH_NO_GESTURE || affect != PLUSH_AFFECT_NONE) && toy->wanted_for >= setting(toy, LEAST))
        begin_event(toy, affect, long_enough(toy, said), PLUSH_NETWORK, toy->wanted_ms, ms);
}

/* Whether something else than the event was wanted for long enough to take its place. */
PLUSH_APART
static int another(const plush_toy *toy, uint32_t said, uint32_t affect)
{
    const plush_event *event = &toy->event;
    int its_affect = affect == event->affect;

    if ((affect == PLUSH_AFFECT_NONE || its_affect) && (said == PLUSH_NO_GESTURE || said == event->gesture))
        return 0;
    if (event->gesture == PLUSH_NO_GESTURE && its_affect) /* it has no gesture yet: this one may become its own */
        return 0;
    return (said != PLUSH_NO_GESTURE && its_affect ? toy->named_for : toy->wanted_for) >= setting(toy, SWITCH) &&
           toy->lasted >= setting(toy, HOLD);
}

/* Whether the step still shows what the event is. */
static int stays(const plush_toy *toy, uint32_t best)
{
    const plush_event *event = &toy->event;

    if (is_idle(toy, best) && share_of(toy, best) >= setting(toy, ENTER))
        return 0;
    if (event->gesture != PLUSH_NO_GESTURE)
        return (int32_t)share_of(toy, event->gesture) >= least_share(toy, LEAVE);
    /* Begun by the gate, it may have nothing to be recognised by. */
    return event->affect != PLUSH_AFFECT_NONE && (int32_t)mass_of(toy, event->affect) >= least_share(toy, LEAVE_AFFECT);
}

static void open_step(plush_toy *toy, uint32_t best, uint32_t said, uint32_t affect, uint32_t ms)
{
    plush_event *event = &toy->event;
    int locked = toy->wait > 0;

    count_up(&toy->lasted);
    if (locked)
        toy->wait--;
    if (event->gesture == PLUSH_NO_GESTURE && long_enough(toy, said) != PLUSH_NO_GESTURE &&
        (event->affect == PLUSH_AFFECT_NONE || event->affect == affect)) {
        event->gesture = (uint8_t)said;
        event->affect = (plush_affect)affect;
        toy->away = 0;
        tell(toy, PLUSH_NAMED, event->since_ms, ms);
    } else if (locked || toy->suspect) {
        return;
    } else if (another(toy, said, affect)) {
        end_event(toy, ms, ms);
        begin_event(toy, affect, long_enough(toy, said), PLUSH_NETWORK, ms, ms);
    } else if (stays(toy, best)) {
        toy->away = 0;
    } else {
        miss(toy, ms);
    }
}

/* A step of which the network has said all it has to say. */
static void event_step(plush_toy *toy, uint32_t best, uint32_t ms)
{
    uint32_t said = PLUSH_NO_GESTURE, affect = PLUSH_AFFECT_NONE;

    toy->answer.kind = kind_of(toy, best);
    if (!toy->suspect) {
        if (toy->answer.kind == PLUSH_UNKNOWN || toy->answer.kind == PLUSH_IDLE) {
            /* nothing is wanted */
        } else if (toy->answer.confidence >= least_share(toy, ENTER)) {
            said = best;
            affect = affect_of(toy, best);
        } else {
            affect = affect_alone(toy);
        }
        count_wanted(toy, said, affect, ms);
    }
    if (going_on(toy))
        open_step(toy, best, said, affect, ms);
    else
        closed_step(toy, said, affect, ms);
}

/* A step is complete: the answer, and room for the next block of the pooling. For size, as it runs once a step. */
PLUSH_SMALL_APART PLUSH_CODE
static void answer(plush_toy *toy, uint32_t ms)
{
    uint16_t *sums;
    uint32_t f;

    toy->answer.ms = ms;
    if (toy->warm >= toy->span) {
        toy->answer.state = PLUSH_TRACKING;
        dense(toy);
        event_step(toy, decide(toy), ms);
    } else {
        blind_step(toy, ms);
    }
    toy->filled = 0;
    toy->block = (uint16_t)(toy->block + 1u < toy->blocks ? toy->block + 1u : 0u);
    sums = toy->sums + (uint32_t)toy->block * toy->features;
    for (f = 0; f < toy->features; f++) {
        toy->total[f] -= sums[f];
        sums[f] = 0;
    }
    toy->answers++;
    if (toy->on_answer != NULL)
        toy->on_answer(toy, toy->user);
}

/* ---- The gate -------------------------------------------------------------------------------------------------- */

/* The inputs `back` samples before those that are being read. */
PLUSH_CODE
static int32_t *past_inputs(const plush_toy *toy, uint32_t back)
{
    uint32_t rows = toy->gate_past + 1u, at = toy->gate_newest + rows - back;

    return toy->gate_inputs + (at < rows ? at : at - rows) * toy->inputs;
}

/* An input as a signal sees it. */
static int32_t gate_input(int32_t x, uint32_t shift)
{
    return within(shift_down(x, shift), -GATE_HELD, GATE_HELD);
}

/* How much inputs have changed since `lag` samples ago. */
static int32_t jerk(const plush_toy *toy, const uint8_t *signal, uint32_t lag, uint32_t shift)
{
    const int32_t *now = past_inputs(toy, 0), *before = past_inputs(toy, lag);
    int32_t sum = 0;
    uint32_t n;

    for (n = 0; n < signal[1]; n++) {
        uint32_t i = signal[2 + n];
        int32_t d = gate_input(now[i], shift) - gate_input(before[i], shift);

        sum += d < 0 ? -d : d;
    }
    return sum < GATE_HELD ? sum : GATE_HELD;
}

/* Baseline, noise and size of a signal after one more sample; returns where the next signal stands. */
static const uint8_t *follow(const plush_toy *toy, const uint8_t *signal, int32_t *state)
{
    const uint8_t *how = signal + 2 + signal[1]; /* lag, shift, baseline, noise, floor */
    int32_t value = 0, deviation, size, level;

    if (signal[0] == 0)
        value = gate_input(past_inputs(toy, 0)[signal[2]], how[1]);
    else if (toy->gate_seen >= how[0])
        value = jerk(toy, signal, how[0], how[1]);
    if (toy->gate_seen == 0)
        state[BASELINE] = value * 256;
    deviation = value - shift_down(state[BASELINE], 8);
    size = deviation < 0 ? -deviation : deviation;
    level = (state[NOISE] >> 8) + (int32_t)le32(how + 4);
    state[SIZE] = (int32_t)((uint32_t)size * 16 / (uint32_t)level);
    if (deviation < 0)
        state[SIZE] = -state[SIZE];
    state[BASELINE] += shift_down(value * 256 - state[BASELINE], how[2]);
    if (size > 4 * level)
        size = 4 * level;
    state[NOISE] += shift_down(size * 256 - state[NOISE], how[3]);
    return how + 8;
}

/* Whether a term holds after one more sample; `row` counts those in a row, `left` those for which it goes on. */
static int holds(const uint8_t *term, int32_t size, uint32_t longer, uint8_t *row, uint16_t *left)
{
    int32_t threshold = (int32_t)le32(term + 4);

    if ((term[1] != SIGN_BELOW && size >= threshold) || (term[1] != SIGN_ABOVE && -size >= threshold)) {
        if (*row < term[2])
            ++*row;
        if (*row == term[2])
            *left = (uint16_t)(longer + 1);
    } else {
        *row = 0;
    }
    if (*left == 0)
        return 0;
    --*left;
    return 1;
}

/* The first rule that fires, or NULL. */
static const uint8_t *judge(const plush_toy *toy)
{
    const uint8_t *rule = toy->gate_first_rule, *fired = NULL;
    uint8_t *row = toy->gate_in_row;
    uint16_t *left = toy->gate_hold;
    uint32_t r, n;

    for (r = 0; r < toy->gate_rules; r++) {
        const uint8_t *term = rule + RULE_BYTES;
        int every = 1;

        for (n = rule[0]; n > 0; n--, term += TERM_BYTES)
            every &= holds(term, toy->gate_state[SIGNAL_WORDS * term[0] + SIZE], rule[3], row++, left++);
        if (every && fired == NULL)
            fired = rule;
        rule = term;
    }
    return fired;
}

/* One sample's inputs, where past_inputs(toy, 0) is. An event that the gate begins. */
static void gate_sample(plush_toy *toy, uint32_t ms)
{
    const uint8_t *signal = toy->gate_plan, *rule;
    int deaf = toy->gate_deaf > 0;
    uint32_t n;

    if (deaf)
        toy->gate_deaf--;
    if (toy->suspect) {
        if (toy->gate_doubt < GATE_DOUBT && ++toy->gate_doubt == GATE_DOUBT) {
            toy->gate_seen = 0;
            memset(toy->gate_state, 0, toy->gate_bytes);
        }
        return;
    }
    toy->gate_doubt = 0;
    if (toy->gate_seen > 0 && same(past_inputs(toy, 0), past_inputs(toy, 1), toy->inputs))
        return;
    for (n = 0; n < toy->gate_signals; n++)
        signal = follow(toy, signal, toy->gate_state + SIGNAL_WORDS * n);
    if (toy->gate_seen < toy->gate_past)
        toy->gate_seen++;
    toy->gate_newest = (uint8_t)(toy->gate_newest < toy->gate_past ? toy->gate_newest + 1u : 0u);
    rule = judge(toy);
    if (rule == NULL || deaf)
        return;
    toy->gate_deaf = (uint16_t)le16(rule + 4);
    if (going_on(toy) && (toy->event.affect == rule[1] || toy->event.source == PLUSH_GATE)) {
        toy->away = 0;
    } else {
        if (going_on(toy))
            end_event(toy, ms, ms);
        begin_event(toy, rule[1], rule[2], PLUSH_GATE, ms, ms);
    }
    toy->wait = (uint16_t)setting(toy, WAIT);
}

/* ---- Health ---------------------------------------------------------------------------------------------------- */

/* Whether a value lies between two that stand in the model. */
PLUSH_CODE
static int lies_in(const uint8_t *range, int32_t value)
{
    return value >= as_signed(le32(range)) && value <= as_signed(le32(range + 4));
}

/* What was wrong is wrong anew, as after a gap; but a fault goes on until it has recovered. */
static void forget_health(plush_toy *toy)
{
    toy->suspect = toy->compared = toy->wrong = toy->good = 0;
}

/* Whether a value that came is wrong: out of its range, or stuck beyond what touches reach. */
static int is_wrong(const plush_toy *toy, uint32_t channel, int32_t value)
{
    if (!lies_in(toy->ranges + RANGE_BYTES * channel, value))
        return 1;
    return toy->limits != NULL && toy->compared && value == toy->last[channel] &&
           !lies_in(toy->limits + 8 * channel, value);
}

/* Looks at a frame before anything is made of it. Returns 1 when a fault begins or ends with it. */
static int examine(plush_toy *toy, uint32_t ms, const int32_t *values)
{
    uint32_t fault_ms = le16(toy->health_plan + FAULT_MS), frozen_ms = le16(toy->health_plan + STILL_MS), quiet, i;
    int wrong = 0, still;

    for (i = 0; i < toy->channels && !wrong; i++)
        wrong = is_wrong(toy, i, values[i]);
    if (wrong && !toy->wrong)
        toy->wrong_ms = ms;
    toy->wrong = (uint8_t)wrong;
    still = toy->compared && frozen_ms != 0 && same(toy->last, values, toy->channels);
    if (!still)
        toy->moved_ms = ms;
    quiet = ms - toy->moved_ms;
    if (last_matters(toy)) {
        memcpy(toy->last, values, 4u * toy->channels);
        toy->compared = 1;
    }
    toy->suspect = (uint8_t)(wrong || (still && quiet >= (frozen_ms + 1) / 2));
    if (!toy->faulty) {
        toy->faulty = (uint8_t)((wrong && fault_ms != 0 && ms - toy->wrong_ms >= fault_ms) ||
                                (still && quiet >= frozen_ms));
        toy->faults += toy->faulty;
        toy->good = 0;
        return toy->faulty;
    }
    if (toy->suspect) {
        toy->good = 0;
        return 0;
    }
    if (!toy->good)
        toy->good_ms = ms;
    toy->good = 1;
    if (ms - toy->good_ms < le16(toy->health_plan + RECOVER_MS))
        return 0;
    toy->faulty = toy->good = 0;
    return 1;
}

/* ---- Samples and frames ---------------------------------------------------------------------------------------- */

/* A channel of the even sample, from its zero. */
PLUSH_CODE
static int32_t from_zero(const plush_toy *toy, uint32_t channel)
{
    return as_signed((uint32_t)toy->sample[channel] - le32(toy->ranges + RANGE_BYTES * channel + 8));
}

static int32_t magnitude(const plush_toy *toy, const uint8_t *parts, uint32_t n)
{
    uint64_t sum = 0;

    for (; n > 0; n--)
        sum += square(from_zero(toy, *parts++));
    return as_signed(square_root(sum << 8)); /* with 4 fraction bits */
}

/* A running mean after one more value. At first it follows as fast as its few samples allow. */
static int32_t follow_mean(const plush_toy *toy, int32_t *mean, int32_t x, uint32_t shift)
{
    *mean += shift_down(x * (INT32_C(1) << MEAN_BITS) - *mean, shift < toy->mean_shift ? shift : toy->mean_shift);
    return shift_down(*mean, MEAN_BITS - MEAN_SHOWN_BITS);
}

/* One more sample, up to 2^15; `mean_shift` is the binary logarithm of their number. */
PLUSH_SMALL PLUSH_CODE static void count_means(plush_toy *toy)
{
    if (toy->mean_samples >> MOST_MEAN_SHIFT != 0)
        return;
    toy->mean_samples++;
    if (toy->mean_samples >> (toy->mean_shift + 1u) != 0)
        toy->mean_shift++;
}

/* What a channel of the network becomes in 8 bits. */
PLUSH_CODE
static uint8_t to_code(int32_t x, const uint8_t *scale)
{
    int32_t offset = as_signed(le32(scale)), limit = (int32_t)(UINT32_MAX >> (17 - scale[10]));
    uint32_t distance = distance_of(x, offset);

    if (distance > (uint32_t)limit)
        distance = (uint32_t)limit;
    x = shift_down(x >= offset ? (int32_t)distance : -(int32_t)distance, scale[10]);
    return (uint8_t)within(shift_down(x * (int32_t)le16(scale + 8) + as_signed(le32(scale + 4)), scale[11]), 0, 255);
}

/* The unit vector with the direction of gravity; zeros where there is none. */
static void direction(const int32_t *gravity, int32_t *up)
{
    uint32_t size[3], top = 0, length, i;

    for (i = 0; i < 3; i++) {
        size[i] = distance_of(gravity[i], 0);
        top |= size[i];
    }
    for (i = 0; i < 3; i++)
        up[i] = 0;
    if (top == 0)
        return;
    for (; top >> (UNIT_BITS + 1) != 0; top >>= 1)
        for (i = 0; i < 3; i++)
            size[i] >>= 1;
    for (; top >> UNIT_BITS == 0; top <<= 1)
        for (i = 0; i < 3; i++)
            size[i] <<= 1;
    length = short_root(size[0] * size[0] + size[1] * size[1] + size[2] * size[2]);
    for (i = 0; i < 3; i++) {
        up[i] = (int32_t)((size[i] << UNIT_BITS) / length);
        if (gravity[i] < 0)
            up[i] = -up[i];
    }
}

static int32_t dot(const int32_t *one, const int32_t *other)
{
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
}

/* Floor of a * unit / 2^14, where the product may need more than 32 bits. */
static int32_t times_unit(int32_t a, int32_t unit)
{
    int32_t high = shift_down(a, UNIT_BITS), low = a - high * (INT32_C(1) << UNIT_BITS);

    return high * unit + shift_down(low * unit, UNIT_BITS);
}

/* The newest row of axes, each of 16 bits. */
static void put_axes(plush_toy *toy, const int32_t *axes)
{
    const uint8_t *p = toy->vector_plan;
    uint32_t width = 3u * toy->vectors, v, i;
    int16_t *row;

    toy->vector_newest = (uint8_t)(toy->vector_newest + 1u < toy->vector_taps ? toy->vector_newest + 1u : 0u);
    row = toy->axes + toy->vector_newest * width;
    for (v = 0; v < toy->vectors; v++, p += 1u + toy->vector_kernels * (1u + toy->vector_taps)) {
        int32_t up = *p >= MOST_AXIS_SHIFT, shift = up ? *p - (int32_t)MOST_AXIS_SHIFT : (int32_t)MOST_AXIS_SHIFT - *p;
        int32_t limit = up ? AXIS_LIMIT >> shift : AXIS_LIMIT * (INT32_C(1) << shift);

        for (i = 0; i < 3; i++) {
            int32_t x = within(*axes++, -limit, limit);

            *row++ = (int16_t)(up ? x * (INT32_C(1) << shift) : shift_down(x, (uint32_t)shift));
        }
    }
}

/* The sums of one kernel over the taps of three axes, from the oldest; `axes` are those of the first row. */
PLUSH_APART
static void convolve(const plush_toy *toy, const int16_t *axes, const uint8_t *weights, uint32_t sum[3])
{
    uint32_t width = 3u * toy->vectors, taps = toy->vector_taps, s0 = 0, s1 = 0, s2 = 0;
    const int16_t *end = axes + taps * width, *a = axes + toy->vector_newest * width;

    for (; taps > 0; taps--) {
        uint32_t w = *weights++;

        a += width;
        if (a == end)
            a = axes;
        s0 += w * bits_of(a[0]);
        s1 += w * bits_of(a[1]);
        s2 += w * bits_of(a[2]);
    }
    sum[0] = s0;
    sum[1] = s1;
    sum[2] = s2;
}

/* What does not turn with the toy, of one vector; `plan` are its kernels. Returns the next vector's. */
static const uint8_t *invariants(plush_toy *toy, const int16_t *axes, const uint8_t *plan, const int32_t *up,
                                 uint8_t *row, const uint8_t *scale)
{
    uint32_t kernels = toy->vector_kernels, width = 3u * toy->vectors, total[3] = {0, 0, 0}, k, i, n;

    for (n = 0; n < toy->vector_taps; n++)
        for (i = 0; i < 3; i++)
            total[i] += bits_of(axes[n * width + i]);
    for (k = 0; k < kernels; k++, plan += 1u + toy->vector_taps) {
        int32_t *h = toy->across + 3 * k, d[3], v;
        uint32_t sum[3];

        convolve(toy, axes, plan + 1, sum);
        for (i = 0; i < 3; i++)
            d[i] = shift_down(as_signed(sum[i] - WEIGHT_ZERO * total[i]), *plan);
        v = shift_down(dot(d, up), UNIT_BITS);
        for (i = 0; i < 3; i++)
            h[i] = d[i] - shift_down(v * up[i], UNIT_BITS);
        row[k] = to_code(v, scale + INPUT_BYTES * k);
        row[kernels + k] = to_code((int32_t)short_root((uint32_t)dot(h, h)), scale + INPUT_BYTES * (kernels + k));
    }
    for (k = 0; k < kernels; k++) {
        const int32_t *h = toy->across + 3 * k, *next = toy->across + (k + 1u < kernels ? 3 * (k + 1u) : 0);
        int32_t turn = times_unit(h[1] * next[2] - h[2] * next[1], up[0]) +
                       times_unit(h[2] * next[0] - h[0] * next[2], up[1]) +
                       times_unit(h[0] * next[1] - h[1] * next[0], up[2]);
        int32_t size = (int32_t)short_root(distance_of(turn, 0));

        row[2 * kernels + k] = to_code(turn < 0 ? -size : size, scale + INPUT_BYTES * (2 * kernels + k));
    }
    return plan;
}

/* The vector layer: the other inputs as they are, and what does not turn with the toy of the rest. For size, as most
 * networks have none. */
PLUSH_SMALL_APART PLUSH_CODE
static void vector_sample(plush_toy *toy, const int32_t *x, uint8_t *row)
{
    uint32_t others = toy->inputs - 3u * toy->vectors - 3u, outputs = 3u * toy->vector_kernels, i;
    const uint8_t *plan = toy->vector_plan;
    int32_t up[3];

    put_axes(toy, x + others);
    direction(x + toy->inputs - 3, up);
    for (i = 0; i < others; i++)
        row[i] = to_code(x[i], toy->input_scales + INPUT_BYTES * i);
    for (i = 0; i < toy->vectors; i++)
        plan = invariants(toy, toy->axes + 3 * i, plan + 1, up, row + others + outputs * i,
                          toy->input_scales + INPUT_BYTES * (others + outputs * i));
}

/* What the network reads of toy->sample, into the first ring. */
static void read_inputs(plush_toy *toy)
{
    const uint8_t *p = toy->input_plan;
    uint8_t *row = next_row(&toy->layer[0]);
    int32_t *x = has_gate(toy) ? past_inputs(toy, 0) : toy->vectors != 0 ? toy->raw : NULL, *mean = toy->mean;
    uint32_t i;

    count_means(toy);
    for (i = 0; i < toy->inputs; i++, p += 3 + p[1]) {
        int32_t value = p[0] == MAGNITUDE ? magnitude(toy, p + 3, p[1]) : from_zero(toy, p[3]);

        if (p[0] == GRAVITY)
            value = follow_mean(toy, mean++, value, p[2]);
        if (x != NULL)
            x[i] = value;
        if (toy->vectors == 0)
            row[i] = to_code(value, toy->input_scales + INPUT_BYTES * i);
    }
    if (toy->vectors != 0)
        vector_sample(toy, x, row);
}

/* One even sample, in toy->sample. Returns 1 when an answer fell due. */
PLUSH_CODE
static uint32_t push_sample(plush_toy *toy, uint32_t ms)
{
    calibrate(toy);
    read_inputs(toy);
    if (has_gate(toy))
        gate_sample(toy, ms);
    network_sample(toy);
    toy->answer.sample++;
    if (toy->warm < toy->span)
        toy->warm++;
    if (++toy->filled < toy->step)
        return 0;
    answer(toy, ms);
    return 1;
}

/* Every channel's value `into` units after the frame before, `between` units before this one; rounded half up. */
static void interpolate(plush_toy *toy, uint32_t into, uint32_t between)
{
    uint32_t i;

    for (i = 0; i < toy->channels; i++) {
        uint32_t from = (uint32_t)toy->before[i], to = (uint32_t)toy->held[i];

        if (into == between)
            from = to;
        else if (toy->held[i] >= toy->before[i])
            from += part_of(to - from, 2 * into, 2 * between, between, toy->narrow);
        else
            from -= part_of(from - to, 2 * into, 2 * between, between - 1, toy->narrow);
        toy->sample[i] = as_signed(from);
    }
}

/* Takes the valid values over. Returns 0 while a channel has not had one. */
static int hold(plush_toy *toy, const int32_t *values)
{
    uint32_t i;
    int all = 1;

    for (i = 0; i < toy->channels; i++) {
        if (lies_in(toy->ranges + RANGE_BYTES * i, values[i])) {
            toy->held[i] = values[i];
            toy->valid[i] = 1;
        } else {
            toy->invalid++;
        }
        if (!toy->valid[i])
            all = 0;
    }
    return all;
}

static void say_nothing(plush_toy *toy, plush_state state)
{
    uint32_t ms = toy->answer.ms;

    memset(&toy->answer, 0, sizeof toy->answer);
    toy->answer.ms = ms;
    toy->answer.state = state;
}

/* What was remembered of frames and of the network is dropped; what health knows stays. */
PLUSH_SMALL static void forget(plush_toy *toy)
{
    uint32_t phase;

    memset(toy->held, 0, (size_t)((uint8_t *)toy->last - (uint8_t *)toy->held));
    toy->waiting = 0;
    toy->heard = toy->running = 0;
    toy->block = toy->gate_deaf = 0;
    toy->gate_seen = toy->gate_newest = toy->gate_doubt = 0;
    toy->mean_samples = toy->mean_shift = toy->vector_newest = 0;
    toy->warm = toy->answer.sample = 0;
    say_nothing(toy, toy->faulty ? PLUSH_FAULT : PLUSH_WARMING);
    /* So that a step ends with the very sample that fills the span. */
    phase = toy->span % toy->step;
    toy->filled = (uint16_t)(phase == 0 ? 0 : toy->step - phase);
}

/* ---- What others call ------------------------------------------------------------------------------------------ */

/* A toy with this model, which check() found good, and memory. Nothing is written to the memory; a toy of which this does
 * not say PLUSH_OK is of no use. */
PLUSH_SMALL_APART
static plush_status prepare(plush_toy *toy, const uint8_t *model, void *memory, uint32_t memory_bytes)
{
    memset((uint8_t *)toy + KEPT_BYTES, 0, sizeof *toy - KEPT_BYTES);
    if ((uintptr_t)model % GROUP != 0)
        return PLUSH_NOT_ALIGNED;
    if (!read_model(toy, model))
        return PLUSH_DAMAGED;
    if (!is_aligned(memory))
        return PLUSH_MEMORY_NOT_ALIGNED;
    if (memory == NULL || share_out(toy, NULL) > memory_bytes)
        return PLUSH_MEMORY_TOO_SMALL;
    share_out(toy, (uint8_t *)memory);
    return PLUSH_OK;
}

/* By itself, as take_over() below, so that the stack never holds a toy and the words of checksum() together. */
PLUSH_SMALL_APART
static uint32_t bytes_needed(const uint8_t *model)
{
    plush_toy toy;

    /* Without memory, only that can be wrong with a good model. */
    return prepare(&toy, model, NULL, 0) == PLUSH_MEMORY_TOO_SMALL ? share_out(&toy, NULL) : 0;
}

PLUSH_SMALL uint32_t plush_memory_bytes(const uint8_t *model, uint32_t model_bytes)
{
    return check(model, model_bytes, "PLSH") == PLUSH_OK ? bytes_needed(model) : 0;
}

PLUSH_APART
void plush_restart(plush_toy *toy)
{
    if (toy->held == NULL) /* plush_begin() has not said PLUSH_OK */
        return;
    lose(toy, toy->seen_ms);
    forget_health(toy);
    forget(toy);
    toy->follows = 0;
    toy->seen_ms = 0;
}

#ifdef PLUSH_CALIBRATE
PLUSH_SMALL void plush_recalibrate(plush_toy *toy)
{
    if (toy->held != NULL)
        begin_sensors(toy);
}
#endif

PLUSH_SMALL plush_status plush_begin(plush_toy *toy, const uint8_t *model, uint32_t model_bytes, void *memory,
                         uint32_t memory_bytes)
{
    plush_status status;

    if (toy->self != toy)
        memset(toy, 0, sizeof *toy);
    else if (going_on(toy)) /* nothing here reads the old model or memory, which may be gone */
        tell(toy, PLUSH_ENDED, toy->seen_ms, toy->seen_ms);
    memset(toy, 0, offsetof(plush_toy, on_answer));
    status = check(model, model_bytes, "PLSH");
    if (status == PLUSH_OK)
        status = prepare(toy, model, memory, memory_bytes);
    if (status != PLUSH_OK) {
        memset(toy, 0, sizeof *toy);
        return status;
    }
    toy->self = toy;
    begin_sensors(toy);
    plush_restart(toy);
    return PLUSH_OK;
}

PLUSH_SMALL_APART
static plush_status take_over(plush_toy *toy, const uint8_t *model, void *memory, uint32_t memory_bytes)
{
    plush_toy next;
    plush_status status = prepare(&next, model, memory, memory_bytes);

    if (status != PLUSH_OK)
        return status;
    if (toy->held == NULL || toy->layout != next.layout || toy->channels != next.channels)
        return PLUSH_OTHER_LAYOUT;
    lose(toy, toy->seen_ms); /* while the old model can still be read */
    memcpy(&next, toy, KEPT_BYTES);
    *toy = next;
    begin_sensors(toy);
    plush_restart(toy);
    return PLUSH_OK;
}

PLUSH_SMALL plush_status plush_swap(plush_toy *toy, const uint8_t *model, uint32_t model_bytes, void *memory,
                        uint32_t memory_bytes)
{
    plush_status status = check(model, model_bytes, "PLSH");

    return status == PLUSH_OK ? take_over(toy, model, memory, memory_bytes) : status;
}

PLUSH_SMALL uint32_t plush_model_id(const plush_toy *toy)
{
    return toy->held != NULL ? word_at(toy->ranges - SHAPE_BYTES - 4) : 0;
}

PLUSH_SMALL plush_status plush_patch(plush_toy *toy, const uint8_t *patch, uint32_t patch_bytes)
{
    uint32_t scales = SCALE_BYTES * toy->classes, weights = toy->classes * pooled(toy);
    const uint8_t *layer;

    if (toy->held == NULL)
        return PLUSH_OTHER_MODEL;
    layer = toy->classes_told - weights - scales; /* what stands before them in the model */
    if (patch != NULL) {
        plush_status status = check(patch, patch_bytes, "PLPT");
        source from;

        if (status != PLUSH_OK)
            return status;
        layer = patch + HEAD_BYTES + 4;
        from.at = layer;
        from.left = weights + scales;
        if (word_at(patch + 8) != HEAD_BYTES + 4 + from.left ||
            word_at(patch + HEAD_BYTES) != plush_model_id(toy))
            return PLUSH_OTHER_MODEL;
        if (next_scales(&from, toy->classes) == NULL)
            return PLUSH_DAMAGED;
    }
    toy->dense = layer;
    toy->dense_weights = layer + scales;
    return PLUSH_OK;
}

void plush_silence(plush_toy *toy)
{
    if (toy->held != NULL)
        lose(toy, toy->seen_ms);
}

/* Samples begin with the values that are held, at this time. */
static void begin_samples(plush_toy *toy, uint32_t ms)
{
    uint32_t usual = toy->period * 256 / toy->units_per_ms;

    toy->running = 1;
    toy->last_ms = ms;
    toy->due = toy->period;
    toy->interval = (uint16_t)(usual < UINT16_MAX ? usual : UINT16_MAX);
    toy->sparse = 0;
    memcpy(toy->sample, toy->held, 4u * toy->channels);
}

/* One more reading, so long after the last one that was used. */
static void follow_interval(plush_toy *toy, uint32_t ms)
{
    int32_t now = (int32_t)(ms < 255 ? ms : 255) * 256;

    toy->interval = (uint16_t)(toy->interval + shift_down(now - toy->interval, 4));
    toy->sparse = toy->interval * toy->units_per_ms > 512 * toy->period;
}

/* Whether a reading is left out: its time is before that of the one before by no more than the gap; or it is out of order,
 * and the one before was not: if the next one is, too, the clock is right. */
static int leaves_out(plush_toy *toy, uint32_t ms)
{
    uint32_t gap_ms = toy->gap / toy->units_per_ms, seen = toy->seen_ms;
    int early = ms < seen && seen - ms <= gap_ms;

    if (ms >= seen && ms - seen <= gap_ms) {
        if (ms == seen && toy->follows)
            toy->bad_stamps++;
    } else if (early || toy->follows) {
        toy->follows = (uint8_t)(toy->follows & early);
        toy->bad_stamps++;
        toy->reading = PLUSH_READING_LEFT_OUT;
        return 1;
    } else {
        lose(toy, seen);
        forget_health(toy);
        if (toy->heard) { /* not in a fault, nor with the very first frame */
            toy->restarts++;
            forget(toy);
        }
    }
    toy->follows = 1;
    return 0;
}

PLUSH_CODE
uint32_t plush_push(plush_toy *toy, uint32_t ms, const int32_t *values)
{
    uint32_t between, due = 0;

    if (toy->held == NULL || leaves_out(toy, ms)) /* plush_begin() has not said PLUSH_OK */
        return 0;
    toy->seen_ms = ms;
    if (examine(toy, ms, values)) {
        if (toy->faulty)
            lose(toy, ms);
        forget(toy);
    }
    toy->reading = PLUSH_READING_FAULT;
    if (toy->faulty)
        return 0;
    toy->heard = 1;
    toy->reading = PLUSH_READING_WAITING;
    if (toy->running)
        memcpy(toy->before, toy->held, 4u * toy->channels);
    if (!hold(toy, values))
        return 0;
    toy->reading = PLUSH_READING_USED;
    if (!toy->running) {
        toy->reading = PLUSH_READING_FIRST;
        begin_samples(toy, ms);
        return push_sample(toy, ms);
    }
    follow_interval(toy, ms - toy->last_ms);
    between = (ms - toy->last_ms) * toy->units_per_ms;
    if (2 * between >= 3 * toy->period) /* all samples but the last */
        toy->interpolated += (between - toy->due) / toy->period;
    while (toy->due <= between) { /* never for an equal stamp: a sample at the last frame's time is already made */
        interpolate(toy, toy->due, between);
        due += push_sample(toy, toy->last_ms + toy->due / toy->units_per_ms);
        toy->due += toy->period;
    }
    toy->due -= between;
    toy->last_ms = ms;
    return due;
}

PLUSH_SMALL uint32_t plush_push_many(plush_toy *toy, const int32_t *frames, uint32_t n, uint32_t last_ms, uint32_t period_us)
{
    uint32_t due = 0;

    for (; n > 0; frames += toy->channels) {
        uint32_t early_ms = (--n * period_us + 999) / 1000;

        if (early_ms <= last_ms)
            due += plush_push(toy, last_ms - early_ms, frames);
    }
    return due;
}

PLUSH_SMALL int plush_prime(plush_toy *toy, uint32_t ms, const int32_t *values)
{
    plush_restart(toy);
    toy->seen_ms = ms;
    plush_push(toy, ms, values);
    if (toy->reading != PLUSH_READING_FIRST)
        return 0;
    while (toy->warm + toy->step < toy->span) {
        memcpy(toy->sample, toy->held, 4u * toy->channels); /* calibrating has changed it */
        push_sample(toy, ms);
    }
    return 1;
}

PLUSH_SMALL uint8_t plush_probability(const plush_toy *toy, uint8_t gesture)
{
    return (uint8_t)(gesture < toy->classes ? share_of(toy, gesture) * 255 / PLUSH_ONE : 0u);
}

/* The label of a class, or the title, which stands after them. */
PLUSH_SMALL_APART
static const char *text_of(const plush_toy *toy, uint32_t n)
{
    const uint8_t *p = toy->classes_told + toy->classes;

    for (; n > 0; n--)
        while (*p++ != 0) {
        }
    return (const char *)p;
}

PLUSH_SMALL const char *plush_gesture_name(const plush_toy *toy, uint8_t gesture)
{
    return gesture < toy->classes ? text_of(toy, gesture) : "";
}

PLUSH_SMALL const char *plush_model_title(const plush_toy *toy)
{
    return toy->held != NULL ? text_of(toy, toy->classes) : "";
}
