"""Chips that people put into toys, and what counted instructions would take there: estimates, nothing ran on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Core:
    """One chip: its clock, the target whose instructions stand for its own, and cycles for each of them.

    ``flash_mb_s`` is set where code and model lie in flash behind a serial bus and a small cache: how fast that bus
    fills the cache, in MB/s. ``why`` says where the two bounds come from.
    """

    name: str
    title: str
    mhz: int
    target: str
    cycles_low: float
    cycles_high: float
    why: str
    flash_mb_s: float | None = None

    @property
    def reasons(self) -> str:
        """Where the bounds come from, in words."""
        if self.flash_mb_s is None:
            return self.why
        return (
            f"{self.why}; high also fetches code and model from the serial flash anew for every sample, at "
            f"{self.flash_mb_s:g} MB/s, as if its cache had kept nothing (in RAM they never are)"
        )


_LX = (
    "counted on lx106, a sibling without zero-overhead loops and with division in software, so the count is rather too "
    "high; seven pipeline stages (ESP32 datasheet), so what was just loaded or multiplied is there one or two cycles "
    "late, and in the inner loop nearly every instruction waits for it; the S3's vector unit is not used"
)
# 2 bits at 80 MHz are 20 MB/s (esptool, SPI flash modes: DIO), less command, address and waiting of each cache line.
_DIO = 15.0

CORES: dict[str, Core] = {
    "esp32": Core("esp32", "ESP32 (Xtensa LX6)", 240, "xtensa", 1.3, 2.4, _LX, _DIO),
    "esp32-s2": Core("esp32-s2", "ESP32-S2 (Xtensa LX7)", 240, "xtensa", 1.3, 2.4, _LX, _DIO),
    "esp32-s3": Core("esp32-s3", "ESP32-S3 (Xtensa LX7)", 240, "xtensa", 1.3, 2.4, _LX, _DIO),
    "esp32-c3": Core(
        "esp32-c3",
        "ESP32-C3 (RV32IMC)",
        160,
        "riscv32",
        1.1,
        2.0,
        "its own instruction set; four pipeline stages in order (technical reference manual), so what was just loaded "
        "is there about one cycle late, and a taken branch costs one or two cycles more",
        _DIO,
    ),
    "nrf52": Core(
        "nrf52",
        "nRF52 (Cortex-M4)",
        64,
        "cortex-m4",
        1.2,
        2.2,
        "its own instruction set; a load takes one or two cycles and a taken branch two to four (Arm, Cortex-M4 "
        "technical reference manual, table of instructions); high adds two cycles of waiting for the flash to each "
        "load of weights",
    ),
    "rp2040": Core(
        "rp2040",
        "RP2040 (Cortex-M0+)",
        133,
        "cortex-m0",
        1.4,
        2.0,
        "its own instruction set, counted on a core that runs it too; a load takes two cycles, a taken branch two, "
        "a product one (Arm, Cortex-M0+ instruction summary)",
        12.0,
    ),
}


@dataclass(frozen=True)
class Estimate:
    """What one step would take on a core, in ms, between two bounds; and whether that fits between two decisions."""

    core: Core
    instructions: int
    step_ms: float
    low_ms: float
    high_ms: float

    @property
    def fits(self) -> str:
        """``yes``, ``no``, or ``unsure`` when it depends on where in the band the chip lies."""
        return "yes" if self.high_ms <= self.step_ms else "no" if self.low_ms > self.step_ms else "unsure"

    @property
    def answer(self) -> str:
        """In words, with the share of the core and what is left of a step."""
        low, high = (f"{100 * ms / self.step_ms:.2g}" for ms in (self.low_ms, self.high_ms))
        if self.fits == "yes":
            return f"yes, uses about {low} to {high} % of the core, {self.step_ms - self.high_ms:.0f} ms left a step"
        if self.fits == "unsure":
            return f"not sure, it would use about {low} to {float(high):g} % of the core"
        return f"no, it would use {float(low):g} % of the core or more"

    @property
    def verdict(self) -> str:
        """The answer as a whole sentence."""
        return f"fits {1000 / self.step_ms:g} Hz: {self.answer}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        core = self.core
        return {
            "estimate": True,
            "chip": core.title,
            "mhz": core.mhz,
            "counted_on": core.target,
            "instructions": self.instructions,
            "cycles_per_instruction": [core.cycles_low, core.cycles_high],
            "flash_mb_s": core.flash_mb_s,
            "low": round(self.low_ms, 3),
            "high": round(self.high_ms, 3),
            "fits": self.fits,
            "verdict": self.verdict,
            "why": core.reasons,
        }


def estimate(core: Core, instructions: int, flash_bytes: int, samples: int, step_ms: float) -> Estimate:
    """What a step of so many instructions and samples would take on a core, with so much code and data in flash."""
    low = instructions * core.cycles_low / core.mhz / 1000
    high = instructions * core.cycles_high / core.mhz / 1000
    if core.flash_mb_s is not None:
        high += samples * flash_bytes / core.flash_mb_s / 1000
    return Estimate(core, instructions, step_ms, low, high)
