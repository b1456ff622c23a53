"""Settings of a training run, and the presets of the paper and of this project."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Required, TypedDict

from plushsense.core.errors import ConfigError, check_known, check_seed
from plushsense.training.augment import parse_augmentation

DEVICES = ("auto", "cpu", "cuda")
STOP_ON = ("loss", "accuracy")
SCALINGS = ("z-score", "none")

# Part of every training's id: increase it when the same settings give another result.
TRAINING_VERSION = 3

_ROTATION = "random-rotation"


def _at_least(name: str, value: object, low: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise ConfigError(f"{name} is {value!r}: accepted are whole numbers from {low} up.")


@dataclass(frozen=True)
class TrainSpec:
    """Settings of a training run: Adam with a stepwise falling learning rate, and when to stop.

    More than one thread rarely helps: a batch is divided among them in chunks of 64 windows, and PyTorch's own threads
    gain little on networks as small as these (on a busy machine a second one made an epoch 25 times slower). Train
    folds in parallel instead.

    Attributes:
        epochs: how often all training windows are read, at most (from 1; default: by the preset).
        batch: windows for each step of the optimiser (from 2; default: by the preset and the network).
        learning_rate: step size of the optimiser, Adam (above 0 to 1; default: by the preset).
        halve_every: epochs after which the learning rate is halved (from 1; default: by the preset).
        patience: training stops after this many epochs without a better result on the validation people, and the best
            weights are kept; without it, all epochs run and the last weights are kept (from 1; default: by the preset).
        stop_on: result that ``patience`` watches (one of `STOP_ON`).
        augment: changes of the training windows, each with its strength, such as ``random-rotation:45`` (degrees; the
            toy is held differently), ``random-tempo:0.3`` (faster or slower), ``random-warp:0.4`` (faster here, slower
            there), ``random-gain:0.3`` (stronger or weaker movement) and ``random-tilt:8`` (degrees; down is not
            exactly known) (default: by the preset).
        scaling: ``z-score`` scales each channel by its mean and standard deviation over the training windows; ``none``
            lets the network read values in the units of the layout, as in the authors' script (one of `SCALINGS`).
        weight_decay: factor of the L2 regularisation of all parameters but biases, added to the gradient as in MATLAB's
            ``trainnet``, whose default is 0.0001 (0 to 1).
        stride: samples between the positions of the pool that a step computes, at most: as many as the dilations of the
            network allow, each step beginning with another; not on a graphics card (from 1; default: by the preset).
        seed: number that all random choices of the training are drawn from (from 0).
        device: what computes; ``auto``: a graphics card with CUDA if there is one (one of `DEVICES`).
        threads: threads of the processor for one training (from 1).
    """

    epochs: int = 150
    batch: int = 64
    learning_rate: float = 0.003
    halve_every: int | None = 30
    patience: int | None = 10
    stop_on: str = "loss"
    augment: tuple[str, ...] = ()
    scaling: str = "z-score"
    weight_decay: float = 0.0
    stride: int = 1
    seed: int = 0
    device: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        _at_least("epochs", self.epochs, 1)
        _at_least("batch", self.batch, 2)
        _at_least("stride", self.stride, 1)
        _at_least("seed", self.seed, 0)
        check_seed(self.seed)
        _at_least("threads", self.threads, 1)
        for name in ("halve_every", "patience"):
            if getattr(self, name) is not None:
                _at_least(name, getattr(self, name), 1)
        if not 0.0 < self.learning_rate <= 1.0:
            raise ConfigError(f"learning_rate is {self.learning_rate}: accepted is above 0, up to 1.")
        if not 0.0 <= self.weight_decay <= 1.0:
            raise ConfigError(f"weight_decay is {self.weight_decay}: accepted is 0 to 1.")
        for augmentation in self.augment:
            parse_augmentation(augmentation)
        check_known(self.device, DEVICES, "device to train on", ConfigError)
        check_known(self.scaling, SCALINGS, "scaling of the inputs", ConfigError)
        check_known(self.stop_on, STOP_ON, "measure to stop on", ConfigError)

    def learning_rate_at(self, epoch: int) -> float:
        """Return the learning rate in an epoch, counted from 1."""
        halvings = 0 if self.halve_every is None else (epoch - 1) // self.halve_every
        return self.learning_rate * 0.5**halvings

    def with_epochs(self, epochs: int) -> TrainSpec:
        """Return a copy with other epochs, in which the learning rate falls in the same proportion."""
        every = self.halve_every
        scaled = None if every is None else max(1, round(every * epochs / self.epochs))
        return replace(self, epochs=epochs, halve_every=scaled)

    def continued(self) -> TrainSpec:
        """Return the schedule of a training that begins with the weights of an earlier one: a third of the epochs."""
        return self.with_epochs(-(-self.epochs // 3))

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

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON, without ``scaling``, ``weight_decay`` and ``stride`` at their default.

        ``augment`` with at most a random rotation is written as ``turn_deg``, as in earlier versions, so that the ids
        of their trainings and evaluations stay the same.
        """
        parsed = [parse_augmentation(text) for text in self.augment]
        values: dict[str, Any] = {}
        for key, value in asdict(self).items():
            if key in ("scaling", "weight_decay", "stride") and value == getattr(TrainSpec, key):
                continue
            if key != "augment":
                values[key] = value
            elif [name for name, _ in parsed] in ([], [_ROTATION]):
                values["turn_deg"] = parsed[0][1] if parsed else 0.0
            else:
                values[key] = list(value)
        return values

    def key(self) -> dict[str, object]:
        """Return everything that the result depends on: all settings, and the version of the code."""
        # Earlier versions read integers where nothing was scaled.
        reads = {"reads": "units of the layout"} if self.scaling == "none" else {}
        return {"version": TRAINING_VERSION} | self.to_dict() | reads


