/*
 * PlushSense: what a soft toy feels, in whole numbers.
 *
 *     static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];          // from plush_model.h
 *     static plush_toy toy;
 *
 *     status = plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory); // PLUSH_OK, or why not
 *     toy.on_event = react;                                      // void react(const plush_toy *toy, void *user)
 *     ...
 *     plush_push(&toy, milliseconds, readings);                  // every reading of the sensors
 *
 * React to events (toy->event in on_event): one for each touch, with a beginning, at times a name that comes later, and
 * an end. An answer (toy.answer), by contrast, is what the network makes of one step, sure or not.
 *
 * C99 or C++; no heap, no recursion, no floating point, nothing of the C library but <stdint.h> and <string.h>.
 * Every toy keeps all it remembers in its own plush_toy and its own memory, so that several can run side by side.
 * The answers are, bit for bit, those of `plushsense live --engine int8` on the computer.
 *
 * Missed ticks. Readings carry the time at which they were taken, and only that time counts: reading late, or several
 * at once, changes no answer. Readings that are missing for up to the model's gap (100 ms as a rule) are bridged by
 * interpolation, and every answer that fell due meanwhile is given, in order. A reading that is earlier than the last one, by
 * no more than the gap, is left out: stamps of buffered readings (FIFO) are often a few ms off. A reading after a longer gap,
 * or whose clock runs backwards further (also when it wraps after 2^32 ms), is left out, too, so that a single wrong time does
 * no harm. If the next one does not follow on the last one that was used either, everything remembered is dropped: the toy is
 * warming again. What was going on ends then, with that reading; if none may ever come, call plush_silence() when you miss it.
 *
 * Time has steps of 1 ms. A reading is taken to be up to 1 ms older than it is; of readings every 10 ms with stamps that are
 * cut to whole ms, a movement of 3 Hz differs by 0.5 % of its size (rms), one of 10 Hz by 1.6 %, and stamps of a timer that
 * ticks in whole ms by nothing. Recordings have the same steps, so the network has learned from such data.
 *
 * plush_push() takes its time where it is called: mostly that of one sample, after a gap that of all samples of the gap.
 * `plushsense profile` says how much at most. It switches no interrupt off and waits for nothing.
 *
 * Sensors that cannot be believed (values out of range, stuck at an end, all frozen) are a fault: the event that is
 * going on ends, readings are passed over (PLUSH_FAULT), and after a while of good ones everything begins again.
 */
#ifndef PLUSHSENSE_H
#define PLUSHSENSE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* #undef PLUSH_CALIBRATE */
#ifdef PLUSH_CALIBRATE /* a model whose sensors find their offset and scale themselves; see plush_calibrate.h */
#define PLUSH_IMAGE_VERSION 11
#else
#define PLUSH_IMAGE_VERSION 10
#endif /* and two more, of models that pool deviations beside means: the library reads both */
#define PLUSH_MAX_LAYERS 4
#define PLUSH_ONE 32768 /* a confidence or probability of 1 */
#define PLUSH_NO_GESTURE 255
#define PLUSH_NO_READING INT32_MIN /* a value for a sensor that gave none: out of the valid range of each channel that has one */

/* A status that nobody looks at is a toy that never answers. */
#if defined(__GNUC__)
#define PLUSH_LOOK_AT __attribute__((warn_unused_result))
#else
#define PLUSH_LOOK_AT
#endif

/* What plush_begin, plush_swap and plush_patch say. */
typedef enum {
    PLUSH_OK = 0,
    PLUSH_NOT_A_MODEL = 1,     /* the bytes do not begin with PLSH, or those of a patch with PLPT */
    PLUSH_OTHER_VERSION = 2,   /* a model for another version of this library */
    PLUSH_DAMAGED = 3,         /* cut off, its checksum does not match, or what stands in it does not hold together */
    PLUSH_MEMORY_TOO_SMALL = 4, /* give plush_memory_bytes() bytes */
    PLUSH_OTHER_LAYOUT = 5,     /* plush_swap: a model for other channels, or no model is running */
    PLUSH_OTHER_MODEL = 6,      /* plush_patch: a patch of another model, or no model is running */
    PLUSH_NOT_ALIGNED = 7,      /* the address of the model's first byte is no multiple of 4 */
    PLUSH_MEMORY_NOT_ALIGNED = 8 /* the memory is not aligned for uint32_t */
} plush_status;

