/*
 * One decision with CMSIS-NN, with the integers of a quantized .tflite (integers.h of this bench). A layer's input holds
 * its history and behind it the new samples, where the layer before writes its output. For a window nothing is kept.
 */
#include <string.h>

#include "arm_nnfunctions.h"
#include "arm_nnsupportfunctions.h"

typedef struct {
    int16_t kept, fresh, pad, channels, kernel, dilation, filters;
    int16_t read_zero, write_zero;
    const int8_t *w;
    const int32_t *b, *multiplier, *shift;
    int8_t *input;
} conv_layer;

#include "integers.h"

static int8_t last[POSITIONS * FEATURES], logits[CLASSES];
static int8_t blocks[BLOCKS][FEATURES];
static int32_t total[FEATURES], block;
static int16_t scratch[2 * MOST_COLUMNS + 8];

static int8_t clamped(int32_t value)
{
    return (int8_t)(value < -128 ? -128 : value > 127 ? 127 : value);
}

static void convolve(const conv_layer *layer, int8_t *out)
{
    const cmsis_nn_conv_params how = {
        .input_offset = -layer->read_zero, .output_offset = layer->write_zero, .stride = {1, 1},
        .padding = {layer->pad, 0}, .dilation = {layer->dilation, 1}, .activation = {layer->write_zero, 127},
    };
    const cmsis_nn_per_channel_quant_params scales = {(int32_t *)layer->multiplier, (int32_t *)layer->shift};
    const cmsis_nn_dims reads = {1, 1, layer->kept + layer->fresh, layer->channels};
    const cmsis_nn_dims weights = {layer->filters, 1, layer->kernel, layer->channels};
    const int32_t positions = layer->pad + layer->kept + layer->fresh - (layer->kernel - 1) * layer->dilation;
    const cmsis_nn_dims bias = {1, 1, 1, layer->filters}, writes = {1, 1, positions, layer->filters};
    const cmsis_nn_context room = {scratch, sizeof scratch};

    arm_convolve_wrapper_s8(&room, &how, &scales, &reads, layer->input, &weights, layer->w, &bias, layer->b, &writes,
                            out);
}

/* The mean over positions of one decision, then over the blocks of a stream: a running total, as in our C. */
static void pool(int8_t *mean)
{
    int f, t;

    for (f = 0; f < FEATURES; f++) {
        int32_t sum = 0;

        for (t = 0; t < POSITIONS; t++)
            sum += last[t * FEATURES + f];
        sum = arm_nn_requantize(sum - POSITIONS * BLOCK_READ_ZERO, BLOCK_MULTIPLIER, BLOCK_SHIFT) + BLOCK_WRITE_ZERO;
        total[f] -= blocks[block][f];
        blocks[block][f] = clamped(sum);
        total[f] += blocks[block][f];
#if BLOCKS > 1
        sum = arm_nn_requantize(total[f] - BLOCKS * BLOCK_WRITE_ZERO, MEAN_MULTIPLIER, MEAN_SHIFT) + MEAN_WRITE_ZERO;
#endif
        mean[f] = clamped(sum);
    }
    block = block + 1 < BLOCKS ? block + 1 : 0;
}

const void *bench_decide(const void *samples)
{
    static int8_t mean[FEATURES];
    const cmsis_nn_fc_params how = {
        .input_offset = -MEAN_WRITE_ZERO, .output_offset = LOGITS_ZERO, .activation = {-128, 127},
    };
    const cmsis_nn_quant_params scales = {(int32_t *)dense_multiplier, (int32_t *)dense_shift, 1};
    const cmsis_nn_dims reads = {1, 1, 1, FEATURES}, weights = {FEATURES, 1, 1, CLASSES}, bias = {1, 1, 1, CLASSES};
    const cmsis_nn_context room = {scratch, sizeof scratch};
    int i;

    for (i = 0; i < LAYERS; i++) {
        const conv_layer *layer = &layers[i];
        int8_t *in = layer->input;

        /* What the layer before wrote last time becomes history before it writes again. */
        memmove(in, in + layer->fresh * layer->channels, (size_t)(layer->kept * layer->channels));
        if (i == 0)
            memcpy(in + layer->kept * layer->channels, samples, (size_t)(layer->fresh * layer->channels));
    }
    for (i = 0; i < LAYERS; i++)
        convolve(&layers[i], i + 1 < LAYERS ? layers[i + 1].input + layers[i + 1].kept * layers[i + 1].channels : last);
    pool(mean);
    arm_fully_connected_wrapper_s8(&room, &how, &scales, &reads, mean, &weights, dense_w, &bias, dense_b, &bias, logits);
    return logits;
}
