"""Bundles of no meaning, for what is not about what they say."""

from __future__ import annotations

import json
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
