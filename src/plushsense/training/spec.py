"""Settings of a training run, and the presets of the paper and of this project."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from plushsense.core.errors import ConfigError, check_known
from plushsense.training.augment import parse_augmentation

DEVICES = ("auto", "cpu", "cuda")
STOP_ON = ("loss", "accuracy")

# Part of every training's id: raise it when the same settings train differently.
TRAINING_VERSION = 2

_ROTATION = "random-rotation"


def _at_least(name: str, value: object, low: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise ConfigError(f"{name} is {value!r}: accepted are whole numbers from {low} up.")


@dataclass(frozen=True)
class TrainSpec:
    """Settings of a training run: Adam with a stepwise falling learning rate, and when to stop.

    The learning rate is halved every ``halve_every`` epochs (None: constant). Training ends with the best weights
    after ``patience`` epochs without a better validation loss (``stop_on`` "accuracy": a better accuracy); None:
    all epochs, and the last weights.
    ``augment`` names the augmentations of the training windows (see `training.augment`).
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
    augment: tuple[str, ...] = ()
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
        for augmentation in self.augment:
            parse_augmentation(augmentation)
        check_known(self.device, DEVICES, "device to train on", ConfigError)
        check_known(self.stop_on, STOP_ON, "measure to stop on", ConfigError)

    def learning_rate_at(self, epoch: int) -> float:
        """Return the learning rate in an epoch, counted from 1."""
        halvings = 0 if self.halve_every is None else (epoch - 1) // self.halve_every
        return self.learning_rate * 0.5**halvings

    def changed(self, **changes: Any) -> TrainSpec:
        """Return a copy with some settings changed; ``turn_deg=45`` stands for ``augment=["random-rotation:45"]``."""
        if "turn_deg" in changes:
            if "augment" in changes:
                raise ConfigError(
                    'Both augment and turn_deg are set: write turn_deg as augment = ["random-rotation:45"].'
                )
            degrees = changes.pop("turn_deg")
            changes["augment"] = (f"{_ROTATION}:{degrees}",) if degrees else ()
        if "augment" in changes:
            changes["augment"] = tuple(changes["augment"])
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON.

        A list of at most a random rotation is written as ``turn_deg``, as earlier versions did: the identities of
        their trainings and evaluations stay valid.
        """
        given = [parse_augmentation(text) for text in self.augment]
        values: dict[str, Any] = {}
        for key, value in asdict(self).items():
            if key != "augment":
                values[key] = value
            elif [name for name, _ in given] in ([], [_ROTATION]):
                values["turn_deg"] = given[0][1] if given else 0.0
            else:
                values[key] = list(value)
        return values

    def key(self) -> dict[str, Any]:
        """Return everything that the outcome depends on: all settings, and the version of the code."""
        return {"version": TRAINING_VERSION} | self.to_dict()


# "search": paper, section 3.6.1; "loso": paper, section 4.4; "paper" is the same schedule, for the paper's own form
# of the network and of windows (see PADDING and CONTEXT). "people" is ours: with as few validation people as these
# data sets have, their loss is a poor judge of when to stop, so it runs to the end of a faster falling rate, and it
# turns vectors. Makeability, 5 folds by person, real context, one seed: 0.55 with early stopping, 0.63 without.
PRESETS: dict[str, TrainSpec] = {
    "search": TrainSpec(epochs=250, learning_rate=0.001, halve_every=None, patience=None),
    "loso": TrainSpec(),
    "people": TrainSpec(epochs=60, halve_every=15, patience=None, augment=("random-rotation:45",)),
    "paper": TrainSpec(),
}

# The padding of the network that a preset trains unless another is set.
PADDING: dict[str, str] = {"search": "stream", "loso": "stream", "people": "stream", "paper": "mirror"}

# The context of the windows that a preset trains on and is scored on unless another is set.
CONTEXT: dict[str, str] = {"search": "loop", "loso": "stream", "people": "stream", "paper": "loop"}


def preset(name: str, **changes: Any) -> TrainSpec:
    """Return the preset of a name with some settings changed; None keeps the preset's.

    Raises:
        ConfigError: for an unknown preset or setting, with the nearest known one.
    """
    check_known(name, PRESETS, "preset", ConfigError)
    known = [*(f.name for f in fields(TrainSpec)), "turn_deg"]
    for key in changes:
        check_known(key, known, "training setting", ConfigError)
    return PRESETS[name].changed(**{key: value for key, value in changes.items() if value is not None})
