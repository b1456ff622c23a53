/*
 * One decision in float C, from a window or from the samples of a step. With network.h of this bench: the loops below.
 * With ONNX2C defined: the function that onnx2c wrote.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "network.h"

void *bench_read(const char *folder, const char *name, long *bytes);

static const float *inputs;
static long count, next_input;
static float logits[CLASSES];

#ifdef ONNX2C

void entry(ENTRY);

static float states[2][STATES];

/* What one call returns as the next states is what the following call reads: nothing is copied. */
static void decide(const float *x)
{
    static int now;
    const float *before = states[now];
    float *after = states[now = !now];

    entry(CALL);
}

#else

static float from[ROOM], to[ROOM];

/* (length, channels) in `from` to (length, filters) in `to`; `pad` rows of zeros stand before it. Weights are ordered
 * (kernel, channels, filters), so that the innermost loop runs over neighbours. */
static inline __attribute__((always_inline)) void layer(int length, int channels, int filters, int kernel, int dilation,
                                                         const float *w, const float *bias)
{
    for (int t = 0; t < length; t++) {
        float sum[MOST_FILTERS];

        for (int f = 0; f < filters; f++)
            sum[f] = bias[f];
        for (int k = 0; k < kernel; k++)
            for (int c = 0; c < channels; c++) {
                float a = from[(t + k * dilation) * channels + c];

                for (int f = 0; f < filters; f++)
                    sum[f] += a * w[(k * channels + c) * filters + f];
            }
        for (int f = 0; f < filters; f++)
            to[t * filters + f] = sum[f] > 0 ? sum[f] : 0;
    }
}

/* Put rows before the samples in `to`: those that a stream kept, or zeros. */
static void before(int rows, int length, int channels, float *kept)
{
    memcpy(from, kept, sizeof(float) * (size_t)(rows * channels));
    memcpy(from + rows * channels, to, sizeof(float) * (size_t)(length * channels));
    if (STREAM)
        memcpy(kept, from + length * channels, sizeof(float) * (size_t)(rows * channels));
}

static void decide(const float *x)
{
    static float sums[BLOCKS][FEATURES];
    static int block;
    float mean[FEATURES] = {0};

    for (int t = 0; t < WINDOW; t++)
        for (int c = 0; c < CHANNELS; c++)
            to[t * CHANNELS + c] = x[c * WINDOW + t];
    LAYERS
    memset(sums[block], 0, sizeof sums[block]);
    for (int t = 0; t < POSITIONS; t++)
        for (int f = 0; f < FEATURES; f++)
            sums[block][f] += to[t * FEATURES + f];
    block = block + 1 < BLOCKS ? block + 1 : 0;
    for (int b = 0; b < BLOCKS; b++)
        for (int f = 0; f < FEATURES; f++)
            mean[f] += sums[b][f];
    for (int k = 0; k < CLASSES; k++) {
        logits[k] = dense_b[k];
        for (int f = 0; f < FEATURES; f++)
            logits[k] += dense_w[k * FEATURES + f] * mean[f] / (POSITIONS * BLOCKS);
    }
}

#endif

/* For `chip.c`. */
const void *bench_decide(const void *input)
{
    decide(input);
    return logits;
}

void bench_begin(const char *folder)
{
    long bytes;

    inputs = bench_read(folder, STREAM ? "stream.bin" : "window.bin", &bytes);
    count = bytes / (long)sizeof(float) / (CHANNELS * WINDOW);
}

void bench_run(long decisions)
{
    for (; decisions > 0; decisions--) {
        decide(inputs + next_input * CHANNELS * WINDOW);
        if (++next_input == count)
            next_input = 0;
    }
}

long bench_check(FILE *out)
{
    for (long i = 0; i < count; i++) {
        decide(inputs + i * CHANNELS * WINDOW);
        for (int k = 0; k < CLASSES; k++) {
            double logit = logits[k];

            fwrite(&logit, sizeof logit, 1, out);
        }
    }
    return count;
}