/* PLUSH_FAULT: the sensors cannot be believed; there are no answers until they have recovered. */
typedef enum { PLUSH_WARMING = 0, PLUSH_TRACKING = 1, PLUSH_FAULT = 2 } plush_state;

typedef enum {
    PLUSH_AFFECT_NONE = 0,
    PLUSH_AFFECT_POSITIVE = 1,
    PLUSH_AFFECT_NEUTRAL = 2,
    PLUSH_AFFECT_NEGATIVE = 3
} plush_affect;

/* What became of the newest reading: why plush_push() returned what it did. Only PLUSH_READING_FIRST and PLUSH_READING_USED
 * were used; else no answer fell due. */
typedef enum {
    PLUSH_READING_NONE = 0,     /* there was none yet; or no model is running, because plush_begin() has not said PLUSH_OK */
    PLUSH_READING_WAITING = 1,  /* some channel has had no valid value yet since the start or the last restart */
    PLUSH_READING_FAULT = 2,    /* passed over: the sensors cannot be believed */
    PLUSH_READING_FIRST = 3,    /* used as the first of a stream: after the start, a gap, a clock that ran backwards, a fault */
    PLUSH_READING_USED = 4,     /* used to go on; 0 answers fell due unless it completed a step */
    PLUSH_READING_LEFT_OUT = 5  /* left out: its time is before that of the last one used, or further after it than the gap */
} plush_reading;

/* What an answer is worth. */
typedef enum {
    PLUSH_IDLE = 0,    /* nobody does anything */
    PLUSH_UNKNOWN = 1, /* a touch, but none that the network knows */
    PLUSH_UNSURE = 2,
    PLUSH_SURE_AFFECT = 3,  /* sure of the affect, not of the gesture */
    PLUSH_SURE_GESTURE = 4
} plush_kind;

/* What happened to an event. */
typedef enum {
    PLUSH_NOTHING = 0, /* there was no event yet */
    PLUSH_BEGUN = 1,   /* its affect is sure; its gesture too, unless that is PLUSH_NO_GESTURE */
    PLUSH_NAMED = 2,   /* now its gesture is sure */
    PLUSH_ENDED = 3
} plush_what;

typedef enum { PLUSH_NETWORK = 0, PLUSH_GATE = 1 } plush_source;

/* Their names, for your log: static const char *const states[] = PLUSH_STATE_NAMES; */
#define PLUSH_STATUS_NAMES                                                                                               \
    {"ok", "not a model", "other version", "damaged", "memory too small", "other layout", "other model", "not aligned", \
     "memory not aligned"}
#define PLUSH_STATE_NAMES {"warming", "tracking", "fault"}
#define PLUSH_READING_NAMES {"none", "waiting", "fault", "first", "used", "left out"}
#define PLUSH_KIND_NAMES {"idle", "unknown", "unsure", "sure affect", "sure gesture"}
#define PLUSH_WHAT_NAMES {"nothing", "begun", "named", "ended"}

/* The newest thing that happened to an event: it is going on unless `what` is PLUSH_NOTHING or PLUSH_ENDED. */
typedef struct {
    plush_what what;
    uint32_t number;     /* of the event, from 1; wraps */
    plush_affect affect;
    uint8_t gesture;     /* class index, or PLUSH_NO_GESTURE */
    plush_source source; /* who began it: the network, or the gate, which notices blows within a few samples */
    uint32_t since_ms;   /* when it was first wanted; of an end, when it was first missed */
    uint32_t ms;         /* when this was said: the time of the newest sample, rounded down */
} plush_event;

