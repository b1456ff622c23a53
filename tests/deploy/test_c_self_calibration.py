"""Self-calibration in C: bit for bit the integer model; each library takes its own models."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.layouts import MOST_CALIBRATED_OTHER, Channel
from plushsense.deploy.code import CALIBRATE, LIBRARY, library_files
from plushsense.deploy.golden import HEAD, HEALTH, ToyRows, answers_of
from plushsense.deploy.package import ARDUINO, IDF
from plushsense.deploy.proof.scenarios import exchanges_of
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import verify
from plushsense.deploy.quantize import integer_model
from plushsense.runtime.image import CALIBRATED, DEVIATING, IMAGE_VERSION, IntegerModel, image_head, memory_bytes
from plushsense.windows.clock import LONG_PAUSE_MS
from support.c_toy import Seat, seat
from support.exports import bundle_of, exported
from support.integers import any_frames, models, vector_model

OK, OTHER_VERSION, DAMAGED = 0, 2, 3


def calibrated_model() -> IntegerModel:
    model = vector_model()
    return replace(model, layout=replace(model.layout, self_calibration=("x", "y", "z")))


@settings(max_examples=25)
@given(models(longest=160, calibrated=True), st.integers(0, 1 << 30))
def test_any_calibrated_model_any_stream(calibrated_library: Any, model: IntegerModel, seed: int) -> None:
    image = model.to_bytes()
    assert calibrated_library.plush_memory_bytes(image, len(image)) == memory_bytes(model)
    frames = any_frames(model, seed)
    toy = seat(calibrated_library, model)
    assert np.array_equal(toy.push(frames), answers_of(model, frames))


def test_what_was_found_out_survives_a_gap_but_no_other_model(calibrated_library: Any) -> None:
    model = calibrated_model()
    first, second = any_frames(model, 1, 500, start=0), any_frames(model, 2, 500, start=90_000)
    both = np.concatenate([first, second])
    toy = seat(calibrated_library, model)
    whole = toy.push(both)
    assert np.array_equal(whole, answers_of(model, both))
    status, _ = toy.swap(model.to_bytes(), model.network.arch.classes)
    assert status == OK
    after = answers_of(model, second)
    swapped = toy.push(second)
    assert np.array_equal(swapped[:, HEAD:], after[:, HEAD:])
    assert not np.array_equal(whole[-len(after) :, HEAD:], after[:, HEAD:]), "the first model had calibrated itself"


def test_a_call_between_the_frames_is_the_reboot_that_the_host_sees() -> None:
    bundle = bundle_of("accel-3", "3d1_2d2", "3,4", window=40)
    model = integer_model(replace(bundle, layout=replace(bundle.layout, self_calibration=bundle.layout.names)))
    vectors = exchanges_of(model, bundle.scaler)
    reboot, exchange = (call.frame for call in vectors.calls)
    frames = vectors.frames[: exchange + 1]
    toy, host = ToyRows(model), np.where(np.arange(len(frames)) > reboot, LONG_PAUSE_MS, 0)
    for at, (ms, *values) in enumerate(frames.tolist()):
        toy.frame = at
        for moment in toy.toy.push(ms, values, int(host[at])):
            toy.add(moment)
    expected = vectors.answers[vectors.answers[:, 1] <= exchange]
    assert np.array_equal(toy.take(), expected[expected[:, 0] != HEALTH])
    called = answers_of(model, frames, vectors.calls)
    assert not np.array_equal(called[-20:], answers_of(model, frames)[-20:]), "the sensors before are not forgotten"


def test_each_library_takes_its_own_models(c_library: Any, calibrated_library: Any) -> None:
    model = calibrated_model()
    assert seat(calibrated_library, model).status == OK
    assert seat(c_library, model).status == seat(calibrated_library, vector_model()).status == OTHER_VERSION
    plain, calibrating = library_files(), library_files(calibrate=True)
    assert set(plain) == set(LIBRARY) and set(calibrating) == {*LIBRARY, CALIBRATE}
    assert plain[LIBRARY[1]] == calibrating[LIBRARY[1]], "one line of the header chooses"
    defined = "#define PLUSH_CALIBRATE\n"
    assert defined in calibrating[LIBRARY[0]] and defined not in plain[LIBRARY[0]]


def test_only_an_export_of_such_a_model_has_the_file(c_compiler: str, tmp_path: Path) -> None:
    plain = bundle_of("accel-3", "3d1_2d2", "3,4", window=40)
    themselves = replace(plain, layout=replace(plain.layout, self_calibration=plain.layout.names))
    for bundle, where in ((plain, set()), (themselves, {"", f"{ARDUINO}/src/", f"{IDF}/include/"})):
        out = exported(tmp_path / str(len(where)), bundle)
        assert {p.relative_to(out).as_posix() for p in out.rglob(CALIBRATE)} == {f"{w}{CALIBRATE}" for w in where}
    done = verify(Export(out), ["host"], only=lambda s: s.optimise == "-O2" and s.compiler == "gcc")
    assert done.passed and done.own and len(done.runs) == 3, "compiled in, from a file, and called from C++"
    assert "exchange" in {counts.name for counts in done.counts}


def test_ten_touch_channels_and_an_accelerometer(calibrated_library: Any) -> None:
    bundle = bundle_of("plush-15", "3d1_2d2", "3,4", window=40)
    themselves = replace(bundle.layout, self_calibration=bundle.layout.names)
    model = integer_model(replace(bundle, layout=themselves))
    toy = seat(calibrated_library, model)
    assert calibrated_library.plush_memory_bytes(model.to_bytes(), len(model.to_bytes())) == memory_bytes(model)
    rng = np.random.default_rng(4)
    touched = (np.arange(6000)[:, None] // 130 + np.arange(13)) % 4 == 1
    values = np.rint(4000 + touched * 20_000 + rng.normal(size=(6000, 13)) * np.where(touched, 1500.0, 40.0))
    times = np.cumsum(rng.choice([10, 10, 10, 11, 9, 10, 500], 6000, p=[0.2, 0.2, 0.2, 0.2, 0.1, 0.099, 0.001]))
    frames = np.column_stack([times, values]).astype(np.int64)
    assert np.array_equal(toy.push(frames), answers_of(model, frames))


def test_a_good_checksum_makes_no_calibrated_model(calibrated_library: Any) -> None:
    model = calibrated_model()
    body = model.to_bytes()[16:]
    plan = bytes([1, 1, 2, 3, 5])
    assert model.image_version == IMAGE_VERSION + CALIBRATED + DEVIATING
    at = body.index(plan)
    for what, change in {
        "no sensor": bytes([0]),
        "sixty-five": bytes([65]),
        "an unknown channel": bytes([1, 1, 2, 4]),
        "an unlimited channel": bytes([1, 0]),
        "a short block": bytes([1, 1, 2, 3, 1]),
        "a long block": bytes([1, 1, 2, 3, 9]),
        "a long block of another sensor": bytes([1, 1, 2, 3, 128 + 9]),
        "one channel as an accelerometer": bytes([1, 1, 1, 1, 5]),
        "two channels": bytes([1, 1, 1, 2, 128 + 5]),
        "a channel twice": bytes([1, 1, 2, 2]),
        "a channel of two sensors": bytes([2, 1, 2, 3, 5, 1, 2, 3, 5]),
        "an axis of a vector also alone": bytes([2, 1, 2, 3, 5, 2, 2, 2, 128 + 5]),
        "a single channel of two sensors": bytes([2, 3, 3, 3, 128 + 5, 3, 3, 3, 128 + 5]),
        "two axes alike": bytes([1, 1, 2, 2, 128 + 5]),
    }.items():
        wrong = body[:at] + change + body[at + min(len(change), len(plan)) :]
        image = image_head(wrong, version=model.image_version) + wrong
        assert Seat(calibrated_library, image, 4, 3).status == DAMAGED, what
    for right in (bytes([1, 1, 2, 3, 128 + 5]), bytes([2, 1, 1, 1, 128 + 5, 3, 3, 3, 128 + 8])):
        other = body[:at] + right + body[at + len(plan) :]
        image = image_head(other, version=model.image_version) + other
        assert Seat(calibrated_library, image, 4, 3).status == OK


def test_readings_at_the_ends_of_the_largest_range(calibrated_library: Any) -> None:
    axes, most = tuple(f"g{a}" for a in "xyz"), float(MOST_CALIBRATED_OTHER)
    channels = tuple(Channel(n, "raw", "angular rate", valid_min=-most, valid_max=most) for n in ("pad", *axes))
    layout = replace(
        vector_model().layout,
        # Blocks of 128 samples: their sums are large.
        rate_hz=400.0,
        channels=channels,
        vectors=(axes,),
        derived=(),
        inputs=("pad", *axes),
        wire=("device_ms", "pad", *axes),
        self_calibration=("pad", *axes),
    )
    model = integer_model(bundle_of(layout, "3d1_2d2", "3,4", window=40))
    rng, n = np.random.default_rng(6), 1000
    still, jumping = np.full((n, 4), -most), rng.choice([-most, most], (n, 4))
    values = np.concatenate([still, jumping, -still, rng.integers(-1, 2, (n, 4))])
    frames = np.column_stack([np.arange(len(values)) * 5 // 2, values]).astype(np.int64)
    assert np.array_equal(seat(calibrated_library, model).push(frames), answers_of(model, frames))
