/*
 * Counts what a toy costs on an emulated chip. Two programs from this file:
 *
 *     whole steps   linked with plushsense.c as firmware would be
 *     PLUSH_STAGES  takes plushsense.c in, so that each stage can be called by itself
 *
 * EVEN, JITTERED and STRESS hold rows of 32-bit numbers, milliseconds and the measured channels: the same readings at even
 * times, and somewhat early or late with a long gap at the end; and readings at the ends of their ranges, mostly after
 * gaps. What is written are rows of 32-bit numbers.
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

extern const uint8_t EVEN[], EVEN_end[], JITTERED[], JITTERED_end[], STRESS[], STRESS_end[];

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

/* The dearest of many frames. */
static uint32_t dearest_frame(const int32_t *row, const int32_t *end)
{
    uint32_t dearest = 0;

    for (; row != end; row += ROW) {
        uint32_t then = target_instructions(), took;

        push(row);
        took = since(then);
        if (took > dearest)
            dearest = took;
    }
    return dearest;
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
    put(dearest_frame(rows(STRESS), rows(STRESS_end)));
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

/* What one call of plush_push() is made of. */
enum { FRAME, FORGET, INTERPOLATE, INPUTS, GATE, NETWORK, ANSWER, PARTS };
#define MOST_AT_ONCE 64u

static uint32_t most[PARTS], least[PARTS];

static void note(uint32_t part, uint32_t took)
{
    if (took > most[part])
        most[part] = took;
    if (took < least[part])
        least[part] = took;
}

static uint32_t draw(uint32_t n)
{
    static uint32_t drawn = 2463534242u;

    drawn ^= drawn << 13;
    drawn ^= drawn >> 17;
    drawn ^= drawn << 5;
    return drawn % n;
}

/* Readings at the ends of their ranges, in the middle, somewhere. */
static void draw_readings(int32_t *values)
{
    uint32_t i;

    for (i = 0; i < toy.channels; i++) {
        uint32_t low = word_at(toy.ranges + RANGE_BYTES * i), width = word_at(toy.ranges + RANGE_BYTES * i + 4) - low;
        uint32_t of[4] = {0, width, width / 2, 0};

        of[3] = width < UINT32_MAX ? draw(width + 1) : draw(UINT32_MAX);
        values[i] = as_signed(low + of[draw(4)]);
    }
}

/* An event of any kind goes on or not, and is near any of its changes. */
static void draw_event(void)
{
    toy.event.what = (plush_what)draw(4);
    toy.event.affect = (plush_affect)draw(4);
    toy.event.gesture = (uint8_t)(draw(2) == 0 ? PLUSH_NO_GESTURE : draw(toy.classes));
    toy.event.source = (plush_source)draw(2);
    toy.suspect = draw(4) == 0;
    toy.wait = (uint16_t)draw(2);
    toy.resting = (uint16_t)draw(2);
    toy.away = toy.lasted = toy.wanted_for = toy.named_for = (uint16_t)(draw(2) * 1000u);
}

/* How much longer than another a sample may take in the network by what no state that is tried need show: for each filter
 * all that rounding takes, and at each tap the turn of a ring. */
#define ROUNDING 32u
#define TURN 4u

static uint32_t slack_of_sample(void)
{
    uint32_t slack = 0, i;

    for (i = 0; i < toy.layers; i++) {
        const plush_layer *layer = &toy.layer[i];

        slack += ROUNDING * layer->filters + TURN * ((layer->filters + GROUP - 1) / GROUP) * layer->kernel;
    }
    return slack;
}

/* Two rows: the most and the least instructions of each part over many states, the network's for as many samples
 * together as the longest gap asks for, or MOST_AT_ONCE; then how many the gap asks for, and how many were counted. */
static void count_parts(void)
{
    uint32_t samples = (toy.gap + toy.period - 1) / toy.period, together = samples, round, i, then, of[MOST_AT_ONCE];
    uint32_t rounds = 40u * toy.step;
    int32_t values[PLUSH_MODEL_CHANNELS];

    if (together > MOST_AT_ONCE)
        together = MOST_AT_ONCE;
    if (rounds < 2 * together)
        rounds = 2 * together;
    for (i = 0; i < PARTS; i++)
        least[i] = UINT32_MAX;
    toy.filled = 0;
    draw_readings(values);
    for (round = 0; round < rounds; round++) {
        if (round % 3 != 0)
            draw_readings(values);
        then = target_instructions();
        plush_push(&toy, toy.seen_ms, values); /* at the time of the one before: no sample falls due */
        note(FRAME, since(then));
        draw_readings(toy.before);
        draw_readings(toy.held);
        then = target_instructions();
        interpolate(&toy, toy.period * (1 + draw(samples)) - 1, toy.period * samples);
        note(INTERPOLATE, since(then));
        draw_readings(toy.sample);
        then = target_instructions();
        read_inputs(&toy);
        note(INPUTS, since(then));
        draw_event();
        then = target_instructions();
        if (has_gate(&toy))
            gate_sample(&toy, toy.seen_ms);
        note(GATE, since(then));
        toy.filled = (uint16_t)(round % toy.step);
        then = target_instructions();
        network_sample(&toy);
        of[round % together] = since(then);
        if (round % toy.step + 1 < toy.step)
            continue;
        if (round + 1 >= together) { /* with as many ends of steps as so many samples can have */
            uint32_t sum = 0;

            for (i = 0; i < together; i++)
                sum += of[i];
            note(NETWORK, sum);
        }
        draw_event();
        then = target_instructions();
        answer(&toy, toy.seen_ms);
        note(ANSWER, since(then));
    }
    i = slack_of_sample() * (toy.blocks == 0 ? toy.span * ((together + toy.step - 1) / toy.step) : together);
    most[NETWORK] += i; /* in both, so that it counts once */
    least[NETWORK] += i;
    then = target_instructions();
    plush_restart(&toy);
    note(FORGET, since(then));
    for (i = 0; i < PARTS; i++)
        put(most[i]);
    put(samples);
    for (i = 0; i < PARTS; i++)
        put(least[i]);
    put(together);
}

int main(void)
{
    measure_asking();
    if (!begin())
        return 0; /* and nothing is written */
    count_stages(rows(EVEN), rows(EVEN_end));
    count_parts();
    return 0;
}

#endif
