"""What an export costs: instructions, bytes, stack on each emulated chip, and what that would mean on real ones.

The counts are exact and the same in every run. Times are estimates, derived from them: nothing ran on a real chip.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, ToolError
from plushsense.deploy.cores import CORES, Estimate, estimate
from plushsense.deploy.counting import STEPS, Cost, count
from plushsense.deploy.emit import read_facts
from plushsense.deploy.targets import TARGETS, missing_tools, require, target_named
from plushsense.models.arch import Arch

SAID = (
    "Instructions are counted on emulators and exact. Times are estimates from them, between two bounds: nothing ran "
    "on a real chip."
)


@dataclass(frozen=True)
class Profile:
    """Costs by target, and estimates by core for which its target was counted. ``missing`` names, by target that was
    left out, the Debian packages that it needs."""

    facts: Mapping[str, Any]
    arch: Arch
    optimise: str
    costs: Mapping[str, Cost]
    estimates: Mapping[str, Estimate]
    missing: Mapping[str, Sequence[str]]

    @property
    def step_ms(self) -> float:
        """Time between two decisions."""
        return float(self.facts["step_ms"])

    @property
    def macs_by_layer(self) -> dict[str, int]:
        """Multiply-accumulates of a step by layer; the dense layer is worked out once a step."""
        names = (f"layer {n}" for n in range(1, len(self.arch.layers) + 1))
        macs = {name: m * self.arch.step for name, m in zip(names, self.arch.macs_per_position, strict=True)}
        return macs | {"dense": self.arch.classes * self.arch.filters[-1]}

    @property
    def window_instructions(self) -> dict[str, int]:
        """An estimate, by target: what the network would take if it recomputed its whole span at every step, at as
        many instructions for a multiply-accumulate as were counted."""
        ratio = self.arch.macs_per_window / self.arch.macs_per_step
        return {name: round(c.stages["network"] * ratio) for name, c in self.costs.items() if c.stages}

    def to_dict(self) -> dict[str, Any]:
        """The object that ``plushsense profile --json`` prints."""
        counted = {name: c for name, c in self.costs.items() if c.step is not None}
        return {
            "title": self.arch.title,
            "said": SAID,
            "optimise": self.optimise,
            "step": self.arch.step,
            "step_ms": self.step_ms,
            "decisions_counted": STEPS,
            "instructions_per_step": {name: c.step for name, c in counted.items()},
            "network_instructions_per_step": {name: c.stages["network"] for name, c in counted.items()},
            "macs_per_step": self.arch.macs_per_step,
            "macs_per_window": self.arch.macs_per_window,
            "macs_by_layer": self.macs_by_layer,
            "flash_bytes": {name: c.flash_bytes for name, c in self.costs.items()},
            "ram_bytes": {name: c.ram_bytes for name, c in self.costs.items()},
            "estimated_ms": {name: e.to_dict() for name, e in self.estimates.items()},
            "estimated_window_instructions": self.window_instructions,
            "targets": {name: c.to_dict() for name, c in self.costs.items()},
            "missing": {name: list(packages) for name, packages in self.missing.items()},
        }


def profile(
    folder: str | Path,
    targets: Sequence[str] = (),
    *,
    optimise: str = "-O2",
    progress: Callable[[int, int], None] | None = None,
) -> Profile:
    """Count what the C in an export folder costs. The folder is only read.

    Args:
        folder: made by ``plushsense export``.
        targets: names of `TARGETS`; without any, all that count instructions and are installed here.
        optimise: how the compilers are told to optimise.
        progress: called with targets done and targets in all.

    Raises:
        BadInput: when the folder is no export, or lacks something.
        ToolError: when a target that was asked for is not installed here, when none is, or when a compiler refuses
            what stands in the folder.
    """
    folder = Path(folder)
    facts = read_facts(folder)
    arch = _arch(folder, facts)
    wanted = list(dict.fromkeys(targets)) or [name for name, target in TARGETS.items() if target.counts]
    missing = {name: lacks for name in wanted if (lacks := missing_tools(target_named(name).name))}
    if targets:
        for name in missing:
            require(name)
    there = [name for name in wanted if name not in missing]
    if not there:
        packages = " ".join(dict.fromkeys(p for lacks in missing.values() for p in lacks))
        raise ToolError(
            "No emulator to count on is installed here: install Debian's "
            f"{packages} (or some of them), or give --target host for sizes on this computer only."
        )
    costs = {}
    for done, name in enumerate(there):
        if progress is not None:
            progress(done, len(there))
        costs[name] = count(folder, name, facts, optimise)
    if progress is not None:
        progress(len(there), len(there))
    estimates = {
        name: estimate(core, cost.step, cost.flash_bytes, arch.step, float(facts["step_ms"]))
        for name, core in CORES.items()
        if (cost := costs.get(core.target)) is not None and cost.step is not None
    }
    return Profile(facts, arch, optimise, costs, estimates, missing)


def _arch(folder: Path, facts: Mapping[str, Any]) -> Arch:
    try:
        return Arch.parse(
            facts["symbol"],
            facts["filters"],
            channels=len(facts["inputs"]),
            classes=facts["classes"],
            step=facts["step"],
            pool=facts["pool"],
            window=max(facts["span"], facts["step"]),
        )
    except (KeyError, TypeError):
        raise BadInput(f"The facts in '{folder}' do not describe a network: export the model again.") from None
