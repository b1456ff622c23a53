/*
 * A new model for a toy that goes on running, over the air: two slots in flash, of which one receives while the model in
 * the other one runs. An example to copy and to change; beside plushsense.c and plush_model.c it needs the functions below,
 * which are yours to write.
 *
 *     plush_update_start(&update, &toy, memory, sizeof memory, SLOT_BYTES);       // instead of plush_begin()
 *     toy.on_event = react;
 *     ...                                                                         // between two frames:
 *     plush_update_begin(&update, size);                                          // how many bytes will come
 *     plush_update_bytes(&update, bytes, n);                                      // as often as they come
 *     plush_update_finish(&update);                                               // PLUSH_UPDATE_OK: the new model runs
 *
 * Whatever goes wrong, the running model goes on with all that it remembers, and so it does when nothing more comes. After
 * a reset the newest model runs that was remembered, or, if it is not sound, the one that is compiled in. None of these
 * functions may be called in a callback of the toy.
 */
#ifndef PLUSH_UPDATE_H
#define PLUSH_UPDATE_H

#include "plushsense.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PLUSH_NO_SLOT 255

typedef enum {
    PLUSH_UPDATE_OK = 0,
    PLUSH_UPDATE_SIZE = 1,      /* too large for a slot, or more or fewer bytes than announced, or none announced */
    PLUSH_UPDATE_FLASH = 2,     /* a slot cannot be erased or written */
    PLUSH_UPDATE_SIGNATURE = 3, /* verify_signature() refuses it */
    PLUSH_UPDATE_MODEL = 4,     /* plush_swap() refuses it: `status` says why */
    PLUSH_UPDATE_FORGOTTEN = 5  /* the new model runs, but is not remembered: the next plush_update_begin() tries again */
} plush_update_result;

typedef struct {
    plush_toy *toy;
    void *memory;
    uint32_t memory_bytes, slot_bytes;
    uint8_t running;         /* the slot of the running model; PLUSH_NO_SLOT: the one that is compiled in */
    uint8_t receiving;       /* a slot, or PLUSH_NO_SLOT */
    uint8_t forgotten;
    uint32_t running_bytes, size, received;
    plush_status status;     /* what plush_begin() or plush_swap() said last */
} plush_update;

/* ---- Yours to write. Those that return int return 1 when it is done, else 0. ----------------------------------- */

/* Whether these bytes are signed with your key (Ed25519 or ECDSA, checked with a public key that is compiled in): the
 * CRC-32 in a model finds damage and not forgery. The signature may stand behind the model, within `size`: only as many
 * bytes are read as the model's head says. To keep out a signed model that is older than the running one, sign a
 * version with it, and compare it here. */
int verify_signature(const uint8_t *image, uint32_t size);

/* Slots 0 and 1: partitions or sectors of flash that can be read at an address (on an ESP32: esp_partition_mmap()). */
int plush_slot_erase(uint8_t slot);
int plush_slot_write(uint8_t slot, uint32_t at, const uint8_t *bytes, uint32_t n);
const uint8_t *plush_slot_bytes(uint8_t slot);

/* Keeps over a reset which slot holds the newest model and how long that is. It is written in one piece: after a loss of
 * power either the old or the new entry stands there. Without an entry it returns PLUSH_NO_SLOT. */
int plush_slot_remember(uint8_t slot, uint32_t size);
uint8_t plush_slot_remembered(uint32_t *size);

/* ---- What the example does ------------------------------------------------------------------------------------- */

/* Begins on the compiled-in model, and goes on to the remembered one if that is sound. `memory` is large enough for every
 * model that may come. PLUSH_UPDATE_MODEL: not even the compiled-in one runs. */
plush_update_result plush_update_start(plush_update *update, plush_toy *toy, void *memory, uint32_t memory_bytes,
                                       uint32_t slot_bytes);

/* Erases the slot that is not running, for `size` bytes. What came before is given up. */
plush_update_result plush_update_begin(plush_update *update, uint32_t size);

/* Takes the next bytes. After anything but PLUSH_UPDATE_OK, begin again. */
plush_update_result plush_update_bytes(plush_update *update, const uint8_t *bytes, uint32_t n);

/* Checks signature and model, and swaps. */
plush_update_result plush_update_finish(plush_update *update);

#ifdef __cplusplus
}
#endif
#endif
