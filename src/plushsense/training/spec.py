"""How a network is trained: the schedule, and the presets that the paper and this project use."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from plushsense.core.errors import ConfigError, nearest

DEVICES = ("auto", "cpu", "cuda")
STOP_ON = ("loss", "accuracy")

# Part of every journalled training: raise it when the same settings would train differently.
TRAINING_VERSION = 2


def _one_of(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigError(f"Unknown {what} '{value}': accepted are {', '.join(known)}.{nearest(value, known)}")


def _at_least(name: str, value: object, low: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise ConfigError(f"{name} is {value!r}: accepted are whole numbers from {low} up.")


@dataclass(frozen=True)
class TrainSpec:
    """Adam with a stepwise falling rate, and when to stop.

    ``halve_every`` epochs the rate is halved (None: constant). ``patience`` is the number of epochs without a better
    validation loss (``stop_on`` "accuracy": a better accuracy) after which training ends with the best weights
    (None: all epochs, and the last weights).
    ``turn_deg`` turns the vectors of training windows at random (see `training.augment`).
    ``device`` "auto" takes CUDA where it is available. ``threads`` on the CPU: those of ``training/fast`` share the
    chunks of 64 windows of a batch, so that a batch of 64 keeps one busy; PyTorch's own gain little on networks as
    small as these, and on a busy machine a second one made an epoch 25 times slower. Run folds side by side.
    """

    epochs: int = 150
    batch: int = 64
    learning_rate: float = 0.003
    halve_every: int | None = 30
    patience: int | None = 10
    stop_on: str = "loss"
    turn_deg: float = 0.0
    seed: int = 0
    device: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        _at_least("epochs", self.epochs, 1)
        _at_least("batch", self.batch, 2)
        _at_least("seed", self.seed, 0)
        _at_least("threads", self.threads, 1)
        for name in ("halve_every", "patience"):
            if getattr(self, name) is not None:
                _at_least(name, getattr(self, name), 1)
        if not 0.0 < self.learning_rate <= 1.0:
            raise ConfigError(f"learning_rate is {self.learning_rate}: accepted is above 0, up to 1.")
        if not 0.0 <= self.turn_deg <= 180.0:
            raise ConfigError(f"turn_deg is {self.turn_deg}: accepted are 0 (off) to 180 degrees.")
        _one_of("device to train on", self.device, DEVICES)
        _one_of("measure to stop on", self.stop_on, STOP_ON)

    def learning_rate_at(self, epoch: int) -> float:
        """The rate in an epoch, counted from 1."""
        halvings = 0 if self.halve_every is None else (epoch - 1) // self.halve_every
        return self.learning_rate * 0.5**halvings

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    def key(self) -> dict[str, Any]:
        """What the outcome depends on, to the last bit: all settings, and the code's version."""
        return {"version": TRAINING_VERSION} | asdict(self)


# "search": paper, section 3.6.1; "loso": paper, section 4.4; "paper" is the same schedule, for the paper's own form
# of the network and of windows (see PADDING and CONTEXT). "people" is ours: with as few validation people as these
# data sets have, their loss is a poor judge of when to stop, so it runs to the end of a faster falling rate, and it
# turns vectors. Makeability, 5 folds by person, real context, one seed: 0.55 with early stopping, 0.63 without.
PRESETS: dict[str, TrainSpec] = {
    "search": TrainSpec(epochs=250, learning_rate=0.001, halve_every=None, patience=None),
    "loso": TrainSpec(),
    "people": TrainSpec(epochs=60, halve_every=15, patience=None, turn_deg=45.0),
    "paper": TrainSpec(),
}

# The padding of the network that a preset trains unless another is asked for.
PADDING: dict[str, str] = {"search": "stream", "loso": "stream", "people": "stream", "paper": "mirror"}

# The context of the windows that a preset trains on and is scored on unless another is asked for.
CONTEXT: dict[str, str] = {"search": "loop", "loso": "stream", "people": "stream", "paper": "loop"}


def preset(name: str, **changes: Any) -> TrainSpec:
    """The preset of a name, with some settings changed; a change of None for a number keeps the preset's.

    Raises:
        ConfigError: for an unknown preset or setting, with the nearest known one.
    """
    if name not in PRESETS:
        raise ConfigError(f"Unknown preset '{name}': accepted are {', '.join(PRESETS)}.{nearest(name, PRESETS)}")
    known = [f.name for f in fields(TrainSpec)]
    for key in changes:
        if key not in known:
            raise ConfigError(
                f"Unknown training setting '{key}': accepted are {', '.join(known)}.{nearest(key, known)}"
            )
    return replace(PRESETS[name], **{key: value for key, value in changes.items() if value is not None})
