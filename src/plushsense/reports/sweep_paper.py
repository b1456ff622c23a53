"""What the paper prints of its own sweep (sections 4.1 and 4.2), to stand beside ours."""

from __future__ import annotations

from dataclasses import dataclass

from plushsense.models.arch import PAPER_FILTERS, TABLE3, TABLE3_MISPRINT, Arch

PAPER_THRESHOLD = 0.70
"""Table 4 is titled "with accuracy > 70%"; its last two rows, 69.1 and 68.7 %, are below that."""
PAPER_CHANNELS, PAPER_CLASSES = 11, 18
PAPER_TRIALS = 468
CHOSEN = ("14d1_39d2_41d4", "8/12/16")
"""Figure 10; its best schedule was 250 epochs with batches of 64."""
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


def printed(arch: str, filters: str) -> str | None:
    """The cell of Table 3 ("13.2k"); None where the paper has none."""
    counts = tuple(int(n) for n in filters.split("/"))
    for column, spec in enumerate(PAPER_FILTERS):
        if arch in TABLE3 and spec[: len(counts)] == counts and len(counts) == arch.count("_") + 1:
            return TABLE3[arch][column]
    return None


def misprint(arch: str, filters: str) -> bool:
    """Whether this is the cell that no count can meet."""
    return (arch, tuple(int(n) for n in filters.split("/"))) == TABLE3_MISPRINT


def counted(arch: str, filters: str) -> int:
    """Parameters at the paper's own 11 channels and 18 classes, whatever data the sweep had."""
    return Arch.parse(
        arch,
        [int(n) for n in filters.split("/")],
        channels=PAPER_CHANNELS,
        classes=PAPER_CLASSES,
        padding="mirror",
        norm="batch",
    ).parameters


def meets(said: str, count: int) -> bool:
    """Whether a count is what is printed ("13.2k"), rounded or cut off at the printed digit."""
    value, unit = value_of(said), _unit(said)
    return value in (count // unit * unit, (count + unit // 2) // unit * unit)


def value_of(said: str) -> int:
    """``13.2k`` as 13200."""
    return round(float(said.removesuffix("k")) * 1000)


def _unit(said: str) -> int:
    """What the last printed digit is worth: 100 for ``13.2k``, 1000 for ``192k``."""
    return 100 if "." in said else 1000
