"""Measure in what a person's recordings differ from those of the others, to explain why they are read badly or well."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import ACCELERATION
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, RecordingInfo
from plushsense.recording.takes import duration_s
from plushsense.scoring.comparison import average_ranks

TRAITS = {
    "rate_hz": "frames a second, by the clock of the toy",
    "tempo": "duration of a gesture, relative to the median of the others",
    "strength": "standard deviation of the channels, relative to the median of the others",
    "orientation_deg": "angle between the mean acceleration and that of the others",
}
# How far a person is from the median of all, in robust standard deviations, to be named as unusual.
UNUSUAL = 2.0
_MAD_TO_SD = 1.4826
_LEAST_SPREAD = 0.02

Floats = NDArray[np.float64]
Cells = Mapping[tuple[str, str], Sequence[Floats]]


def measure_people(dataset: Dataset, gestures: Sequence[str]) -> dict[str, dict[str, float | None]]:
    """Return the `TRAITS` of each person over the recordings of some gestures, by code of the person.

    Tempo, strength and orientation are compared gesture by gesture and averaged (ratios as logarithms). A trait that
    cannot be measured is None: the orientation without an acceleration, ratios of gestures that nobody else made.
    """
    axes = _acceleration(dataset)
    rates: dict[str, list[float]] = defaultdict(list)
    cells: dict[tuple[str, str], list[Floats]] = defaultdict(list)
    for recording in dataset.used:
        if recording.gesture in gestures and recording.subject not in (NOBODY, UNKNOWN_SUBJECT):
            if recording.rate_hz > 0:
                rates[recording.subject].append(recording.rate_hz)
            cells[recording.subject, recording.gesture].append(_measured(dataset, recording, axes))
    people = sorted({subject for subject, _ in cells})
    return {
        person: {
            "rate_hz": float(np.median(rates[person])) if rates[person] else None,
            "tempo": _ratio(cells, person, 0),
            "strength": _ratio(cells, person, 1),
            "orientation_deg": _angle(cells, person) if axes else None,
        }
        for person in people
    }


def unusual_traits(people: Mapping[str, Mapping[str, float | None]]) -> dict[str, list[str]]:
    """Return for each person sentences on the traits that are further than `UNUSUAL` from the median of all."""
    notes: dict[str, list[str]] = {person: [] for person in people}
    for trait in TRAITS:
        values = {person: _scaled(trait, row[trait]) for person, row in people.items()}
        known = np.array([v for v in values.values() if v is not None])
        if len(known) < 4:
            continue
        middle = float(np.median(known))
        # Where most people are alike, as in the rate of the same toy, the spread alone would be too small.
        spread = max(_MAD_TO_SD * float(np.median(np.abs(known - middle))), _LEAST_SPREAD * max(abs(middle), 1.0))
        for person, value in values.items():
            # A large angle is unusual, a small one is not.
            far = None if value is None else value - middle
            far = abs(far) if far is not None and trait != "orientation_deg" else far
            if far is not None and far > UNUSUAL * spread:
                notes[person].append(_sentence(trait, people[person][trait] or 0.0))
    return notes


def trait_correlations(
    people: Mapping[str, Mapping[str, float | None]], scores: Mapping[str, float | None]
) -> list[dict[str, Any]]:
    """Return Spearman's correlation of the accuracy with the distance of each trait from the median, over the people.

    ``chance`` is the absolute value that 95 % of unrelated traits stay below, 1.96 / √(n − 1).
    """
    rows = []
    for trait, title in TRAITS.items():
        found = [(_scaled(trait, row[trait]), scores.get(person)) for person, row in people.items()]
        known = np.array([(value, score) for value, score in found if value is not None and score is not None])
        rho, n = None, len(known)
        if n >= 4:
            far = known[:, 0] if trait == "orientation_deg" else np.abs(known[:, 0] - np.median(known[:, 0]))
            ranks = average_ranks(np.stack([far, known[:, 1]]))
            if np.ptp(ranks, axis=1).all():
                rho = float(np.corrcoef(ranks[0], ranks[1])[0, 1])
        chance = 1.96 / np.sqrt(n - 1) if n > 1 else None
        rows.append({"trait": trait, "title": title, "people": n, "rho": rho, "chance": chance})
    return rows


def _acceleration(dataset: Dataset) -> list[int]:
    """Return the indices of the axes of the first acceleration of the layout; empty without one."""
    layout = dataset.layout
    kinds = {channel.name: channel.kind for channel in layout.channels}
    first = next((v for v in layout.vectors if kinds[v[0]] == ACCELERATION), ())
    return [layout.index(axis) for axis in first]


def _measured(dataset: Dataset, recording: RecordingInfo, axes: list[int]) -> Floats:
    """Return the duration in s, the strength, and the mean acceleration (3 values, or none) of a recording."""
    layout = dataset.layout
    frames = dataset.read(recording)
    values = np.clip(frames.values, layout.valid_min_int, layout.valid_max_int) - layout.zero_int
    seconds = duration_s(len(values), recording.rate_hz or layout.rate_hz)
    strength = float(np.log(values.std(axis=0) + 1).mean())
    return np.array([seconds, np.exp(strength), *values[:, axes].mean(axis=0)])


def _ratio(cells: Cells, person: str, at: int) -> float | None:
    """Return the geometric mean over the gestures of the person's median value over that of the others."""
    logs = []
    for (subject, gesture), mine in cells.items():
        others = [v[at] for (p, g), rows in cells.items() if g == gesture and p != person for v in rows]
        if subject == person and others:
            ratio = float(np.median([v[at] for v in mine]) / max(float(np.median(others)), 1e-9))
            logs.append(np.log(max(ratio, 1e-9)))
    return float(np.exp(np.mean(logs))) if logs else None


def _angle(cells: Cells, person: str) -> float | None:
    """Return the angle in degrees between the mean directions of the person and of the others, a mean over gestures."""
    angles = []
    for (subject, gesture), mine in cells.items():
        others = [_unit(v[2:]) for (p, g), rows in cells.items() if g == gesture and p != person for v in rows]
        if subject == person and others:
            one, other = (_unit(np.mean(rows, axis=0)) for rows in ([_unit(v[2:]) for v in mine], others))
            angles.append(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))
    return float(np.mean(angles)) if angles else None


def _unit(v: Floats) -> Floats:
    return v / max(float(np.linalg.norm(v)), 1e-9)


def _scaled(trait: str, value: float | None) -> float | None:
    return float(np.log(value)) if value is not None and trait in ("tempo", "strength") else value


def _sentence(trait: str, value: float) -> str:
    if trait == "rate_hz":
        return f"{value:.0f} frames a second"
    if trait == "tempo":
        return f"gestures last {value:.2f} times as long as those of others"
    if trait == "strength":
        return f"signals {value:.2f} times as strong as those of others"
    return f"toy held {value:.0f}° from the usual direction"
