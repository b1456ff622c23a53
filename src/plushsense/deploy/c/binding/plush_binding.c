/* A plush_toy for other languages; plush_binding.h describes it. */
#include "plush_binding.h"
#include "plush_model.h"

#include <string.h>

#define MOST_NAMES 9u

/* The memory at a bound toy. */
typedef struct {
    plush_toy toy;
    plush_bound_event events[PLUSH_KEPT_EVENTS];
    uint32_t first, kept, dropped;
} bound;

static void keep(const plush_toy *toy, void *user)
{
    bound *own = (bound *)user;
    const plush_event *event = &toy->event;
    plush_bound_event *to = own->events + (own->first + own->kept) % PLUSH_KEPT_EVENTS;

    if (own->kept < PLUSH_KEPT_EVENTS) {
        own->kept++;
    } else {
        own->first++;
        own->dropped++;
    }
    to->what = (uint32_t)event->what;
    to->number = event->number;
    to->affect = (uint32_t)event->affect;
    to->gesture = event->gesture;
    to->source = (uint32_t)event->source;
    to->since_ms = event->since_ms;
    to->ms = event->ms;
}

uint32_t plush_bind(plush_toy *toy, uint32_t toy_bytes, const uint8_t *model, uint32_t model_bytes, void *memory,
                    uint32_t memory_bytes)
{
    plush_status status;

    if (toy_bytes < sizeof(bound))
        return PLUSH_MEMORY_TOO_SMALL;
    if ((uintptr_t)toy % sizeof(void *) != 0)
        return PLUSH_MEMORY_NOT_ALIGNED;
    memset(toy, 0, sizeof(bound));
    status = plush_begin(toy, model, model_bytes, memory, memory_bytes);
    if (status == PLUSH_OK) {
        toy->on_event = keep;
        toy->user = toy;
    }
    return (uint32_t)status;
}

uint32_t plush_toy_bytes(void)
{
    return (uint32_t)sizeof(bound);
}

uint32_t plush_model_bytes(void)
{
    return PLUSH_MODEL_BYTES;
}

void plush_read_answer(const plush_toy *toy, plush_bound_answer *answer)
{
    const plush_answer *from = &toy->answer;

    answer->ms = from->ms;
    answer->state = (uint32_t)from->state;
    answer->affect = (uint32_t)from->affect;
    answer->kind = (uint32_t)from->kind;
    answer->gesture = from->gesture;
    answer->confidence = from->confidence;
    answer->known = from->known;
}

uint32_t plush_read_event(plush_toy *toy, plush_bound_event *event)
{
    bound *own = (bound *)toy->user;

    if (own == NULL || own->kept == 0)
        return 0;
    *event = own->events[own->first++ % PLUSH_KEPT_EVENTS];
    own->kept--;
    return 1;
}

void plush_read_counts(const plush_toy *toy, plush_bound_counts *counts)
{
    const bound *own = (const bound *)toy->user;

    counts->answers = toy->answers;
    counts->restarts = toy->restarts;
    counts->invalid = toy->invalid;
    counts->faults = toy->faults;
    counts->bad_stamps = toy->bad_stamps;
    counts->interpolated = toy->interpolated;
    counts->interval = toy->interval;
    counts->sparse = toy->sparse;
    counts->suspect = toy->suspect;
    counts->reading = toy->reading;
    counts->dropped = own != NULL ? own->dropped : 0;
}

uint32_t plush_channels(const plush_toy *toy)
{
    return toy->channels;
}

uint32_t plush_classes(const plush_toy *toy)
{
    return toy->classes;
}

void plush_set_sensitivity(plush_toy *toy, int32_t sensitivity)
{
    toy->sensitivity = (int8_t)(sensitivity < -128 ? -128 : sensitivity > 127 ? 127 : sensitivity);
}

const char *plush_name_of(uint32_t what, uint32_t number)
{
    static const char *const names[][MOST_NAMES] = {
        PLUSH_STATUS_NAMES, PLUSH_STATE_NAMES, PLUSH_READING_NAMES, PLUSH_KIND_NAMES, PLUSH_WHAT_NAMES
    };
    const char *name = what <= PLUSH_NAME_WHAT && number < MOST_NAMES ? names[what][number] : NULL;

    return name != NULL ? name : "";
}
