#include "plush_fifo.h"

static volatile uint8_t marked; /* until the buffer is empty: an interrupt amid a burst is not used */
static volatile uint32_t marked_ms;

void plush_fifo_interrupt(uint32_t ms)
{
    if (marked)
        return;
    marked_ms = ms;
    marked = 1;
}

uint32_t plush_fifo_drain(plush_toy *toy)
{
    static int32_t frames[PLUSH_FIFO_MOST * PLUSH_MODEL_CHANNELS];
    uint32_t due = 0, taken = 0, ms, n, i;

    if (!marked)
        return 0;
    /* The reading at the mark is that of the interrupt; the others come a period apart. */
    ms = marked_ms - PLUSH_FIFO_MARK * PLUSH_FIFO_PERIOD_US / 1000u;
    do {
        n = plush_fifo_level();
        if (n > PLUSH_FIFO_MOST)
            n = PLUSH_FIFO_MOST;
        for (i = 0; i < n; i++)
            plush_fifo_read(frames + i * PLUSH_MODEL_CHANNELS);
        taken += n;
        due += plush_push_many(toy, frames, n, ms + taken * PLUSH_FIFO_PERIOD_US / 1000u, PLUSH_FIFO_PERIOD_US);
    } while (n > 0); /* after a full buffer the stamps are too early until the next interrupt */
    marked = 0;
    return due;
}
