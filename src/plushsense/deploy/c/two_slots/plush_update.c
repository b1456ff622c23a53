/* Two slots for models that come over the air. See plush_update.h. */
#include "plush_update.h"

#include "plush_model.h"

#include <string.h>

/* The model in a slot takes the place of the running one, or nothing has changed. Signature and model are read from the
 * slot itself: from the very bytes that will run. */
static plush_update_result swap_to(plush_update *update, uint8_t slot, uint32_t size)
{
    const uint8_t *image = plush_slot_bytes(slot);

    if (!verify_signature(image, size))
        return PLUSH_UPDATE_SIGNATURE;
    update->status = plush_swap(update->toy, image, size, update->memory, update->memory_bytes);
    if (update->status != PLUSH_OK)
        return PLUSH_UPDATE_MODEL;
    update->running = slot;
    update->running_bytes = size;
    return PLUSH_UPDATE_OK;
}

static plush_update_result remember(plush_update *update)
{
    update->forgotten = !plush_slot_remember(update->running, update->running_bytes);
    return update->forgotten ? PLUSH_UPDATE_FORGOTTEN : PLUSH_UPDATE_OK;
}

plush_update_result plush_update_start(plush_update *update, plush_toy *toy, void *memory, uint32_t memory_bytes,
                                       uint32_t slot_bytes)
{
    uint32_t size = 0;
    uint8_t slot;

    memset(update, 0, sizeof *update);
    update->toy = toy;
    update->memory = memory;
    update->memory_bytes = memory_bytes;
    update->slot_bytes = slot_bytes;
    update->running = update->receiving = PLUSH_NO_SLOT;
    update->status = plush_begin(toy, plush_model, PLUSH_MODEL_BYTES, memory, memory_bytes);
    if (update->status != PLUSH_OK)
        return PLUSH_UPDATE_MODEL;
    /* By a swap, because that compares the layouts: a model for other sensors is refused. */
    slot = plush_slot_remembered(&size);
    if (slot > 1 || size == 0 || size > slot_bytes)
        return PLUSH_UPDATE_OK;
    swap_to(update, slot, size);
    return PLUSH_UPDATE_OK;
}

plush_update_result plush_update_begin(plush_update *update, uint32_t size)
{
    uint8_t slot = update->running == 0 ? 1 : 0;

    update->receiving = PLUSH_NO_SLOT;
    /* Else the slot that is about to be erased would be the one that a reset goes back to. */
    if (update->forgotten && remember(update) != PLUSH_UPDATE_OK)
        return PLUSH_UPDATE_FORGOTTEN;
    if (size == 0 || size > update->slot_bytes)
        return PLUSH_UPDATE_SIZE;
    if (!plush_slot_erase(slot))
        return PLUSH_UPDATE_FLASH;
    update->receiving = slot;
    update->size = size;
    update->received = 0;
    return PLUSH_UPDATE_OK;
}

plush_update_result plush_update_bytes(plush_update *update, const uint8_t *bytes, uint32_t n)
{
    uint8_t slot = update->receiving;

    update->receiving = PLUSH_NO_SLOT;
    if (slot == PLUSH_NO_SLOT || n > update->size - update->received)
        return PLUSH_UPDATE_SIZE;
    if (!plush_slot_write(slot, update->received, bytes, n))
        return PLUSH_UPDATE_FLASH;
    update->receiving = slot;
    update->received += n;
    return PLUSH_UPDATE_OK;
}

plush_update_result plush_update_finish(plush_update *update)
{
    uint8_t slot = update->receiving;
    plush_update_result result;

    update->receiving = PLUSH_NO_SLOT;
    if (slot == PLUSH_NO_SLOT || update->received != update->size)
        return PLUSH_UPDATE_SIZE;
    result = swap_to(update, slot, update->size);
    return result == PLUSH_UPDATE_OK ? remember(update) : result;
}
