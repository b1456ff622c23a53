/*
 * Made-up readings: see plush_fake.h.
 */
#include "plush_fake.h"

/* Around what each channel's values lie, and how far from it, in what the network was trained on: the mean and one
 * standard deviation. Real sensors whose values lie elsewhere are not the ones that this model was trained with. */
static const struct {
    int32_t usual, spread;
} channel[PLUSH_MODEL_CHANNELS] = {
@usual@
};

/* Up and down between -256 and 256. */
static int32_t wave(uint32_t ms, uint32_t period_ms)
{
    int32_t at = (int32_t)(ms % period_ms * 1024 / period_ms);

    return at < 512 ? at - 256 : 768 - at;
}

void plush_fake(uint32_t ms, int32_t *values)
{
    uint32_t i;
    int moving = ms % 8000 >= 4000;

    for (i = 0; i < PLUSH_MODEL_CHANNELS; i++) {
        int32_t swing = moving ? 2 * wave(ms, 700 + 90 * (i % 16)) : wave(ms, 90 + 10 * (i % 16)) / 16;

        values[i] = channel[i].usual + (int32_t)((int64_t)channel[i].spread * swing / 256);
    }
}
