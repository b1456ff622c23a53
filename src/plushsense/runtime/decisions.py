"""Settings of decisions: in seconds and probabilities for a bundle, in steps and integers for a toy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from plushsense.core.errors import BundleError, ConfigError
from plushsense.core.toml import load_table
from plushsense.runtime.events import MOST_STEPS, NO_GESTURE, ONE, EventSettings
from plushsense.runtime.fixed import LOGIT_LIMIT
from plushsense.runtime.gate import GateSettings
from plushsense.runtime.health import HealthSettings


@dataclass(frozen=True)
class Rules:
    """Settings of a deployed toy apart from its network; the defaults report the best class of every step."""

    events: EventSettings = field(default_factory=EventSettings)
    gate: GateSettings = field(default_factory=GateSettings)
    health: HealthSettings = field(default_factory=lambda: HealthSettings(fault_ms=0))

    def check(self, channels: int, inputs: int, classes: int) -> None:
        """Raise BundleError for settings that name a measured channel, an input or a class that the model lacks."""
        if self.health.low and len(self.health.low) != channels:
            raise BundleError(
                f"The health limits are of {len(self.health.low)} channels, the layout has {channels}: train again."
            )
        if any(i >= inputs for s in self.gate.signals for i in s.inputs):
            raise BundleError(f"The gate reads an unknown input: the model has {inputs}; train again.")
        if any(classes <= r.gesture != NO_GESTURE for r in self.gate.rules):
            raise BundleError(f"The gate reports an unknown gesture: the model has {classes}; train again.")


_SHARES = ("enter", "leave", "enter_affect", "leave_affect", "sure")
_SECONDS = ("smoothing_s", "least_s", "switch_s", "end_s", "hold_s", "rest_s", "wait_s")


@dataclass(frozen=True)
class DecideSpec:
    """Settings of decisions; `plushsense.runtime.events` describes their effects. Durations are in seconds.

    Attributes:
        smoothing_s: time constant of the exponential mean of the probabilities, after which the mean has followed 63 %
            of a change; 0 means no smoothing (0 to 60).
        enter: smoothed probability from which a gesture may begin (0 to 1).
        leave: smoothed probability below which it may end (0 to 1).
        enter_affect: smoothed probability of an affect, the sum over its gestures, from which an event may begin before
            its gesture is clear; above 1, none does (0 to 2).
        leave_affect: smoothed probability of an affect below which such an event may end (0 to 1).
        sure: smoothed probability from which a class is among the plausible ones of a step, its conformal set (0 to 1).
        known_margin: how far the best gesture must stand above the third best, in logits, for a touch to be a known
            gesture (0 to 64; default: every touch is one).
        least_s: how long a gesture or affect must be the candidate before its event begins (0 to 60).
        switch_s: how long another candidate must last before it ends the event and begins the next one (0 to 60).
        end_s: how long the gesture or affect must be below its threshold before the event ends (0 to 60).
        hold_s: minimum duration of an event (0 to 60).
        rest_s: minimum time after an event until the next begins, the refractory time (0 to 60).
        wait_s: how long an event of the gate waits for the network to name a gesture (0 to 60).
        gate: threshold rules that detect abrupt gestures before the network does; without rules there is no gate.
        health: settings for detecting suspect and faulty sensors.
        fitted: description of the data on which the settings were fitted, for people to read; it has no effect.
    """

    smoothing_s: float = 0.3
    enter: float = 0.6
    leave: float = 0.3
    enter_affect: float = 0.8
    leave_affect: float = 0.4
    sure: float = 0.5
    known_margin: float | None = None
    least_s: float = 0.1
    switch_s: float = 0.3
    end_s: float = 0.3
    hold_s: float = 0.2
    rest_s: float = 0.2
    wait_s: float = 1.5
    gate: GateSettings = field(default_factory=GateSettings)
    health: HealthSettings = field(default_factory=HealthSettings)
    fitted: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in _SECONDS:
            if not _number(value := getattr(self, name)) or not 0.0 <= value <= 60.0:
                off = " (off)" if name == "smoothing_s" else ""
                raise ConfigError(f"{name} is {value!r}; accepted are 0{off} to 60 seconds.")
        for name in _SHARES:
            most = 2.0 if name == "enter_affect" else 1.0
            if not _number(value := getattr(self, name)) or not 0.0 <= value <= most:
                raise ConfigError(f"{name} is {value!r}; accepted are probabilities, 0 to 1.")
        margin, most = self.known_margin, LOGIT_LIMIT / 256
        if margin is not None and (not _number(margin) or not 0.0 <= margin <= most):
            raise ConfigError(f"known_margin is {margin!r}; accepted are logits from 0 to {most:g}, or none.")

    def rules(self, step_s: float) -> Rules:
        """Convert the settings to integers, and durations to steps of ``step_s`` seconds."""
        shares = {name: min(round(getattr(self, name) * ONE), ONE + 1) for name in _SHARES}

        def steps(seconds: float, least: int = 0) -> int:
            return min(max(least, round(seconds / step_s)), MOST_STEPS)

        return Rules(
            EventSettings(
                **shares,
                known=-LOGIT_LIMIT if self.known_margin is None else round(self.known_margin * 256),
                least=steps(self.least_s, 1),
                switch=steps(self.switch_s, 1),
                end=steps(self.end_s, 1),
                hold=steps(self.hold_s),
                rest=steps(self.rest_s),
                wait=steps(self.wait_s),
            ),
            self.gate,
            self.health,
        )

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> DecideSpec:
        """Create settings from plain values, as in a bundle or a configuration file; missing keys get defaults.

        Bundles of earlier versions have a ``known``, a threshold of the highest logit, which is ignored.

        Raises:
            ConfigError: for an unknown key, or a value of the wrong type or out of range.
        """
        table = {key: value for key, value in table.items() if key != "known"}
        return load_table(table, cls, "decision settings", ConfigError)


def argmax_spec(smoothing_s: float = 0.0) -> DecideSpec:
    """Return settings that report the best class of every step: a baseline to compare events with."""
    return DecideSpec(
        smoothing_s, 0.0, 0.0, 2.0, 0.0, least_s=0.0, switch_s=0.0, end_s=0.0, hold_s=0.0, rest_s=0.0, wait_s=0.0
    )


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
