"""The example with two slots: a model that is not sound or not signed never takes the place of the running one."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from plushsense.deploy.package import TWO_SLOTS, emit
from plushsense.deploy.quantize import integer_model
from support.exports import bundle_of
from support.virtual_boards import run

STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror")
OK, SIZE, FLASH, SIGNATURE, MODEL, FORGOTTEN = range(6)
# Slots in RAM, and in the place of a signature one byte behind the model: whoever checks a real one has a key.
_FIRMWARE = """
#include "plush_model.h"
#include "plush_update.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SLOT_BYTES 20000u

static uint32_t memory[8192], other_memory[8192];
static plush_toy toy, alone;
static plush_update update;
static uint8_t slots[2][SLOT_BYTES], image[SLOT_BYTES];
static uint8_t remembered = PLUSH_NO_SLOT, flash_fails, memory_fails, asked;
static uint32_t remembered_bytes, at_ms;

int verify_signature(const uint8_t *bytes, uint32_t size)
{
    asked++;
    return bytes[size - 1] == 0x5a;
}

int plush_slot_erase(uint8_t slot)
{
    memset(slots[slot], 0xff, SLOT_BYTES);
    return 1;
}

int plush_slot_write(uint8_t slot, uint32_t at, const uint8_t *bytes, uint32_t n)
{
    memcpy(slots[slot] + at, bytes, n);
    return !flash_fails;
}

const uint8_t *plush_slot_bytes(uint8_t slot)
{
    return slots[slot];
}

int plush_slot_remember(uint8_t slot, uint32_t size)
{
    if (memory_fails)
        return 0;
    remembered = slot;
    remembered_bytes = size;
    return 1;
}

uint8_t plush_slot_remembered(uint32_t *size)
{
    *size = remembered_bytes;
    return remembered;
}

/* A file as an update, signed or not; `cut` bytes of it do not come. Says what came of it, and what runs. */
static void offer(const char *file, uint8_t signature, uint32_t cut, uint32_t flipped)
{
    FILE *from = fopen(file, "rb");
    uint32_t size = from == NULL ? 0 : (uint32_t)fread(image, 1, SLOT_BYTES, from), at, n;
    plush_update_result result;

    if (from == NULL || fclose(from) != 0)
        exit(9);
    image[flipped] ^= flipped != 0;
    image[size++] = signature;
    result = plush_update_begin(&update, size);
    for (at = 0; at < size - cut && result == PLUSH_UPDATE_OK; at += n) {
        n = size - cut - at < 77 ? size - cut - at : 77;
        result = plush_update_bytes(&update, image + at, n);
    }
    if (result == PLUSH_UPDATE_OK)
        result = plush_update_finish(&update);
    printf("%d %u %x\\n", (int)result, update.running, (unsigned)plush_model_id(&toy));
}

/* Frames for the toy, and for one that nobody disturbs: 1 if they say the same. */
static int same(uint32_t frames)
{
    int32_t values[PLUSH_MODEL_CHANNELS] = {0};
    uint32_t due = 0;

    for (; frames > 0; frames--, at_ms += 10) {
        values[0] = (int32_t)(at_ms % 470);
        due += plush_push(&toy, at_ms, values);
        plush_push(&alone, at_ms, values);
        if (memcmp(&toy.answer, &alone.answer, sizeof toy.answer) != 0 || toy.answers != alone.answers ||
            toy.event.number != alone.event.number)
            return 0;
    }
    return due > 10 && toy.answer.state == PLUSH_TRACKING;
}

static void start(void)
{
    memset(&toy, 0, sizeof toy);
    printf("%d", (int)plush_update_start(&update, &toy, memory, sizeof memory, SLOT_BYTES));
    printf(" %u %x\\n", update.running, (unsigned)plush_model_id(&toy));
}

