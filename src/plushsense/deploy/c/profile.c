/*
 * Counts what a toy costs on an emulated chip. Two programs from this file:
 *
 *     whole steps   linked with plushsense.c as firmware would be
 *     PLUSH_STAGES  takes plushsense.c in, so that each stage can be called by itself
 *
 * EVEN and JITTERED hold rows of 32-bit numbers, milliseconds and the measured channels: the same readings at even
 * times, and somewhat early or late with a long gap at the end. What is written are rows of 32-bit numbers.
 */
/* In angle brackets: those of the export, not the ones beside this file. */
#ifdef PLUSH_STAGES
#include <plushsense.c>
#else
#include <plushsense.h>
#endif
#include <plush_model.h>
#include <target.h>

#define END_OF_ROWS 2
#define ROW (1 + PLUSH_MODEL_CHANNELS)

extern const uint8_t EVEN[], EVEN_end[], JITTERED[], JITTERED_end[];

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static plush_toy toy;
static uint32_t asking; /* instructions that the counting itself takes */

static const int32_t *rows(const uint8_t *bytes)
{
    return (const int32_t *)(const void *)bytes;
}

static void put(uint32_t number)
{
    target_write(&number, sizeof number);
}

static int begin(void)
{
    return plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory) == PLUSH_OK;
}

static uint32_t since(uint32_t then)
{
    return target_instructions() - then - asking;
}

static void measure_asking(void)
{
    uint32_t then = target_instructions();

    asking = target_instructions() - then;
}

#ifndef PLUSH_STAGES

static uint32_t push(const int32_t *row)
{
    return plush_push(&toy, (uint32_t)row[0], row + 1);
}

/* A row for each answer: instructions from the answer before to this one, the dearest frame among them, and whether the
 * toy was tracking. */
static void count_steps(const int32_t *row, const int32_t *end)
{
    uint32_t step = 0, dearest = 0;

    for (; row != end; row += ROW) {
        uint32_t then = target_instructions(), answers = push(row), took = since(then);

        step += took;
        if (took > dearest)
            dearest = took;
        if (answers > 0) {
            put(step);
            put(dearest);
            put(toy.answer.state == PLUSH_TRACKING);
            step = dearest = 0;
        }
    }
    put(0);
    put(0);
    put(END_OF_ROWS);
}

static uint32_t stack_of_asking(void)
{
    target_stack_paint();
    plush_memory_bytes(plush_model, PLUSH_MODEL_BYTES);
    return target_stack_used();
}

static uint32_t stack_of_beginning(void)
{
    target_stack_paint();
    begin();
    return target_stack_used();
}

static uint32_t stack_of_pushing(const int32_t *row, const int32_t *end)
{
    target_stack_paint();
    for (; row != end; row += ROW)
        push(row);
    return target_stack_used();
}

int main(void)
{
    uint32_t then, took;

    measure_asking();
    then = target_instructions();
    if (!begin())
        return 0; /* and nothing is written */
    took = since(then);
    put(sizeof toy);
    put(plush_memory_bytes(plush_model, PLUSH_MODEL_BYTES));
    put(took);
    put(stack_of_asking());
    put(stack_of_beginning());
    put(stack_of_pushing(rows(JITTERED), rows(JITTERED_end)));
    begin();
    count_steps(rows(EVEN), rows(EVEN_end));
    begin();
    count_steps(rows(JITTERED), rows(JITTERED_end));
    return 0;
}

#else

/* A row for each step: instructions of health, inputs, gate, network, dense layer, probabilities, events, and the rest of
 * what an answer takes. */
static void count_stages(const int32_t *row, const int32_t *end)
{
    uint32_t health = 0, inputs = 0, gate = 0, network = 0, last, decision, events, rest, then;
    uint32_t samples = 0, best;

    for (; row != end; row += ROW) {
        if (toy.answer.state != PLUSH_TRACKING) {
            plush_push(&toy, (uint32_t)row[0], row + 1);
            continue;
        }
        memcpy(toy.sample, row + 1, 4u * PLUSH_MODEL_CHANNELS);
        then = target_instructions();
        examine(&toy, (uint32_t)row[0], row + 1);
        health += since(then);
        then = target_instructions();
        read_inputs(&toy);
        inputs += since(then);
        if (has_gate(&toy)) {
            then = target_instructions();
            gate_sample(&toy, (uint32_t)row[0]);
            gate += since(then);
        }
        toy.filled = (uint16_t)samples; /* a window network computes when the step is complete */
        then = target_instructions();
        network_sample(&toy);
        network += since(then);
        if (++samples < toy.step)
            continue;
        then = target_instructions();
        dense(&toy);
        last = since(then);
        then = target_instructions();
        best = decide(&toy);
        decision = since(then);
        then = target_instructions();
        event_step(&toy, best, (uint32_t)row[0]);
        events = since(then);
        then = target_instructions();
        answer(&toy, (uint32_t)row[0]);
        rest = since(then) - last - decision - events;
        put(health);
        put(inputs);
        put(gate);
        put(network);
        put(last);
        put(decision);
        put(events);
        put(rest);
        health = inputs = gate = network = samples = 0;
    }
}

int main(void)
{
    measure_asking();
    if (!begin())
        return 0; /* and nothing is written */
    count_stages(rows(EVEN), rows(EVEN_end));
    return 0;
}

#endif
