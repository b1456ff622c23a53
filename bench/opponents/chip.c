/* Decides on each of INPUTS on an emulated chip: writes the instructions of the decision, and its logits. */
#include <target.h>

extern const uint8_t INPUTS[], INPUTS_end[];
const void *bench_decide(const void *input);

int main(void)
{
    const uint8_t *input;
    uint32_t then, asking;

    *(volatile uint32_t *)0xe000ed88 |= 0xfu << 20; /* the floating-point unit */
    then = target_instructions();
    asking = target_instructions() - then;
    for (input = INPUTS; input != INPUTS_end; input += INPUT_BYTES) {
        const void *logits;
        uint32_t took;

        then = target_instructions();
        logits = bench_decide(input);
        took = target_instructions() - then - asking;
        target_write(&took, sizeof took);
        target_write(logits, LOGIT_BYTES);
    }
    return 0;
}
