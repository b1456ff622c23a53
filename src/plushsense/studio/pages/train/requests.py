"""Conversion of the training form into a job and into the equivalent shell command."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.dataset.store import HEAD
from plushsense.models.arch import parse_symbol
from plushsense.scoring.splits import parse_split
from plushsense.studio.app.jobs import RUNNING, Jobs
from plushsense.studio.app.workspace import BUNDLES, Workspace
from plushsense.workflow.config import RunConfig, from_settings

TRAIN, EVALUATE, SWEEP, SEARCH = "train", "evaluate", "sweep", "search"
KINDS = (TRAIN, EVALUATE, SWEEP, SEARCH)
PAPER = "paper"
GRIDS = "grids"
SPLITS = ("leave-one-subject-out", "by-subject:5", "by-recording:5", "windows:5", "windows:holdout")

# Settings of `train` and `evaluate` in the form; each is an option of the command of the same name.
_SETTINGS = ("preset", "context", "arch", "filters", "padding", "norm", "classes", "epochs", "batch", "seed", "device")
_CHANGES = ("split", "epochs", "batches", "architectures", "filters", "padding", "context", "classes", "device")
_LIMITS = ("max_parameters", "max_state_bytes", "max_macs_per_step")


@dataclass(frozen=True)
class JobRequest:
    """A job to start: ``task`` and ``spec`` for `Jobs.start`, its title, and the equivalent shell command."""

    task: str
    spec: dict[str, Any]
    title: str
    command: str

    @property
    def dry(self) -> dict[str, Any]:
        """Spec that only estimates the cost."""
        return {**self.spec, "dry": True}

    @property
    def key(self) -> str:
        """Text that is equal for equal jobs."""
        return json.dumps([self.task, {k: v for k, v in self.spec.items() if k != "out"}], sort_keys=True)


def grids(workspace: Workspace) -> list[Path]:
    """List the TOML files with grids in the home folder and in its `GRIDS` folder."""
    return sorted([*workspace.folder.glob("*.toml"), *(workspace.folder / GRIDS).glob("*.toml")])


def free_name(workspace: Workspace, jobs: Jobs, wanted: str) -> str:
    """Return a name for a bundle that neither a file nor a running job uses."""
    coming = {Path(job.spec["out"]).stem for job in jobs.all(TRAIN) if job.state == RUNNING and "out" in job.spec}
    plain = "".join(c for c in wanted if c.isalnum() or c in " _-").strip()[:50] or "model"
    name, number = plain, 2
    while name in coming or (workspace.folder / BUNDLES / f"{name}.plush").exists():
        name, number = f"{plain} {number}", number + 1
    return name


def job_request(workspace: Workspace, jobs: Jobs, form: Mapping[str, Any]) -> JobRequest:
    """Convert the fields of the form into a job; empty fields are left out.

    Args:
        form: ``kind``, ``dataset``, and the fields of that kind under the names of the command-line options.

    Raises:
        ConfigError: for a folder outside the studio, a name in use, or invalid settings.
    """
    kind = form["kind"]
    if not form.get("dataset"):
        raise ConfigError("No data set is chosen: record one, or import recordings on the first page.")
    dataset = workspace.inside(form["dataset"])
    if not (dataset / HEAD).is_file():
        raise ConfigError(f"The data set '{dataset}' is no longer there: put it back, or choose another.")
    given = {key: value for key, value in form.items() if value not in (None, "")}
    if kind == TRAIN:
        made = _train(workspace, dataset, given)
    elif kind == EVALUATE:
        made = _evaluate(dataset, given)
    else:
        made = _of_grid(workspace, kind, dataset, given)
    for job in jobs.all(kind):
        if job.state == RUNNING and not job.spec.get("dry"):
            if job.spec.get("out", 0) == made.spec.get("out"):
                raise ConfigError(f"'{Path(made.spec['out']).stem}' is being trained right now: give another name.")
            if job.spec == made.spec:
                raise ConfigError("This very work is running already: it stands below.")
    return made


def _train(workspace: Workspace, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    settings = {key: given[key] for key in _SETTINGS if key in given}
    config = _checked(settings)
    out = workspace.new(BUNDLES, f"{str(given.get('name', '')).strip()}.plush")
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "out": str(out)}
    command = ["plushsense", "train", str(dataset), "--out", str(out), *_options(settings)]
    tuning = _whole("quantize_aware", given.get("quantize_aware", 0), 0)
    if tuning:
        spec["quantize_aware"] = tuning
        command += ["--quantize-aware", str(tuning)]
    if given.get("fit_decisions") is False:
        spec["fit_decisions"] = False
        command.append("--no-fit-decisions")
    title = f"{out.stem}: {workspace.title(dataset)}, {config.model.arch}, {config.windows.context}"
    return JobRequest(TRAIN, spec, title, shlex.join(command))


def _evaluate(dataset: Path, given: Mapping[str, Any]) -> JobRequest:
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
    return JobRequest(EVALUATE, spec, title, shlex.join(command))


def _checked(settings: Mapping[str, Any]) -> RunConfig:
    config = from_settings(**settings)
    parse_symbol(config.model.arch)
    return config


def _of_grid(workspace: Workspace, kind: str, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    grid = str(given.get("grid", PAPER))
    if grid != PAPER:
        grid = str(workspace.inside(grid))
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
    return JobRequest(kind, spec, title, shlex.join(command))


def _whole(name: str, value: Any, least: int) -> int:
    """Return the value if it is a whole number of at least ``least``; raise ConfigError otherwise."""
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
