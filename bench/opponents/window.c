/*
 * The whole window again for every decision, in plain float C. With network.h of this bench: the loops below.
 * With ONNX2C defined: the function that onnx2c wrote.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "network.h"

void *bench_read(const char *folder, const char *name, long *bytes);

static const float *windows;
static long count, next_window;
static float logits[CLASSES];

#ifdef ONNX2C

void entry(const float in[1][CHANNELS][WINDOW], float out[1][CLASSES]);

static void decide(const float *x)
{
    entry((const float(*)[CHANNELS][WINDOW])x, (float(*)[CLASSES])logits);
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

static void pad(int rows, int length, int channels)
{
    memset(from, 0, sizeof(float) * (size_t)(rows * channels));
    memcpy(from + rows * channels, to, sizeof(float) * (size_t)(length * channels));
}

static void decide(const float *x)
{
    float mean[FEATURES] = {0};

    for (int t = 0; t < WINDOW; t++)
        for (int c = 0; c < CHANNELS; c++)
            to[t * CHANNELS + c] = x[c * WINDOW + t];
    LAYERS
    for (int t = 0; t < POSITIONS; t++)
        for (int f = 0; f < FEATURES; f++)
            mean[f] += to[t * FEATURES + f];
    for (int k = 0; k < CLASSES; k++) {
        logits[k] = dense_b[k];
        for (int f = 0; f < FEATURES; f++)
            logits[k] += dense_w[k * FEATURES + f] * mean[f] / POSITIONS;
    }
}

#endif

void bench_begin(const char *folder)
{
    long bytes;

    windows = bench_read(folder, "windows.bin", &bytes);
    count = bytes / (long)sizeof(float) / (CHANNELS * WINDOW);
}

void bench_run(long decisions)
{
    for (; decisions > 0; decisions--) {
        decide(windows + next_window * CHANNELS * WINDOW);
        if (++next_window == count)
            next_window = 0;
    }
}

long bench_check(FILE *out)
{
    for (long i = 0; i < count; i++) {
        decide(windows + i * CHANNELS * WINDOW);
        for (int k = 0; k < CLASSES; k++) {
            double logit = logits[k];

            fwrite(&logit, sizeof logit, 1, out);
        }
    }
    return count;
}
