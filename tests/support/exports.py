"""Exports of networks that nobody trained: the numbers are what counts, not what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.deploy.package import emit
from plushsense.deploy.quantize import calibrated, integer_model
from plushsense.models.arch import Arch, parse_symbol
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler

LAYOUTS = ("accel-3", "plush-14", "plush-15", "phone-6")


def bundle_of(
    layout: Layout | str = "accel-3",
    symbol: str = "9d1_5d2",
    filters: str = "4,6",
    *,
    gestures: GestureSet | None = None,
    seed: int = 3,
    **settings: Any,
) -> Bundle:
    """A network of random weights, its scaling and ranges those of random walks; ``settings`` go to its `Arch`."""
    read = load_layout(layout) if isinstance(layout, str) else layout
    gestures = gestures or load_gestures("plush-18")
    vectors: tuple[tuple[int, ...], ...] = ()
    if parse_symbol(symbol).vector is not None:
        read, settings = read.for_vectors(), {"vectors": len(read.vectors), **settings}
        vectors = read.input_vectors
    arch = Arch.parse(symbol, filters, channels=read.n_inputs, classes=len(gestures), **settings)
    rng = np.random.default_rng(seed)
    x = np.rint(np.cumsum(rng.normal(size=(16, arch.channels, arch.span + 60)), axis=2) * 50 + 1000).astype(np.int64)
    return calibrated(Bundle(arch, random_weights(arch, seed), read, Scaler.fit(x, vectors), gestures), x)


def exported(out: Path, bundle: Bundle) -> Path:
    """The bundle as an export folder."""
    emit(integer_model(bundle), bundle, out)
    return out