/* An answer. While warming, only `ms`, `state` and `sample` mean anything; the rest is 0. */
typedef struct {
    uint32_t ms;         /* time of the newest sample that it knows, rounded down */
    uint32_t sample;     /* even samples since the start or the last restart; wraps */
    plush_state state;
    plush_affect affect;
    plush_kind kind;
    uint16_t confidence; /* smoothed probability of the gesture, in steps of 1/32768 */
    int16_t known;       /* how clearly a gesture stands out: its logit less the third highest, smoothed, in steps of 1/256 */
    uint8_t gesture;     /* class index; see plush_gesture_name() */
} plush_answer;

/* One layer of the network. */
typedef struct {
    uint16_t kernel;
    uint16_t filters;
    uint16_t groups;        /* of 4 channels that it reads */
    uint16_t dilation;
    uint16_t phase;         /* of the newest sample: samples `dilation` apart have the same one */
    uint16_t row;           /* of the newest sample in its phase */
    uint32_t *ring;         /* dilation x rows x groups x 4 activations */
    uint32_t *taps[2];      /* the oldest row under the taps of the newest sample, and of the one before */
    const uint8_t *scales;  /* of each filter: bias, multiplier, shifts */
    const uint8_t *weights;
    uint32_t *tap_sums;     /* for each of the next `dilation` samples: sum of the activations already under its taps */
} plush_layer;

