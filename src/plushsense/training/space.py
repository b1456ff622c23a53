"""Networks drawn from a space of kernels and dilations, for a search that goes beyond the paper's thirteen."""

from __future__ import annotations

import random
from dataclasses import dataclass

from plushsense.models.symbol import MAX_LAYERS

# Draws for each network that is asked for, until the space is taken as used up.
_TRIES = 2000


@dataclass(frozen=True)
class Space:
    """Which networks there are.

    ``layers``, ``kernels`` and ``dilations`` are drawn from; dilations never fall from layer to layer, as in all of
    the paper's networks. ``receptive_field``: the shortest and the longest, in samples; the paper keeps to about its
    window of 250. ``networks`` are drawn with ``seed``.
    """

    layers: tuple[int, ...] = (2, 3, 4)
    kernels: tuple[int, ...] = (1, 5, 9, 14, 19, 24, 29, 39, 59, 84)
    dilations: tuple[int, ...] = (1, 2, 3, 4, 8, 9)
    receptive_field: tuple[int, ...] = (100, 260)
    networks: int = 26
    seed: int = 0


def problems(space: Space) -> list[str]:
    """Everything that keeps networks from being drawn, one sentence each."""
    found = []
    for key, high in (("layers", MAX_LAYERS), ("kernels", None), ("dilations", None)):
        values = getattr(space, key)
        if not values or min(values) < 1 or (high is not None and max(values) > high):
            to = "" if high is None else f" to {high}"
            found.append(f"{key} of the space are {list(values)}: accepted are whole numbers from 1{to}.")
    field = space.receptive_field
    if len(field) != 2 or not 1 <= field[0] <= field[1]:
        found.append(f"receptive_field of the space is {list(field)}: accepted are two numbers, as [100, 260].")
    for key, low in (("networks", 2), ("seed", 0)):
        if getattr(space, key) < low:
            found.append(f"{key} of the space is {getattr(space, key)}: accepted are whole numbers from {low}.")
    if not found and len(drawn(space)) < 2:
        found.append(
            f"The space holds no two networks with a receptive field of {field[0]} to {field[1]} samples: give other "
            "kernels or dilations."
        )
    return found


def drawn(space: Space) -> tuple[str, ...]:
    """Symbols of ``networks`` different networks, the same for the same space; fewer where there are no more."""
    chance = random.Random(space.seed)
    found: dict[str, None] = {}
    for _ in range(_TRIES * space.networks):
        if len(found) == space.networks:
            break
        layers = chance.choice(space.layers)
        kernels = [chance.choice(space.kernels) for _ in range(layers)]
        # A kernel of one tap has no dilation to speak of.
        widths = sorted(chance.choice(space.dilations) for _ in range(layers))
        dilations = [1 if k == 1 else d for k, d in zip(kernels, widths, strict=True)]
        field = 1 + sum((k - 1) * d for k, d in zip(kernels, dilations, strict=True))
        if space.receptive_field[0] <= field <= space.receptive_field[1]:
            dilated = max(dilations) > 1
            layers_said = (f"{k}d{d}" if dilated else f"{k}" for k, d in zip(kernels, dilations, strict=True))
            found["_".join(layers_said)] = None
    return tuple(found)
