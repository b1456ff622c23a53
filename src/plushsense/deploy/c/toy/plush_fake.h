/*
 * Made-up readings for a board without sensors: four seconds of rest, four of something that moves, again and again.
 * Nobody's touch: what the network makes of it means nothing. Delete this file when the sensors are there.
 */
#ifndef PLUSH_FAKE_H
#define PLUSH_FAKE_H

#include "plush_model.h"

#ifdef __cplusplus
extern "C" {
#endif

void plush_fake(uint32_t ms, int32_t *values);

#ifdef __cplusplus
}
#endif
#endif
