/*
 * A plush_toy for other languages (Rust, MicroPython, JavaScript by way of WebAssembly), which cannot read its struct.
 * Compile plush_binding.c with plushsense.c, and with plush_model.c unless you load the model from a file. All arguments and
 * results are pointers, or numbers of 32 bits, alone or in structs that have no padding in any compiler.
 *
 * plush_bind() makes a toy, which every function of plushsense.h takes: plush_push(), plush_prime(), plush_silence() ...
 * After each push call plush_read_event() until it returns 0: one push may bring several events. There are no callbacks.
 * plush_binding.rs is such a binding.
 */
#ifndef PLUSH_BINDING_H
#define PLUSH_BINDING_H

#include "plushsense.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PLUSH_KEPT_EVENTS 16u /* that are kept until they are read; then the oldest is dropped */

/* A plush_answer without `sample`, a plush_event, and the counts of a plush_toy. */
typedef struct {
    uint32_t ms, state, affect, kind, gesture, confidence;
    int32_t known;
} plush_bound_answer;

typedef struct {
    uint32_t what, number, affect, gesture, source, since_ms, ms;
} plush_bound_event;

typedef struct {
    uint32_t answers, restarts, invalid, faults, bad_stamps, interpolated, interval, sparse, suspect, reading;
    uint32_t dropped; /* events that nobody read in time */
} plush_bound_counts;

/* Makes a toy in `toy_bytes` bytes at `toy`, at least plush_toy_bytes(), aligned for a pointer; for the rest, and the result
 * (a plush_status), see plush_begin(). They must stay where they are. To begin anew, bind again. */
PLUSH_LOOK_AT
uint32_t plush_bind(plush_toy *toy, uint32_t toy_bytes, const uint8_t *model, uint32_t model_bytes, void *memory,
                    uint32_t memory_bytes);
uint32_t plush_toy_bytes(void);
uint32_t plush_model_bytes(void); /* of the model in plush_model.c: `plush_model` */

/* The newest answer; the next event in order, unless the result is 0: there is none. */
void plush_read_answer(const plush_toy *toy, plush_bound_answer *answer);
uint32_t plush_read_event(plush_toy *toy, plush_bound_event *event);
void plush_read_counts(const plush_toy *toy, plush_bound_counts *counts);

uint32_t plush_channels(const plush_toy *toy); /* values that plush_push() reads; 0 when no model is running */
uint32_t plush_classes(const plush_toy *toy);
void plush_set_sensitivity(plush_toy *toy, int32_t sensitivity);

/* The name of a number: "tracking" of PLUSH_NAME_STATE and 1; "" of a number without a name. */
enum { PLUSH_NAME_STATUS = 0, PLUSH_NAME_STATE = 1, PLUSH_NAME_READING = 2, PLUSH_NAME_KIND = 3, PLUSH_NAME_WHAT = 4 };
const char *plush_name_of(uint32_t what, uint32_t number);

#ifdef __cplusplus
}
#endif
#endif
