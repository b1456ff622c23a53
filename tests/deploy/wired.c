/* What somebody writes who has an export's folder and a sensor of their own: 104 readings a second, in bursts of its FIFO.
 * Standard input: for each interrupt its time in ms (u32), the number of readings (u32), and of each x, y, z (i16). */
#include <stdio.h>

#include "plush_model.h"
#include "plushsense.h"

#define SENSOR_ONE_G 16393 /* counts a g, from its data sheet */
#define PERIOD_NS 9615385u

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static plush_toy toy;
static const int32_t zero[3] = PLUSH_MODEL_ZERO;

static void answered(const plush_toy *of, void *user)
{
    (void)user;
    if (of->answer.state == PLUSH_TRACKING)
        printf("%lu %s\n", (unsigned long)of->answer.ms, plush_gesture_name(of, of->answer.gesture));
}

int main(void)
{
    uint32_t head[2], i;
    int16_t counts[3];
    int32_t values[3];
    int axis;

    if (plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory) != PLUSH_OK)
        return 1;
    toy.on_answer = answered;
    while (fread(head, sizeof head, 1, stdin) == 1)
        for (i = 0; i < head[1]; i++) {
            uint32_t before_ms = (uint32_t)((uint64_t)(head[1] - 1 - i) * PERIOD_NS / 1000000u);

            if (fread(counts, sizeof counts, 1, stdin) != 1)
                return 2;
            for (axis = 0; axis < 3; axis++)
                values[axis] = zero[axis] + (int32_t)((int64_t)counts[axis] * PLUSH_MODEL_ONE_G / SENSOR_ONE_G);
            plush_push(&toy, head[0] - before_ms, values);
        }
    return 0;
}
