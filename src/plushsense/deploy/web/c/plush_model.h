/* The module has no model of its own: plush_binding.c finds this in the place of an export's header. */
#define PLUSH_MODEL_BYTES 0u
