/*
 * A sensor with a buffer (FIFO) and an interrupt: the interrupt only notes the time, and the main loop takes all readings
 * out in one burst. An example to copy and to change.
 *
 *     void isr(void) { plush_fifo_interrupt(clock_ms()); }   // at the pin of the sensor
 *     for (;;) { plush_fifo_drain(&toy); sleep_until_interrupt(); }
 */
#ifndef PLUSH_FIFO_H
#define PLUSH_FIFO_H

#include "plush_model.h"
#include "plushsense.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifndef PLUSH_FIFO_PERIOD_US
#define PLUSH_FIFO_PERIOD_US 9615u /* between two readings, by the data sheet: 104 Hz */
#endif
#define PLUSH_FIFO_MARK ((uint32_t)8) /* readings in the buffer at which the interrupt comes */
#define PLUSH_FIFO_MOST 32u /* that it holds; then it must stop, not leave out the oldest */

/* Yours to write: how many readings are in the buffer, and the oldest one out of it, with the scale of the
 * recordings. */
uint32_t plush_fifo_level(void);
void plush_fifo_read(int32_t *values);

void plush_fifo_interrupt(uint32_t ms);
uint32_t plush_fifo_drain(plush_toy *toy); /* how many answers fell due */

#ifdef __cplusplus
}
#endif

#endif
