"""Mutants: copies of an export with one deliberate error each, which its vectors must detect.

A mutant changes a number of the model (a weight, a shift, a range), or replaces a text in ``plushsense.c`` (an index, a
rounding, a clamp). The texts are in ``mutants.toml``.
"""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from plushsense.deploy.code import IMAGE, LIBRARY, MODEL, code_files
from plushsense.deploy.proof.scenarios import scenarios_of
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import Setting, verify
from plushsense.runtime.fixed import PROBABILITY_BITS
from plushsense.runtime.image import IntegerModel

Kind = Literal["weight", "shift", "index", "rounding", "clamp", "rule", "constant", "patch", "event", "gate", "health"]
RULES: tuple[Kind, ...] = ("event", "gate", "health")  # kinds that the test scenarios are made to detect
MORE_SCENARIOS = 3
_INT32 = (1 << 31) - 1


@dataclass(frozen=True)
class SourceMutant:
    """A replacement of text in plushsense.c: ``name`` describes the error, ``when`` the models it affects."""

    kind: Kind
    name: str
    find: str
    replace: str
    when: Literal["always", "dilated", "magnitude", "paired", "ranged", "smoothed", "stepped", "ties", "vectors"] = (
        "always"
    )


@cache
def source_mutants() -> tuple[SourceMutant, ...]:
    """The mutants of plushsense.c."""
    text = Path(__file__).with_name("mutants.toml").read_text(encoding="utf-8")
    return tuple(SourceMutant(**row) for row in tomllib.loads(text)["mutants"])


@dataclass(frozen=True)
class Mutant:
    """One error: either in the model, or in the C; the other is None."""

    kind: Kind
    name: str
    model: IntegerModel | None = None
    source: str | None = None


def mutants_of(model: IntegerModel, source: str) -> list[Mutant]:
    """The mutants of the model and of ``plushsense.c`` that change results of this model."""
    layout, arch = model.layout, model.network.arch
    dilated = any(layer.dilation > 1 for layer in arch.layers)
    affects = {
        "always": True,
        "dilated": dilated,
        "magnitude": any(d.kind == "magnitude" for d in layout.derived),
        "vectors": arch.vector is not None,
        "ranged": any(high < _INT32 for high in layout.valid_max_int.tolist()),
        # With a step of one sample, every sample has an answer, and none waits for the next.
        "stepped": arch.step > 1,
        "paired": arch.step > 1 and dilated,
        # Without smoothing nothing is rounded.
        "smoothed": model.smoothing < 1 << PROBABILITY_BITS,
        # With smaller time units, ties are rare.
        "ties": 1000 // np.gcd(1000, layout.period_us) <= 10,
    }
    found = [Mutant(kind, name, model=changed) for kind, name, changed in _models(model)]
    for m in source_mutants():
        assert source.count(m.find) == 1, m.name
        if affects[m.when]:
            found.append(Mutant(m.kind, m.name, source=source.replace(m.find, m.replace)))
    return found


def _models(model: IntegerModel) -> Iterator[tuple[Kind, str, IntegerModel]]:
    """Kind, name and copy of a model with one number changed by one."""
    network, layout = model.network, model.layout

    def with_network(**changed: Any) -> IntegerModel:
        return replace(model, network=replace(network, **changed))

    def by_one(scale: Any, row: int = 0) -> Any:
        after = scale.after.copy()
        after[row] += -1 if after[row] else 1
        return replace(scale, after=after)

    parts = [*network.layers, network.dense]
    for n, part in enumerate(parts):
        dense = n == len(parts) - 1
        name = "the dense layer" if dense else f"layer {n + 1}"
        read = np.abs((part if dense else parts[n + 1]).weights.astype(int))
        # In the filter that the next layer weights most.
        sums = read.reshape(len(read), -1).sum(axis=1) if dense else read.sum(axis=(0, *range(2, read.ndim)))
        row, weights = int(sums.argmax()), part.weights.copy()
        flat = weights[row].reshape(-1)
        at = int(np.abs(flat.astype(int)).argmax())
        flat[at] -= np.sign(flat[at])
        weights[row] = flat.reshape(weights[row].shape)
        changes: dict[Kind, Any] = {
            "weight": replace(part, weights=weights),
            "shift": replace(part, scale=by_one(part.scale, row)),
        }
        for kind, changed in changes.items():
            layers = tuple(changed if other is part else other for other in network.layers)
            yield (
                kind,
                f"one {kind} of {name} by one",
                with_network(dense=changed) if dense else with_network(layers=layers),
            )
    yield "shift", "one input's shift by one", with_network(inputs=by_one(network.inputs))
    if network.vectors is not None:
        weights = network.vectors.weights.copy()
        at = int(np.abs(weights.astype(int)).argmax())
        weights.flat[at] -= np.sign(weights.flat[at])
        yield (
            "weight",
            "one weight of the vector layer by one",
            with_network(vectors=replace(network.vectors, weights=weights)),
        )
    yield "constant", "the longest gap by one", replace(model, layout=replace(layout, gap_ms=layout.gap_ms + 1))
    less = model.smoothing == 1 << PROBABILITY_BITS
    yield "constant", "the smoothing's weight by one", replace(model, smoothing=model.smoothing + (-1 if less else 1))
    for n, channel in enumerate(layout.channels):
        if layout.valid_max_int[n] < _INT32:
            wider = replace(channel, valid_max=channel.valid_max + channel.step)
            channels = (*layout.channels[:n], wider, *layout.channels[n + 1 :])
            name = f"the valid range of channel {n + 1} by one"
            yield "constant", name, replace(model, layout=replace(layout, channels=channels))
            break


def found_by(export: Export, mutant: Mutant, setting: Setting, folder: Path) -> str | None:
    """The first answer by which a mutant is detected with a setting, among golden vectors, scenarios and patches.

    A mutant of the rules that no scenario reaches is tried on up to `MORE_SCENARIOS` times as many.
    """
    shutil.copytree(export.folder, folder)
    if mutant.model is not None:
        for name in (*MODEL, IMAGE):
            (folder / name).write_bytes(code_files(mutant.model, export.bundle)[name])
    if mutant.source is not None:
        (folder / LIBRARY[1]).write_text(mutant.source, "latin-1")
    changed = Export(folder)
    only: Callable[[Setting], bool] = lambda other: other == setting  # noqa: E731
    for again in range(1 + (MORE_SCENARIOS if mutant.kind in RULES else 0)):
        more = scenarios_of(export.model, export.bundle.scaler, again) if again else []
        if first := verify(changed, [setting.target], more, only=only, trust=True).first:
            return first
    return None
