"""Bundles of any content with a right checksum: each runs and is written as C, or is refused in a sentence."""

from __future__ import annotations

import json
import os
import random
import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from plushsense.core.errors import PlushSenseError, printable
from plushsense.core.gestures import load_gestures
from plushsense.deploy.code import IMAGE, code_files, facts_of
from plushsense.deploy.golden import answers_of, golden_frames
from plushsense.deploy.package import firmware, handbook
from plushsense.deploy.quantize import classifier_of, integer_model
from plushsense.devices.base import Frame
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import memory_bytes
from plushsense.windows.cut import whole_gestures
from plushsense.workflow.reporting import card
from support.bundles import contents, mutated, mutated_weights, signed
from support.exports import bundle_of

BUNDLES = 100 * int(os.environ.get("PLUSHSENSE_FUZZ", "1"))
SEED = int(os.environ.get("PLUSHSENSE_FUZZ_SEED", "1"))
_DENSE = {"dense.weight": np.zeros((5, 4)).tolist(), "dense.bias": [0.0] * 5}
_SCORES = {"accuracy": 0.5, "macro_f1": 0.4, "windows": 30, "leaky": False, "split": "x", "int8": {"agreement": 0.9}}
_FULL = {
    "decision": {
        "smoothing_s": 0.3,
        "known_margin": 0.5,
        "enter": 0.6,
        "gate": {
            "signals": [{"kind": 1, "inputs": [0, 1], "lag": 2, "shift": 0, "baseline": 5, "noise": 6, "floor": 2}],
            "rules": [{"terms": [{"signal": 0, "threshold": 100}], "affect": 3, "gesture": 2}],
        },
        "health": {"low": [0] * 3, "high": [1023] * 3, "fault_ms": 500, "still_ms": 200, "recover_ms": 300},
        "fitted": {"people": 3},
    },
    "provenance": {
        "subjects": ["p1", "p2"],
        "validation_subjects": ["p3"],
        "dataset": "D",
        "dataset_hash": "ab" * 16,
        "split": "loso",
        "preset": "people",
        "code_version": "0.1.0",
        "simulated": True,
        "training": {"epochs": 3},
        "scores": _SCORES,
        "estimator": {"labels": list("abcde"), "dtype": "O"},
        "model_version": "1.2.0",
    },
    "windowing": {"window_s": 2.5, "step_s": 0.5, "context": "stream", "span_s": 1.0, "anywhere": {"every_s": 0.1}},
    "personal": {"subject": "S1", "original": _DENSE, "recordings": 3},
}


def models() -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Contents and tensors of a streaming network with all that a bundle may hold, and of others of each kind."""
    known = load_gestures("plush-18")
    few = known.subset(known.labels[:5])
    full = replace(bundle_of("accel-3", "3d1_2d2", "3,4", gestures=few, window=40), **_FULL)
    others = (
        bundle_of("accel-3", "3d1_2d2", "3,4", gestures=few, window=40, padding="mirror"),
        bundle_of("plush-15", "v5_3d2", "2,4", gestures=few, window=40),
        bundle_of("phone-6", "3_3", "3,4", gestures=few, window=30, norm="none"),
    )
    return [contents(bundle.to_bytes()) for bundle in (full, full, *others)]


def changed(content: dict[str, Any], weights: dict[str, Any], rng: random.Random) -> bytes:
    """A bundle with some values changed; mostly with the values that follow from the others set right."""
    if rng.random() < 0.2:
        weights = mutated_weights(weights, rng)
    else:
        content = mutated(content, rng)
    if rng.random() < 0.8 and isinstance(content.get("arch"), dict):
        try:
            arch, layout = Arch.from_dict(content["arch"]), content["layout"]
            rate, gap = layout["rate_hz"], layout["gap_ms"]
            content["clock"] = {"rate_hz": rate, "period_us": round(1e6 / rate), "gap_ms": gap}
            content |= {"features": layout["inputs"], "pool": arch.pooled, "step": arch.step, "span": arch.span}
        except (PlushSenseError, LookupError, TypeError, ArithmeticError, ValueError):
            pass
    return signed(content, weights)


def use(data: bytes, frames: np.ndarray[Any, Any], golden: bool) -> None:
    """All that is done with a bundle: read, described, run for a second in floats and in 8 bits, written as C."""
    # It loads scikit-learn, which no other worker needs for this.
    from plushsense.workflow.estimator import labels_from

    bundle = Bundle.from_bytes(data)
    layout = bundle.layout
    labels = list(bundle.gestures.labels)
    facts = card(bundle.arch, rate_hz=layout.rate_hz, layout=layout.name, gestures=labels, provenance=bundle.provenance)
    json.dumps([repr(bundle), facts])
    for read in (lambda: whole_gestures(bundle.windowing), lambda: labels_from(bundle)):
        refused(read)
    bundle.without_people().to_bytes()

    def run(engine: str) -> None:
        reader = classifier_of(bundle, None, engine)
        for k in range(int(min(layout.rate_hz, 200))):
            values = tuple(frames[k, np.arange(layout.n_channels) % frames.shape[1]].tolist())
            for decision in reader.push(Frame(10 * k, 10 * k, values)):
                json.dumps(decision.to_dict())

    refused(lambda: run("float"))
    refused(lambda: run("int8"))
    model, given = integer_model(bundle), bundle.without_people()
    if model.network.arch.padding == "mirror":
        assert refused(lambda: code_files(model, given)), "only streaming networks have C"
        return
    memory_bytes(model)
    code = code_files(model, given)
    facts = facts_of(model, given, code[IMAGE])
    firmware(layout, given.scaler, facts)
    handbook(given, facts)
    if golden and model.network.arch.span < 1000:
        answers_of(model, golden_frames(layout, given.scaler, model.network.arch.span, health=model.rules.health)[:300])


def refused(action: Any) -> bool:
    """Whether an action is refused, which must be in one sentence."""
    try:
        action()
    except PlushSenseError as error:
        assert str(error) == printable(str(error)) and len(str(error)) < 3000
        return True
    return False


def test_any_bundle_with_a_right_checksum_is_used_or_refused() -> None:
    """``PLUSHSENSE_FUZZ=1000`` tries 100 000 instead of 100."""
    rng, known, good = random.Random(SEED), models(), 0
    frames = np.random.default_rng(0).integers(-500, 1500, (200, 32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a number that overflows is a wrong answer
        for content, weights in known:
            use(signed(content, weights), frames, True)
        for number in range(BUNDLES):
            data = changed(*rng.choice(known), rng)
            try:
                good += not refused(lambda data=data, deep=number % 50 == 0: use(data, frames, deep))
            except Exception as error:
                error.add_note(f"bundle {number} of seed {SEED}")
                raise
    assert 0.1 * BUNDLES < good < 0.9 * BUNDLES
