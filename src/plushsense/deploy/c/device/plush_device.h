/*
 * plushsense verify EXPORT --device URL: this program on a chip, and the computer at the other end of its UART.
 *
 * Compile plush_device.c, plush_harness.c and plush_hooks.c with plushsense.c and plush_model.c of the export, write
 * plush_hook_begin(), plush_hook_read() and plush_hook_write() (those of ESP-IDF and the Pico SDK are in plush_hooks.c), and
 * call plush_device_run() where your program begins. On an Arduino this folder is a sketch that does all of it, with the
 * library of the export. Nothing else may write to that UART, and no log.
 *
 * Packets go both ways: the bytes 'P' and 'V', a letter, the length of what it holds (16 bits), that, and the CRC-32 of
 * letter, length and content; numbers begin with their lowest byte. The computer sends only what it is asked for:
 *
 *     H  are you there?            h  here: version of this, model id, channels, classes, memory, room, name of the counter
 *     S  begin
 *     D  bytes of a case;          n  the next bytes, please
 *        empty: there is no more   r  rows   w  words: what went wrong   m  measures of a case   d  done
 *                                  e  words: what is wrong with the link
 */
#ifndef PLUSH_DEVICE_H
#define PLUSH_DEVICE_H

#include "plush_model.h"

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PLUSH_DEVICE_VERSION 1u
#define PLUSH_DEVICE_MOST_BYTES 1024u /* that a packet holds */

/* RAM: of the toys of the cases, and for models and patches that are sent. Less than they need: the computer says which
 * cases it left out. */
#ifndef PLUSH_DEVICE_MEMORY_BYTES
#define PLUSH_DEVICE_MEMORY_BYTES (PLUSH_MODEL_MEMORY_BYTES + 2048u)
#endif
#ifndef PLUSH_DEVICE_ROOM_BYTES
#define PLUSH_DEVICE_ROOM_BYTES (PLUSH_MODEL_BYTES + 1024u)
#endif

/* Yours to write where plush_hooks.c has none, there or in a file of your own. */
void plush_hook_begin(void);         /* once, before the others */
uint8_t plush_hook_read(void);       /* the next byte from the computer; waits for it */
void plush_hook_write(uint8_t byte); /* to the computer */

/* A counter of clock cycles, modulo 2^32, of which plush_hooks.c knows some; the name is empty where there is none. */
extern const char *plush_hook_counter;
void plush_hook_begin_counter(void);
uint32_t plush_hook_cycles(void);

/* Serves the computer, again and again. Does not return. */
void plush_device_run(void);

/* Between plush_harness.c and plush_device.c. */
#define PLUSH_HARNESS_CHANNELS PLUSH_MODEL_CHANNELS
#define PLUSH_HARNESS_CLASSES PLUSH_MODEL_CLASSES
#define PLUSH_HARNESS_MEMORY_BYTES PLUSH_DEVICE_MEMORY_BYTES
void plush_device_cases(void);
int plush_device_case(void); /* whether there is another one */
const uint8_t *plush_device_bytes(uint32_t n, int kept);
void plush_device_row(const uint8_t *bytes, uint32_t n);
void plush_device_words(const char *words);
uint32_t plush_device_cycles(void);
void plush_device_measure(uint32_t cycles, uint32_t answers, int tracking);

#ifdef __cplusplus
}
#endif
#endif