/* A toy: everything about one stream. Fields from `answer` to `sensitivity` may be read, of them only the last one be written. */
typedef struct plush_toy {
    plush_answer answer;     /* the newest one; its `state` is that of the toy at any time */
    plush_event event;       /* the newest thing that happened to an event */
    uint32_t answers;        /* how many there were; wraps, like all counts */
    uint32_t restarts;       /* gaps and clock resets */
    uint32_t invalid;        /* values out of their valid range, for which the last valid one stood in */
    uint32_t faults;         /* how often sensors could not be believed */
    uint32_t bad_stamps;     /* readings that were left out, or have the time of the one before */
    uint32_t interpolated;   /* samples made up for readings that did not come, in intervals of 1.5 periods and more */
    uint16_t interval;       /* between readings, smoothed, in 1/256 ms: their rate is 256000 / interval Hz; up to 255 ms */
    uint8_t sparse;          /* a warning: the interval is over 2 periods, so most samples are made up */
    uint8_t suspect;         /* the newest frame is in doubt: no event begins on it */
    uint8_t reading;         /* what became of the newest one: a plush_reading */

    /* Called with every answer, and with everything that happens to an event, also when one frame completes several;
     * may be NULL. One frame may end an event and begin the next one: in on_event remember both, not only the newest.
     * Set them after the first plush_begin(). They may read the toy, but call no function that changes it
     * (plush_push, plush_prime, plush_silence, plush_restart, plush_begin, plush_swap, plush_patch). A step's event comes before its answer. */
    void (*on_answer)(const struct plush_toy *toy, void *user);
    void (*on_event)(const struct plush_toy *toy, void *user);
    void *user;
    const struct plush_toy *self; /* this toy, since its first plush_begin() */

    int8_t sensitivity;      /* yours to set: how readily the network begins and keeps events; 0: as trained. Each step, up to
                              * 127 down to -128, takes 1/512 from the probabilities that this asks for; not of the gate */

    /* What follows is sorted by size, so that no byte is lost between fields; cores reach the first ones with fewer
     * instructions. The model's sizes: `channels` and `layout` may be read, too: `layout` stands for the names, units, steps
     * and order of the channels in a frame, and PLUSH_MODEL_LAYOUT says it of the model that your program was made for. */
    uint8_t layers, channels, inputs, classes;
    uint8_t means, vectors, vector_kernels, vector_taps;
    uint8_t gate_signals, gate_rules, gate_past;

    uint8_t heard, running;  /* clock: a frame has come; samples are being made */
    uint8_t follows;         /* the frame before was not left out */
    uint8_t mean_shift, vector_newest, deviations;
    uint8_t gate_seen, gate_newest, gate_doubt;
    uint8_t faulty, compared; /* health: there is a fault; there was a frame to compare with */
    uint8_t wrong, good;      /* some channel is wrong since `wrong_ms`; all is good since `good_ms` */
    uint8_t started;         /* the smoothing has begun */
    uint8_t waiting;         /* the newest sample is computed together with the next one */
    uint8_t named;           /* events: see `wanted` */

    uint16_t step, blocks, features, smoothing, layout, gate_terms, gate_bytes;
    uint16_t filled, block, mean_samples, gate_deaf;
    /* Events: what is wanted (an affect, or 4 + a gesture of none), for how many steps, since when; the same of a
     * gesture; how long the event lasted, is missed, waits for its name; how long none may begin. */
    uint16_t wanted, wanted_for, named_for, lasted, away, wait, resting;

    /* Clock: all in the model's own units of time, reckoned from the newest frame, so that nothing grows. */
    uint32_t period, gap, units_per_ms, narrow;
    uint32_t seen_ms, last_ms;
    uint32_t due;            /* from the last usable frame to the next sample */
    uint32_t span, warm;     /* samples that the network asks for; that there were, up to these */
    uint32_t wrong_ms, good_ms, moved_ms, wanted_ms, away_ms;

    /* The model, as it was read. */
    const uint8_t *ranges, *input_plan, *vector_plan, *input_scales, *dense, *dense_weights, *classes_told;
    const uint8_t *event_plan, *health_plan, *limits, *gate_plan, *gate_first_rule;

    /* The memory, in this order. */
    int32_t *held, *before, *sample;
    int32_t *raw, *mean;     /* the inputs of the newest sample, for a vector layer without a gate; running means */
    int16_t *axes;           /* of the newest samples */
    int32_t *across;         /* horizontal parts of the vectors of the vector layer's kernels */
    uint16_t *sums;          /* blocks x features */
    uint32_t *total;         /* of each feature: its sum over all blocks; then, if `deviations`, how much these differ */
    int32_t *logits;         /* of each class, in steps of 1/256 */
    int32_t *smooth;         /* of each class: probability in steps of 2^-27; after them the highest logit in 2^-20 */
    int32_t *gate_inputs, *gate_state; /* the inputs of the newest samples, what it knows of each signal, */
    uint16_t *gate_hold;               /* and of each term of a rule */
    uint8_t *gate_in_row;
    uint8_t *valid;          /* of each channel: whether it has had a valid value */
    uint8_t *top;            /* the last layer's newest activations */
    int32_t *last;           /* the values of the frame before, as they came: the first that a restart keeps */
#ifdef PLUSH_CALIBRATE
    const uint8_t *sensor_plan;
    struct plush_sensor *sensor;
    uint8_t sensors;
#endif
    plush_layer layer[PLUSH_MAX_LAYERS];
} plush_toy;

/* Bytes of memory that a toy with this model needs; 0 when these bytes are no usable model. */
uint32_t plush_memory_bytes(const uint8_t *model, uint32_t model_bytes);

/* Makes a toy ready. The model's bytes and the memory must stay where they are, both at a multiple of 4, and only the toy
 * may write to the memory. Any bytes may be given as a model: they are looked through before anything is believed. Begin again at any
 * time, with the same model or another: what is going on ends, which on_event is told; callbacks and sensitivity stay, counts
 * begin anew. Unless this says PLUSH_OK, the toy is all zeros: it takes readings, and never has an answer, as a static
 * plush_toy before its beginning. */
PLUSH_LOOK_AT
plush_status plush_begin(plush_toy *toy, const uint8_t *model, uint32_t model_bytes, void *memory,
                         uint32_t memory_bytes);

