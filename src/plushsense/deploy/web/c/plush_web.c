/*
 * The WebAssembly module: the library and its binding, without a model, which plushsense.js loads.
 *
 * It has one import, plush.told(what), which is called with every answer (0) and every change of an event (1) while
 * plush_push(), plush_prime() and others run: then plush_read_answer() and plush_read_event() give it.
 */
#include "plushsense.c"
#include "plush_binding.c"

__attribute__((import_module("plush"), import_name("told"))) void plush_told(uint32_t what);

static void tell_answer(const plush_toy *toy, void *user)
{
    (void)toy;
    (void)user;
    plush_told(0);
}

static void tell_event(const plush_toy *toy, void *user)
{
    keep(toy, user);
    plush_told(1);
}

/* plush_bind(), and both callbacks. */
uint32_t plush_web_bind(plush_toy *toy, const uint8_t *model, uint32_t model_bytes, void *memory, uint32_t memory_bytes)
{
    uint32_t status = plush_bind(toy, plush_toy_bytes(), model, model_bytes, memory, memory_bytes);

    if (status == PLUSH_OK) {
        toy->on_answer = tell_answer;
        toy->on_event = tell_event;
    }
    return status;
}

/* Sample, span, layout, samples a step, sensitivity; then of each class its logit, and of each its smoothed probability. */
void plush_web_numbers(const plush_toy *toy, uint32_t *to)
{
    uint32_t i;

    *to++ = toy->answer.sample;
    *to++ = toy->span;
    *to++ = toy->layout;
    *to++ = toy->step;
    *to++ = (uint32_t)toy->sensitivity;
    for (i = 0; i < toy->classes; i++, to++) {
        to[0] = (uint32_t)toy->logits[i];
        to[toy->classes] = (uint32_t)toy->smooth[i];
    }
}
