"""The paper's results of its sweep: Table 4, its chosen networks, and how its printed parameter counts are compared."""

from __future__ import annotations

from dataclasses import dataclass

from plushsense.models.arch import DEFAULT_FILTERS, PAPER_FILTERS, TABLE3, TABLE3_MISPRINT, Arch, slashed

THRESHOLD = 0.70
"""Table 4 is titled "with accuracy > 70%"; its last two rows, 69.1 and 68.7 %, are below that."""
CHANNELS, CLASSES = 11, 18
TRIALS = 468
CHOSEN = ("14d1_39d2_41d4", slashed(DEFAULT_FILTERS))
"""Section 3.6.2 and Figure 10; its best schedule was 250 epochs with batches of 64."""
SECOND = ("19d1_19d2_19d4_17d8", "4/6/8/8")
"""Figure 11."""


@dataclass(frozen=True)
class Table4Row:
    """A row of Table 4 as printed: highest and mean accuracy over nine schedules, and ACR, as shares of 1."""

    parameters: str
    highest: float
    mean: float
    acr: float


TABLE4: dict[tuple[str, str], Table4Row] = {
    ("14d1_39d2_41d4", "32/48/64"): Table4Row("192k", 0.790, 0.667, 0.150),
    ("19d1_24d3_19d9", "32/48/64"): Table4Row("103k", 0.771, 0.694, 0.154),
    ("28d1_32d2_41d4", "32/48/64"): Table4Row("186k", 0.771, 0.682, 0.146),
    ("14d1_39d2_41d4", "8/12/16"): Table4Row("13.2k", 0.750, 0.657, 0.182),
    ("19d1_24d3_19d9", "16/24/32"): Table4Row("27.9k", 0.741, 0.655, 0.167),
    ("28d1_32d2_41d4", "8/12/16"): Table4Row("13.8k", 0.736, 0.682, 0.178),
    ("19d1_19d2_19d4_17d8", "4/6/8/8"): Table4Row("3.4k", 0.727, 0.591, 0.206),
    ("14d1_39d2_41d4", "16/24/32"): Table4Row("49.7k", 0.724, 0.672, 0.154),
    ("28d1_32d2_41d4", "16/24/32"): Table4Row("49.5k", 0.723, 0.674, 0.154),
    ("19d1_24d3_19d9", "8/12/16"): Table4Row("8k", 0.717, 0.635, 0.184),
    ("28d1_32d2_41d4", "4/6/8"): Table4Row("4.1k", 0.691, 0.570, 0.191),
    ("70_90_91", "4/6/8"): Table4Row("9.8k", 0.687, 0.567, 0.172),
}


def printed_parameters(arch: str, filters: str) -> str | None:
    """Return the cell of Table 3 ("13.2k"); None where the paper has none."""
    counts = _filters(filters)
    for column, spec in enumerate(PAPER_FILTERS):
        if arch in TABLE3 and spec[: len(counts)] == counts and len(counts) == arch.count("_") + 1:
            return TABLE3[arch][column]
    return None


def is_misprint(arch: str, filters: str) -> bool:
    """Return whether this is the cell of Table 3 that looks like a misprint."""
    return (arch, _filters(filters)) == TABLE3_MISPRINT


def count_parameters(arch: str, filters: str) -> int:
    """Return the parameters at the paper's 11 channels and 18 classes, whatever data a sweep has."""
    size = {"channels": CHANNELS, "classes": CLASSES}
    return Arch.parse(arch, list(_filters(filters)), **size, padding="mirror", norm="batch").parameters


def agrees(printed: str, count: int) -> bool:
    """Return whether a count is what is printed ("13.2k"), rounded or cut off at the last printed digit."""
    unit = 100 if "." in printed else 1000
    return parse_count(printed) in (count // unit * unit, (count + unit // 2) // unit * unit)


def parse_count(printed: str) -> int:
    """Return 13200 for ``13.2k``."""
    return round(float(printed.removesuffix("k")) * 1000)


def _filters(filters: str) -> tuple[int, ...]:
    return tuple(int(n) for n in filters.split("/"))
