"""From what a form says to work for `Jobs`, and to the command that does the same."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.apps.config import RunConfig, from_settings
from plushsense.apps.studio.house import BUNDLES, House
from plushsense.apps.studio.jobs import RUNNING, Jobs
from plushsense.core.errors import ConfigError
from plushsense.dataset.store import HEAD
from plushsense.models.symbol import parse_symbol
from plushsense.scoring.splits import parse_split

TRAIN, EVALUATE, SWEEP, SEARCH = "train", "evaluate", "sweep", "search"
KINDS = (TRAIN, EVALUATE, SWEEP, SEARCH)
PAPER = "paper"
GRIDS = "grids"
SPLITS = ("leave-one-subject-out", "by-subject:5", "by-recording:5", "windows:5", "windows:holdout")

# Settings of train and evaluate that the form has, each an option of the command of the same name.
_SETTINGS = ("preset", "context", "arch", "filters", "padding", "norm", "classes", "epochs", "batch", "seed", "device")
_CHANGES = ("split", "epochs", "batches", "architectures", "filters", "padding", "context", "classes", "device")
_LIMITS = ("max_parameters", "max_state_bytes", "max_macs_per_step")


@dataclass(frozen=True)
class Order:
    """Work to be begun: ``task`` and ``spec`` for `Jobs.start`, its ``title``; ``command`` does the same in a shell."""

    task: str
    spec: dict[str, Any]
    title: str
    command: str

    @property
    def dry(self) -> dict[str, Any]:
        """The spec that only asks what it would take."""
        return {**self.spec, "dry": True}

    @property
    def key(self) -> str:
        """The same for the same work."""
        return json.dumps([self.task, {k: v for k, v in self.spec.items() if k != "out"}], sort_keys=True)


def grids(house: House) -> list[Path]:
    """Grids that somebody wrote: TOML files in the home folder, and in `GRIDS` there."""
    return sorted([*house.folder.glob("*.toml"), *(house.folder / GRIDS).glob("*.toml")])


def free_name(house: House, jobs: Jobs, wanted: str) -> str:
    """A name for a bundle that nothing has yet, nor will have once what runs is done."""
    coming = {Path(job.spec["out"]).stem for job in jobs.all(TRAIN) if job.state == RUNNING and "out" in job.spec}
    plain = "".join(c for c in wanted if c.isalnum() or c in " _-").strip()[:50] or "model"
    name, number = plain, 2
    while name in coming or (house.folder / BUNDLES / f"{name}.plush").exists():
        name, number = f"{plain} {number}", number + 1
    return name


def order(house: House, jobs: Jobs, form: Mapping[str, Any]) -> Order:
    """What a form asks for. Empty fields are not given, as options that are left out.

    Args:
        form: ``kind``, ``dataset``, and the fields of its kind by the names of the command's options.

    Raises:
        ConfigError: for a folder outside, a name that is taken, or settings that do not fit.
    """
    kind = form["kind"]
    if not form.get("dataset"):
        raise ConfigError("No data set is chosen: record one, or import recordings on the first page.")
    dataset = house.inside(form["dataset"])
    if not (dataset / HEAD).is_file():
        raise ConfigError(f"The data set '{dataset}' is no longer there: put it back, or choose another.")
    given = {key: value for key, value in form.items() if value not in (None, "")}
    if kind == TRAIN:
        made = _train(house, dataset, given)
    elif kind == EVALUATE:
        made = _evaluate(dataset, given)
    else:
        made = _of_grid(house, kind, dataset, given)
    for job in jobs.all(kind):
        if job.state == RUNNING and not job.spec.get("dry"):
            if job.spec.get("out", 0) == made.spec.get("out"):
                raise ConfigError(f"'{Path(made.spec['out']).stem}' is being trained right now: give another name.")
            if job.spec == made.spec:
                raise ConfigError("This very work is running already: it stands below.")
    return made


def _train(house: House, dataset: Path, given: Mapping[str, Any]) -> Order:
    settings = {key: given[key] for key in _SETTINGS if key in given}
    config = _checked(settings)
    out = house.new(BUNDLES, f"{str(given.get('name', '')).strip()}.plush")
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "out": str(out)}
    command = ["plushsense", "train", str(dataset), "--out", str(out), *_options(settings)]
    tuning = _whole("quantize_aware", given.get("quantize_aware", 0), 0)
    if tuning:
        spec["quantize_aware"] = tuning
        command += ["--quantize-aware", str(tuning)]
    if given.get("fit_decisions") is False:
        spec["fit_decisions"] = False
        command.append("--no-fit-decisions")
    title = f"{out.stem}: {house.title(dataset)}, {config.model.arch}, {config.windows.context}"
    return Order(TRAIN, spec, title, shlex.join(command))


def _evaluate(dataset: Path, given: Mapping[str, Any]) -> Order:
    settings = {key: given[key] for key in (*_SETTINGS, "train_context") if key in given}
    config = _checked(settings)
    split = str(given.get("split", config.evaluation.split))
    parse_split(split)
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "split": split}
    command = ["plushsense", "evaluate", str(dataset), "--split", split, *_options(settings)]
    if given.get("int8"):
        spec["int8"] = True
        command.append("--int8")
    title = f"{dataset.name}: {split}, {config.model.arch}, {config.windows.context}"
    return Order(EVALUATE, spec, title, shlex.join(command))


def _checked(settings: Mapping[str, Any]) -> RunConfig:
    config = from_settings(**settings)
    parse_symbol(config.model.arch)
    return config


def _of_grid(house: House, kind: str, dataset: Path, given: Mapping[str, Any]) -> Order:
    grid = str(given.get("grid", PAPER))
    if grid != PAPER:
        grid = str(house.inside(grid))
    changes: dict[str, Any] = {key: str(given[key]) for key in _CHANGES if key in given}
    command = ["plushsense", kind, str(dataset), "--grid", grid, *_options(changes)]
    if "seeds" in given:
        seeds = _whole("seeds", given["seeds"], 1)
        changes["seeds"] = list(range(seeds))
        command += ["--seeds", str(seeds)]
    spec: dict[str, Any] = {"dataset": str(dataset), "grid": grid, "changes": changes}
    if kind == SEARCH:
        asked: dict[str, Any] = {key: _whole(key, given[key], 1) for key in _LIMITS if key in given}
        if "share" in given:
            asked["share"] = _share(given["share"])
        spec["asked"] = asked
        command += _options(spec["asked"])
    name = PAPER if grid == PAPER else Path(grid).stem
    title = f"{dataset.name}: {name}" + (f", {given['split']}" if "split" in given else "")
    return Order(kind, spec, title, shlex.join(command))


def _whole(name: str, value: Any, least: int) -> int:
    """A whole number from ``least`` up, of a field that says nothing wrong to a library that takes only numbers."""
    if not isinstance(value, int) or value < least:
        raise ConfigError(f"{name} is {value!r}: accepted are whole numbers from {least} up.")
    return value


def _share(value: Any) -> float:
    try:
        share = float(str(value).replace(",", "."))
    except ValueError:
        share = 0.0
    if not 0.0 < share <= 1.0:
        raise ConfigError(f"share is {value!r}: accepted is above 0, up to 1.")
    return share


def _options(settings: Mapping[str, Any]) -> list[str]:
    return [word for key, value in settings.items() for word in (f"--{key.replace('_', '-')}", str(value))]
