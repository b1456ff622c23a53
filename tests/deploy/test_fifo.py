"""The example of a sensor with a buffer and an interrupt: the toy sees what one sees that gets each reading at once."""

from __future__ import annotations

import subprocess
from pathlib import Path

from plushsense.deploy.package import BUFFERED, emit
from plushsense.deploy.quantize import integer_model
from support.exports import bundle_of
from support.virtual_boards import WARNINGS, run

# A reading every 10 ms. Taking one out of the buffer takes 4 ms, so that more come meanwhile; the loop comes late.
FIRMWARE = r"""
#include <stdio.h>
#include <string.h>

#include "plush_fifo.h"

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS], other[PLUSH_MODEL_MEMORY_WORDS], ms, first, next, cut;
static int32_t values[4000][PLUSH_MODEL_CHANNELS];
static plush_toy toy, alone;
static plush_answer answers[2][4000];
static uint32_t given[2];

static void answered(const plush_toy *of, void *user)
{
    uint32_t i = of == &alone;

    (void)user;
    answers[i][given[i]++] = of->answer;
}

static void wait(uint32_t some)
{
    for (; some > 0; some--) {
        if (++ms % 10 != 0)
            continue;
        if (next - first == PLUSH_FIFO_MOST)
            cut++;
        plush_push(&alone, ms, values[next++]);
        if (next - first == PLUSH_FIFO_MARK)
            plush_fifo_interrupt(ms);
    }
}

uint32_t plush_fifo_level(void)
{
    return next - first;
}

void plush_fifo_read(int32_t *to)
{
    memcpy(to, values[first++], sizeof values[0]);
    wait(4);
}

int main(void)
{
    uint32_t noise = 1, late = 0, i, c;

    for (i = 0; i < 4000; i++)
        for (c = 0; c < PLUSH_MODEL_CHANNELS; c++) {
            noise = noise * 1664525u + 1013904223u;
            values[i][c] = (int32_t)(noise >> 21) - 1024;
        }
    if (plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory) != PLUSH_OK ||
        plush_begin(&alone, plush_model, PLUSH_MODEL_BYTES, other, sizeof other) != PLUSH_OK)
        return 1;
    toy.on_answer = alone.on_answer = answered;
    while (next < 3000) {
        late = (late + 7) % 200;
        wait(1 + late);
        plush_fifo_drain(&toy);
    }
    if (given[0] > given[1] || memcmp(answers[0], answers[1], given[0] * sizeof answers[0][0]) != 0)
        return 2;
    printf("%lu %lu %lu\n", (unsigned long)given[0], (unsigned long)(given[1] - given[0]), (unsigned long)cut);
    return 0;
}
"""


def test_an_interrupt_and_bursts_lose_nothing(c_compiler: str, tmp_path: Path) -> None:
    bundle, out, program = bundle_of("accel-3"), tmp_path / "out", tmp_path / "firmware"
    emit(integer_model(bundle), bundle, out)
    program.with_suffix(".c").write_text(FIRMWARE)
    sources = [program.with_suffix(".c"), *(out / BUFFERED).glob("*.c"), *out.glob("*.c")]
    words = ["-std=c99", "-O1", "-DPLUSH_FIFO_PERIOD_US=10000u", f"-I{out}", f"-I{out / BUFFERED}"]
    run(c_compiler, *words, *WARNINGS, "-fsanitize=address,undefined", *sources, "-o", program)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    answers, late, cut = map(int, done.stdout.split())
    assert answers > 500 and late < 6 and cut == 0