/* Puts another model for the same channels in the place of the running one. All of it is looked through first: unless
 * this says PLUSH_OK, neither the toy nor any memory has changed, and the old model goes on. Then what is going on ends,
 * which on_event is told as ever, by the old model; callbacks and counts stay; the toy is warming, as after
 * plush_begin(). `memory` may be that of the old model. Until PLUSH_OK the old model's bytes must stay where they are:
 * receive the new ones somewhere else. Needs a kilobyte of stack, as plush_begin() does. A checksum finds damage, not
 * forgery. */
PLUSH_LOOK_AT
plush_status plush_swap(plush_toy *toy, const uint8_t *model, uint32_t model_bytes, void *memory,
                        uint32_t memory_bytes);

/* Puts the last layer of a patch, fitted to one person, in the place of the model's own: from the next step on, with all
 * that is remembered, without warming again. The patch's bytes must stay where they are; they need no alignment. All of
 * them are looked through first: unless this says PLUSH_OK, nothing has changed. NULL brings the model's own layer back,
 * as do plush_begin() and plush_swap(); a restart does not. */
PLUSH_LOOK_AT
plush_status plush_patch(plush_toy *toy, const uint8_t *patch, uint32_t patch_bytes);

/* Takes the readings of one moment in: `ms` is the toy's own clock, `values` the measured channels in the order of
 * the layout. Returns how many answers fell due, mostly 0 or 1; the newest is in toy->answer. Where that is 0,
 * toy->reading tells why. */
uint32_t plush_push(plush_toy *toy, uint32_t ms, const int32_t *values);

/* The same for `n` frames in turn, as the buffer (FIFO) of a sensor holds them: the last one was measured at `last_ms`, each
 * other one `period_us` before the next (104 Hz: 9615 us), rounded down to whole ms. Their span is less than an hour.
 * Frames from before the time 0 are left out. */
uint32_t plush_push_many(plush_toy *toy, const int32_t *frames, uint32_t n, uint32_t last_ms, uint32_t period_us);

/* Begins again as if `values`, a reading of the toy at rest, had come for as long as the network looks back, until `ms`:
 * the first answer then falls due a step later, not only when the toy has warmed. For the end of a sleep or a silence.
 * What is going on ends; on_answer sees the steps on the way, warming. Takes as long as those steps (tens of ms on most
 * chips). Returns 0, and the toy is warming, when no model is running, a value is out of its range, or there is a fault. */
int plush_prime(plush_toy *toy, uint32_t ms, const int32_t *values);

/* The smoothed probability of a class, in steps of 1/255, rounded down; 0 while warming, and of no class. */
uint8_t plush_probability(const plush_toy *toy, uint8_t gesture);

/* No reading came for a while (your program knows best how long that is): what is going on ends. The next reading goes
 * on where the last one was, or begins again after a gap. */
void plush_silence(plush_toy *toy);

/* Forgets the past, as after a gap: what is going on ends; the counts stay, and so do a fault and what sensors that calibrate
 * themselves have found out, which only plush_begin(), plush_swap() and plush_recalibrate() forget. */
void plush_restart(plush_toy *toy);

/* What sensors that calibrate themselves have found out is forgotten, and nothing else. A chip that boots has forgotten it
 * by itself. For a program that outlives the sensors: call it before the first frame of a toy that was off for 10 minutes
 * or longer (its clock went back, or on by less than half of the pause), as `plushsense live` does, or with other sensors. */
#ifdef PLUSH_CALIBRATE
void plush_recalibrate(plush_toy *toy);
#else
#define plush_recalibrate(toy) ((void)(toy)) /* no sensor of this model does */
#endif

/* The label of a class, and of the model (its architecture and filters). */
const char *plush_gesture_name(const plush_toy *toy, uint8_t gesture);
const char *plush_model_title(const plush_toy *toy);

/* Which model is running: the CRC-32 in the head of its image, as PLUSH_MODEL_ID says it of the model in plush_model.c; 0
 * for none. A patch does not change it. */
uint32_t plush_model_id(const plush_toy *toy);

#ifdef __cplusplus
}
#endif
#endif