class EpochRow(TypedDict, total=False):
    """What one epoch of a training gave.

    ``train_loss`` and ``train_accuracy`` are means over the batches, measured while training; in fine-tuning, the loss
    is the Kullback-Leibler divergence from the float network. Figures of validation are over all its windows, or those
    of people (see `accuracy_over_people`); None without validation. ``accuracy`` is that of validation as the scores
    count it; ``what`` names a network other than the one that is scored.
    """

    epoch: Required[int]
    train_loss: Required[float]
    train_accuracy: float
    validation_loss: float | None
    validation_accuracy: float | None
    validation_accuracy_people: float | None
    learning_rate: float
    accuracy: float | None
    what: str


EpochProgress = Callable[[int, int, EpochRow], None]
"""Called with (epoch, maximum of epochs, row of the epoch)."""

# "search": paper, section 3.6.1; "loso": paper, section 4.4; "paper" is the same schedule, with the network and windows
# of the paper (see PADDING and CONTEXT). "people" is our own: with so few validation people, their loss does not tell
# when to stop, so it runs all epochs with a faster falling learning rate; and it rotates vectors. Accuracy on
# makeability, 5 folds by person, real context, one seed: 0.55 with early stopping, 0.63 without.
PRESETS: dict[str, TrainSpec] = {
    "search": TrainSpec(epochs=250, learning_rate=0.001, halve_every=None, patience=None),
    "loso": TrainSpec(),
    "people": TrainSpec(epochs=60, halve_every=15, patience=None, augment=("random-rotation:45",), stride=4),
    "paper": TrainSpec(),
}

# Settings of the preset "people" for a network with a vector layer, whose outputs a rotation does not change. Tempo and
# warp make up people who move at another pace, and with them more steps pay: docs/measurements/people.md, few people.
# Of every fourth position, the deviation of a pool of 26 steps is too coarse: 11 people were read 0.009 worse.
VECTOR_TRAINING: dict[str, Any] = {
    "augment": ("random-tempo:0.3", "random-warp:0.4", "random-gain:0.3", "random-tilt:8"),
    "batch": 32,
    "stride": 2,
}

# Epochs of presets for a network with a vector layer and windows cut anywhere in a stream. These overlap, so that an
# epoch passes each sample through the network about six times: twice as many epochs were no better, and a third fewer
# gave more false events (docs/measurements/fast-training.md). The stride is then that of the preset again.
ANYWHERE_EPOCHS: dict[str, int] = {"people": 30}

# Default padding of the network for each preset.
PADDING: dict[str, str] = {"search": "stream", "loso": "stream", "people": "stream", "paper": "mirror"}

# Default context of the windows to train on and to score for each preset.
CONTEXT: dict[str, str] = {"search": "loop", "loso": "stream", "people": "stream", "paper": "rows"}


def preset_for(name: str, has_vectors: bool) -> TrainSpec:
    """Return a preset as it trains a network with a vector layer, or one without."""
    return replace(PRESETS[name], **VECTOR_TRAINING) if has_vectors and name == "people" else PRESETS[name]


def preset(name: str, has_vectors: bool = False, **changes: Any) -> TrainSpec:
    """Return the preset of a name with some settings changed; None keeps the preset's.

    Raises:
        ConfigError: for an unknown preset or setting, with the nearest known one.
    """
    check_known(name, PRESETS, "preset", ConfigError)
    known = [*(f.name for f in fields(TrainSpec)), "turn_deg"]
    for key in changes:
        check_known(key, known, "training setting", ConfigError)
    usual = preset_for(name, has_vectors)
    return usual.changed(**{key: value for key, value in changes.items() if value is not None})
