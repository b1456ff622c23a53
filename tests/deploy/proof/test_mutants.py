"""The mutants: each changes one thing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.deploy.code import library_files
from plushsense.deploy.proof.mutants import mutants_of, source_mutants
from plushsense.deploy.quantize import integer_model
from support.exports import bundle_of


def test_the_texts_of_the_mutants_occur_in_the_c(small: Path) -> None:
    source = library_files()["plushsense.c"]
    found = mutants_of((small / "plush_model.bin").read_bytes(), source)
    assert len({f.name for f in found}) == len(found)
    assert len(found) == len([m for m in source_mutants() if m.when != "vectors"]) + 10
    for mutant in found:
        assert (mutant.image is None) != (mutant.source is None)
        assert mutant.source != source
    image = np.frombuffer((small / "plush_model.bin").read_bytes(), dtype=np.uint8)
    for mutant in found:
        if mutant.image is not None:
            # The checksum and one number.
            changed = np.flatnonzero(np.frombuffer(mutant.image, dtype=np.uint8) != image)
            assert 1 <= (changed >= 16).sum() <= 2 and ((changed >= 12) & (changed < 16)).any()
    with pytest.raises(BadInput, match="occurs 0 times"):
        mutants_of((small / "plush_model.bin").read_bytes(), source.replace("+ 16384u", "+ 16385u"))


@pytest.mark.parametrize(("layout", "symbol"), [("accel-3", "9d1_5d2"), ("accel-3", "v9_5d2"), ("phone-6", "v9_5d2")])
def test_the_weight_that_is_changed_is_the_largest_of_a_filter(layout: str, symbol: str) -> None:
    model = integer_model(bundle_of(layout, symbol))
    image = np.frombuffer(model.to_bytes(), dtype=np.uint8).astype(int)
    found = {m.name: m for m in mutants_of(model.to_bytes(), library_files()["plushsense.c"])}
    parts = {f"layer {n}": layer.weights for n, layer in enumerate(model.network.layers, 1)}
    for name, weights in (parts | {"the dense layer": model.network.dense.weights}).items():
        changed = np.frombuffer(found[f"one weight of {name} by one"].image or b"", dtype=np.uint8).astype(int)
        (at,) = np.flatnonzero((changed != image)[16:]) + 16
        assert abs(changed[at] - image[at]) == 1
        assert abs(image[at] - 128) in np.abs(weights.astype(int)).reshape(len(weights), -1).max(axis=1)