int main(int count, char **names)
{
    const char *good = names[1], *foreign = names[2];

    (void)count;
    start();
    if (plush_begin(&alone, plush_model, PLUSH_MODEL_BYTES, other_memory, sizeof other_memory) != PLUSH_OK)
        return 1;
    printf("%d\\n", same(300));
    offer(good, 0, 0, 0); /* not signed */
    offer(good, 0x5a, 1, 0); /* its end does not come */
    offer(good, 0x5a, 0, 500); /* damaged, and signed all the same */
    offer(foreign, 0x5a, 0, 0); /* for other channels */
    flash_fails = 1;
    offer(good, 0x5a, 0, 0);
    flash_fails = 0;
    printf("%d", (int)plush_update_begin(&update, SLOT_BYTES + 1));
    printf(" %d", (int)plush_update_bytes(&update, image, 1));
    printf(" %d\\n", (int)plush_update_finish(&update));
    printf("%d\\n", (int)plush_update_begin(&update, 3));
    printf("%d\\n", (int)plush_update_bytes(&update, image, 4));
    printf("%d", same(300));
    printf(" %u %d\\n", remembered, asked);
    offer(good, 0x5a, 0, 0);
    start(); /* a reset */
    memory_fails = 1;
    offer(good, 0x5a, 0, 0);
    printf("%u %d\\n", remembered, (int)plush_update_begin(&update, 100));
    memory_fails = 0;
    printf("%d", (int)plush_update_begin(&update, 100));
    printf(" %u\\n", remembered);
    slots[remembered][700] ^= 1; /* what was remembered has aged */
    start();
    remembered_bytes = SLOT_BYTES + 1;
    start();
    return 0;
}
"""


@pytest.mark.parametrize(
    "compiler",
    [
        ("gcc", "-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
        ("clang", "-std=c99"),
        ("g++", "-std=c++11"),
    ],
    ids=["gcc", "clang", "g++"],
)
def test_only_a_sound_and_signed_model_takes_over(
    compiler: tuple[str, ...], needs: Callable[..., None], tmp_path: Path
) -> None:
    needs("gcc", "clang", "g++")
    bundle, other, foreign = (
        bundle_of("accel-3", window=60),
        bundle_of("accel-3", filters="8,8", window=60, seed=5),
        bundle_of("plush-15", window=60),
    )
    own, good, wrong = (integer_model(b).to_bytes() for b in (bundle, other, foreign))
    out = emit(integer_model(bundle), bundle, tmp_path / "out").folder
    (tmp_path / "good").write_bytes(good)
    (tmp_path / "foreign").write_bytes(wrong)
    (tmp_path / "firmware.c").write_text(_FIRMWARE)
    sources = [tmp_path / "firmware.c", out / TWO_SLOTS / "plush_update.c", out / "plushsense.c", out / "plush_model.c"]
    includes = [f"-I{out}", f"-I{out / TWO_SLOTS}"]
    run(*compiler, "-O1", *STRICT, *includes, *sources, "-o", tmp_path / "firmware")
    words = [tmp_path / "firmware", tmp_path / "good", tmp_path / "foreign"]
    lines = subprocess.run(words, capture_output=True, check=True).stdout.decode().splitlines()
    first, second = (f"{int.from_bytes(image[12:16], 'little'):x}" for image in (own, good))
    assert lines == [
        f"{OK} 255 {first}",
        "1",
        f"{SIGNATURE} 255 {first}",
        f"{SIZE} 255 {first}",
        f"{MODEL} 255 {first}",
        f"{MODEL} 255 {first}",
        f"{FLASH} 255 {first}",
        f"{SIZE} {SIZE} {SIZE}",
        f"{OK}",
        f"{SIZE}",
        "1 255 3",  # the old model as if nothing had come; nothing remembered; asked only for whole images
        f"{OK} 0 {second}",
        f"{OK} 0 {second}",
        f"{FORGOTTEN} 1 {second}",
        f"0 {FORGOTTEN}",  # the slot that a reset goes back to is not erased
        f"{OK} 1",
        f"{OK} 255 {first}",
        f"{OK} 255 {first}",
    ]
