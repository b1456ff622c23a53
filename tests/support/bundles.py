"""Bundles of no meaning, for what is not about what they say."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from plushsense.core.gestures import Gesture, GestureSet, load_gestures
from plushsense.core.layouts import load_layout
from plushsense.models import bundle as format_
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler

OTHER = GestureSet("circus", (Gesture("juggle", "positive"), Gesture("bow", "neutral")))


def odd_bundle(path: Path, layout: str = "plush-15", gestures: GestureSet | None = None) -> Path:
    """A network of random weights at ``path``; without calibration, so that it cannot run as the chip does."""
    chosen, known = load_layout(layout), gestures or load_gestures("plush-18")
    arch = Arch.parse("5d1_4d3", (6, 5), channels=chosen.n_inputs, classes=len(known), window=48, step=5)
    scaler = Scaler(np.zeros(chosen.n_inputs), np.full(chosen.n_inputs, 0.01))
    return Bundle(arch, random_weights(arch, 3), chosen, scaler, known).save(path)


def contents(data: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """The content and the tensors of a bundle's file, to be changed."""
    head = json.loads(json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]["plushsense"])
    return head["content"], load(data)


def signed(content: dict[str, Any], weights: dict[str, Any]) -> bytes:
    """A bundle's file of any content, with a right checksum."""
    checksum = format_._digest(format_._canonical(content), weights)
    head = {"format": format_.FORMAT, "version": format_.VERSION, "sha256": checksum, "content": content}
    return bytes(save(weights, metadata={"plushsense": format_._canonical(head)}))


ODD = (
    *(None, True, False, "x", "", "\udc00", "\x1b[2J", "a\nb", "*/", "??/", "\0", [], {}, [1], [[]], {"a": 1}),
    *(-1, 0, 1, 2, 3, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32, 10**6, 10**30, 10**400),
    *(1e308, -1e308, 1e-300, 1e-12, 0.1, 0.5, 1.0, -0.0),
)
_TYPES = ("<f8", "<f2", "<i4", "u1", "?")


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths to all values in a table."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, each in inner for place in places(each, (*path, key)))]


def mutated(content: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """A copy of a table with one to three values removed, doubled, scaled, added or replaced by odd ones."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        *inside, last = rng.choice(places(content)[1:])
        table: Any = content
        for step in inside:
            table = table[step]
        value, kind = table[last], rng.random()
        if kind < 0.15 and isinstance(table, dict) and len(content) > 1:
            del table[last]
        elif kind < 0.2 and isinstance(table, dict):
            table[rng.choice(("extra", f"{last}x"))] = rng.choice(ODD)
        elif kind < 0.3 and isinstance(table, list):
            table[last : last + 1] = rng.choice(([], [value, copy.deepcopy(value)]))
        elif kind < 0.5 and isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
            table[last] = rng.choice((value * 2, value + 1, value - 1, -value, value * 1000, value % 1000 / 1000))
        else:
            table[last] = copy.deepcopy(rng.choice(ODD))
    return content


def mutated_weights(weights: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """A copy of tensors, one of which is missing, of another type or shape, or has odd values."""
    name = rng.choice(sorted(weights))
    weight, how = np.array(weights[name]), rng.randrange(6)
    others = {key: value for key, value in weights.items() if key != name}
    if how == 0 and others:
        return others
    with np.errstate(all="ignore"):
        if how == 1:
            weight = weight.astype(rng.choice(_TYPES))
        elif how == 2:
            weight = weight.reshape(-1)[: rng.randrange(3)]
        elif how == 3:
            weight = weight * np.float32(rng.choice((0, 1e30, 1e-30, -1)))
        else:
            weight.flat[rng.randrange(weight.size)] = rng.choice((0.0, 1e38, -1e38, 1e-45, 1e10, -1e5, np.nan, np.inf))
    return {**others, name: weight}
