"""Where a training stands between two epochs, so that it can go on as if it had never stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_WEIGHT, _MEAN, _SQUARE, _KEPT, _BEST = "weight:", "mean:", "square:", "kept:", "best:"


@dataclass(frozen=True)
class FitState:
    """After ``epoch``: the weights; Adam's ``means`` and ``squares`` of each parameter after ``steps`` steps; what
    draws order and turns (``random``); the history so far; the weights ``kept`` after earlier epochs; with early
    stopping, the ``best`` weights so far (of which epoch, the history says)."""

    epoch: int
    steps: int
    weights: dict[str, NDArray[np.float32]]
    means: Sequence[NDArray[np.float32]]
    squares: Sequence[NDArray[np.float32]]
    random: NDArray[np.uint8]
    history: list[dict[str, Any]]
    kept: dict[int, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    best: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    def to_arrays(self) -> dict[str, Any]:
        """Arrays and plain values by name, as a journal takes them."""
        arrays: dict[str, Any] = {"epoch": self.epoch, "steps": self.steps, "history": self.history}
        for prefix, weights in ((_WEIGHT, self.weights), (_BEST, self.best)):
            arrays |= {prefix + name: values for name, values in weights.items()}
        for prefix, several in ((_MEAN, self.means), (_SQUARE, self.squares)):
            arrays |= {f"{prefix}{i}": values for i, values in enumerate(several)}
        for epoch, weights in self.kept.items():
            arrays |= {f"{_KEPT}{epoch}:{name}": values for name, values in weights.items()}
        return arrays | {"random": self.random}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> FitState:
        """What `to_arrays` gave; other names beside it are passed over."""

        def several(prefix: str) -> list[NDArray[np.float32]]:
            return [arrays[f"{prefix}{i}"] for i in range(sum(name.startswith(prefix) for name in arrays))]

        def named(prefix: str) -> dict[str, NDArray[np.float32]]:
            return {name.removeprefix(prefix): v for name, v in arrays.items() if name.startswith(prefix)}

        kept: dict[int, dict[str, NDArray[np.float32]]] = {}
        for name, values in arrays.items():
            if name.startswith(_KEPT):
                epoch, _, weight = name.removeprefix(_KEPT).partition(":")
                kept.setdefault(int(epoch), {})[weight] = values
        return cls(
            epoch=int(arrays["epoch"]),
            steps=int(arrays["steps"]),
            weights=named(_WEIGHT),
            means=several(_MEAN),
            squares=several(_SQUARE),
            random=arrays["random"],
            history=list(arrays["history"]),
            kept=kept,
            best=named(_BEST),
        )
