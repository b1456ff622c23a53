"""Repeat the paper's estimate of the time on the chip (section 4.7), and set it beside the counted instructions.

The paper divides the multiply-accumulates (MACs) of a window by rates that it derives from published benchmarks of the
ESP32. It measured nothing on a chip, and neither do we.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from plushsense.models.arch import Arch

if TYPE_CHECKING:
    from plushsense.deploy.profile import Profile

FLOAT_MMAC_S = 58.0
INT16_MMAC_S = 137.0
"""Rates of the ESP32 in millions of MACs per second, as the paper states them (section 4.7)."""

PAPER_NETWORK = "14d1_39d2_41d4", (8, 12, 16)
_CORE = "esp32"
_FLOAT_BYTES = 4

PAPER_ASSUMES = (
    "the time is the number of MACs divided by a rate: 58 MMAC/s in floats, 137 MMAC/s in 16-bit integers",
    "each decision computes a whole window of 250 samples again",
    "all other work takes no time: activation, normalisation, scaling, softmax, reading the sensors",
    "the rates are calculated from published benchmarks of the ESP32; the paper does not say of which code",
    "the ESP32 has no floating-point unit: it does have one, for single precision",
)
OURS_ASSUMES = (
    "the instructions of our C for one step are counted on an emulator, with everything from frame to event",
    "each decision computes the new samples only, with the state of the layers kept",
    "weights and activations have 8 bits, sums 32",
    "cycles per instruction lie between two bounds, of which the upper one adds waiting for the flash",
    "the instructions are those of lx106, a sibling of the ESP32's core: rather too many",
)


@dataclass(frozen=True)
class PaperEstimate:
    """MACs of one decision, and the times that the paper's rates give for them."""

    what: str
    macs: int

    @property
    def float_ms(self) -> float:
        """Time in ms at the rate of floats."""
        return self.macs / FLOAT_MMAC_S / 1000

    @property
    def int16_ms(self) -> float:
        """Time in ms at the rate of 16-bit integers."""
        return self.macs / INT16_MMAC_S / 1000

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "what": self.what,
            "macs": self.macs,
            "float_ms": round(self.float_ms, 3),
            "int16_ms": round(self.int16_ms, 3),
        }


@dataclass(frozen=True)
class PaperComparison:
    """The paper's estimates, and ours for the ESP32 as (low, high) in ms; None if it was not counted.

    ``window_ms`` is ours for the whole span at each decision, by the instructions for each MAC of the counted step.
    ``float_bytes`` is the size of the weights in floats, by which the paper states the memory.
    """

    estimates: Sequence[PaperEstimate]
    step_ms: tuple[float, float] | None
    window_ms: tuple[float, float] | None
    float_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "mmac_s": {"float": FLOAT_MMAC_S, "int16": INT16_MMAC_S},
            "estimates": [e.to_json() for e in self.estimates],
            "ours_step_ms": None if self.step_ms is None else [round(ms, 3) for ms in self.step_ms],
            "ours_window_ms": None if self.window_ms is None else [round(ms, 1) for ms in self.window_ms],
            "float_weights_bytes": self.float_bytes,
            "paper_assumes": list(PAPER_ASSUMES),
            "ours_assumes": list(OURS_ASSUMES),
        }


def compare_with_paper(profile: Profile) -> PaperComparison:
    """Apply the paper's rates to its network and to the exported one, beside our estimates for the ESP32."""
    symbol, filters = PAPER_NETWORK
    paper = Arch.parse(symbol, filters, padding="mirror")
    mine = profile.arch
    estimates = (
        PaperEstimate("the paper's network, a window of 250 samples", paper.macs_per_window),
        PaperEstimate(f"this network, its whole span of {mine.span} samples", mine.macs_per_window),
        PaperEstimate(f"this network, a step of {mine.step} samples", mine.macs_per_step),
    )
    esp32 = profile.estimates.get(_CORE)
    step = window = None
    if esp32 is not None:
        core = esp32.core
        step = (esp32.low_ms, esp32.high_ms)
        count = profile.window_instructions[core.target]
        window = (count * core.cycles_low / core.mhz / 1000, count * core.cycles_high / core.mhz / 1000)
    return PaperComparison(estimates, step, window, mine.parameters * _FLOAT_BYTES)
