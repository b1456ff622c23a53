/* PlushSense's own C, frame by frame as in the toy; with NETWORK_ONLY the network alone, on inputs already scaled. */
#include "plushsense.c"

#include <stdio.h>
#include <stdlib.h>

void *bench_read(const char *folder, const char *name, long *bytes);

static plush_toy toy;
static const int32_t *frames;
static uint32_t count, next_frame, now;

static void push_frame(void)
{
    plush_push(&toy, now, frames + (size_t)next_frame * (toy.channels + 1u) + 1u);
    now += 10;
    if (++next_frame == count)
        next_frame = 0;
}

void bench_begin(const char *folder)
{
    long bytes, model_bytes;
    uint8_t *model = bench_read(folder, "model.bin", &model_bytes);
    uint32_t size = plush_memory_bytes(model, (uint32_t)model_bytes);
    uint32_t i;

    frames = bench_read(folder, "frames.bin", &bytes);
    if (size == 0 || plush_begin(&toy, model, (uint32_t)model_bytes, malloc(size), size) != PLUSH_OK)
        exit(4);
    count = (uint32_t)((size_t)bytes / 4u / (toy.channels + 1u));
    for (i = 0; i < toy.span; i++)
        push_frame();
}

/* All decisions over the frames, from the first one. */
long bench_check(FILE *out)
{
    long decisions = 0;
    uint32_t i, k;

    plush_restart(&toy);
    next_frame = 0;
    for (i = 0; i < count; i++) {
        uint32_t answers = toy.answers;

        push_frame();
        if (toy.answers == answers || toy.answer.state != PLUSH_TRACKING)
            continue;
        for (k = 0; k < toy.classes; k++) {
            double logit = (double)toy.logits[k] / 256;

            fwrite(&logit, sizeof logit, 1, out);
        }
        decisions++;
    }
    return decisions;
}

#ifdef NETWORK_ONLY

void bench_run(long decisions)
{
    static uint8_t row[256];
    uint32_t s, f;

    for (; decisions > 0; decisions--) {
        uint16_t *sums;

        for (s = 0; s < toy.step; s++) {
            row[s] = (uint8_t)(row[s] + 37u * (s + 1u));
            memcpy(next_row(&toy.layer[0]), row, toy.inputs);
            toy.filled = (uint16_t)s; /* where in the step it is */
            network_sample(&toy);
        }
        dense(&toy);
        toy.block = (uint16_t)(toy.block + 1u < toy.blocks ? toy.block + 1u : 0u);
        sums = toy.sums + (uint32_t)toy.block * toy.features;
        for (f = 0; f < toy.features; f++) {
            toy.total[f] -= sums[f];
            sums[f] = 0;
        }
    }
}

#else

void bench_run(long decisions)
{
    uint32_t s;

    for (; decisions > 0; decisions--)
        for (s = 0; s < toy.step; s++)
            push_frame();
}

#endif
