"""Convert the form of the train page into jobs, and refuse what cannot be done, with the field that is wrong."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from plushsense.core.errors import ArchError, ConfigError
from plushsense.dataset.store import HEAD
from plushsense.models.arch import parse_filters, parse_symbol
from plushsense.scoring.splits import parse_split
from plushsense.studio.app.jobs import RUNNING, Jobs
from plushsense.studio.app.stored_results import ResultRow, trial_settings
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BUNDLES, EXPORTS, Workspace, plain_name
from plushsense.workflow.config import RunConfig, from_settings

MAKE, TRAIN, EVALUATE, SWEEP, SEARCH = "make", "train", "evaluate", "sweep", "search"
KINDS = (TRAIN, EVALUATE, SWEEP, SEARCH)
MINUTES = (1, 600)
"""Shortest and longest budget of *Make a network*."""
PAPER, PEOPLE = "paper", "people"
BUILT_IN = {SWEEP: PAPER, SEARCH: PEOPLE}
GRIDS = "grids"
SPLITS = ("leave-one-subject-out", "by-subject:5", "by-recording:5", "windows:5", "windows:holdout")

# Settings of `train` and `evaluate` in the form; the commands have options with the same names.
_SETTINGS = ("preset", "context", "arch", "filters", "padding", "norm", "classes", "epochs", "batch", "seed", "device")
_CHANGES = ("split", "epochs", "batches", "architectures", "filters", "padding", "context", "classes", "device")
# Whole numbers among the settings, and their smallest values.
_LEAST = {"epochs": 1, "batch": 2, "seed": 0}
_LIMITS = ("max_parameters", "max_state_bytes", "max_macs_per_step")


T = TypeVar("T")


@dataclass(frozen=True)
class JobRequest:
    """A job to start: the arguments of `Jobs.start` and the equivalent shell command."""

    task: str
    spec: dict[str, Any]
    title: str
    command: str

    @property
    def key(self) -> str:
        """Text that identifies the job; it is equal for jobs that differ only in the output file."""
        return json.dumps([self.task, {k: v for k, v in self.spec.items() if k != "out"}], sort_keys=True)


def grids(workspace: Workspace) -> list[Path]:
    """List the TOML files of grids in the studio's folder and in its subfolder `GRIDS`."""
    return sorted([*workspace.folder.glob("*.toml"), *(workspace.folder / GRIDS).glob("*.toml")])


def free_name(workspace: Workspace, jobs: Jobs, name: str) -> str:
    """Return a name for a bundle, based on ``name``, that no file and no running job uses."""
    reserved = {
        Path(job.spec["out"]).stem for job in jobs.all(MAKE, TRAIN) if job.state == RUNNING and "out" in job.spec
    }
    plain = "".join(c for c in name if c.isalnum() or c in " _-").strip()[:50] or "model"
    return workspace.free_name(BUNDLES, plain, ".plush", separator=" ", taken=reserved)


def job_request(workspace: Workspace, jobs: Jobs, form: Mapping[str, Any]) -> JobRequest:
    """Convert the fields of the form into a job; leave out empty fields.

    Args:
        form: ``kind``, ``dataset``, and the fields of that kind, named like the command-line options; for `MAKE` only
            ``minutes``.

    Raises:
        ConfigError: for a folder outside the studio, a name in use, invalid settings, or a job that is already running.
            Its value ``field`` names the field that is wrong.
    """
    kind = form["kind"]
    if not form.get("dataset"):
        raise ConfigError(
            "No data set is chosen. Record a session, or import recordings on the home page.", field="dataset"
        )
    dataset = workspace.inside(form["dataset"])
    if not (dataset / HEAD).is_file():
        raise ConfigError(
            "The data set “{name}” does not exist any more. Put it back, or choose another.",
            field="dataset",
            name=dataset.name,
        )
    given = {key: value for key, value in form.items() if value not in (None, "")}
    if kind == MAKE:
        request = _make(workspace, jobs, dataset, given)
    elif kind in (TRAIN, EVALUATE):
        request = {TRAIN: _train, EVALUATE: _evaluate}[kind](workspace, dataset, given)
    else:
        request = _of_grid(workspace, kind, dataset, given)
    for job in jobs.all(kind):
        if job.state == RUNNING and not job.spec.get("dry"):
            if job.spec.get("out", 0) == request.spec.get("out"):
                name = Path(request.spec["out"]).stem
                raise ConfigError("“{name}” is being trained now. Give another name.", field="name", name=name)
            if job.spec == request.spec or (kind == MAKE and job.spec["dataset"] == str(dataset)):
                raise ConfigError("The same job is running already: see the list of jobs below.")
    return request


def _make(workspace: Workspace, jobs: Jobs, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    minutes = _whole("minutes", given.get("minutes"), *MINUTES)
    name = free_name(workspace, jobs, workspace.title(dataset))
    out = workspace.new(BUNDLES, f"{name}.plush")
    return JobRequest(MAKE, {"dataset": str(dataset), "out": str(out), "minutes": minutes}, name, "")


def _train(workspace: Workspace, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    settings = {key: given[key] for key in _SETTINGS if key in given}
    config = _checked(settings)
    out = _at("name", lambda: workspace.new(BUNDLES, f"{str(given.get('name', '')).strip()}.plush"))
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "out": str(out)}
    command = ["plushsense", "train", str(dataset), "--out", str(out), *_options(settings)]
    tuning = _whole("quantize_aware", given.get("quantize_aware", 0), 0)
    if tuning:
        spec["quantize_aware"] = tuning
        command += ["--quantize-aware", str(tuning)]
    if given.get("fit_decisions") is False:
        spec["fit_decisions"] = False
        command.append("--no-fit-decisions")
    title = f"{out.stem}: {workspace.title(dataset)}" + (f", {config.model.arch}" if config.model.arch else "")
    return JobRequest(TRAIN, spec, title, shlex.join(command))


def _evaluate(workspace: Workspace, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    settings = {key: given[key] for key in (*_SETTINGS, "train_context") if key in given}
    config = _checked(settings)
    split = str(given.get("split", config.evaluation.split))
    parse_split(split)
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "split": split}
    command = ["plushsense", "evaluate", str(dataset), "--split", split, *_options(settings)]
    if given.get("int8"):
        spec["int8"] = True
        command.append("--int8")
    title = workspace.title(dataset) + (f", {config.model.arch}" if config.model.arch else "")
    return JobRequest(EVALUATE, spec, title, shlex.join(command))


def export_request(workspace: Workspace, jobs: Jobs, row: ResultRow) -> JobRequest:
    """Return the job that trains a network with the settings of an evaluation or a trial, and exports it."""
    name = free_name(workspace, jobs, workspace.title(Path(row.dataset)))
    settings = {"evaluation": str(row.proof)} if row.proof is not None else {"settings": trial_settings(row)}
    spec: dict[str, Any] = {
        "dataset": row.dataset,
        **settings,
        "out": str(workspace.new(BUNDLES, f"{name}.plush")),
        "place": str(workspace.new(EXPORTS, workspace.free_name(EXPORTS, plain_name(name, "export")))),
    }
    return JobRequest(TRAIN, spec, f"{name}: {workspace.title(Path(row.dataset))}, {row.network}", "")


def _at(field: str, check: Callable[[], T], template: str = "") -> T:
    """Return the result of ``check``; an error that it raises gets the field, and ``template`` if it has no values."""
    try:
        return check()
    except (ArchError, ConfigError) as error:
        template = template if template and not error.message.values else error.message.template
        raise ConfigError(template, **{**error.message.values, "field": field}) from error


_BAD: Texts = {
    "arch": "This is no network. Give the lengths of up to four kernels, such as 14d1_19d2_19d4.",
    "filters": "Give whole numbers separated by commas, one for each layer, such as 8,12,16.",
}


def _checked(settings: Mapping[str, Any]) -> RunConfig:
    for key, least in _LEAST.items():
        if key in settings:
            _whole(key, settings[key], least)
    for key, parse in (("arch", parse_symbol), ("filters", parse_filters)):
        if key in settings:
            _at(key, lambda key=key, parse=parse: parse(str(settings[key])), _BAD[key])  # type: ignore[misc]
    return from_settings(**settings)


def _of_grid(workspace: Workspace, kind: str, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    built_in = BUILT_IN[kind]
    grid = str(given.get("grid", built_in))
    if grid != built_in:
        grid = str(workspace.inside(grid))
    changes: dict[str, Any] = {key: str(given[key]) for key in _CHANGES if key in given}
    command = ["plushsense", "sweep", str(dataset), "--grid", grid, *_options(changes)]
    if "seeds" in given:
        seeds = _whole("seeds", given["seeds"], 1)
        changes["seeds"] = list(range(seeds))
        command += ["--seeds", str(seeds)]
    spec: dict[str, Any] = {"dataset": str(dataset), "grid": grid, "changes": changes}
    if kind == SEARCH:
        limits: dict[str, Any] = {key: _whole(key, given[key], 1) for key in _LIMITS if key in given}
        if "share" in given:
            limits["share"] = _share(given["share"])
        changes |= {**limits, "halving": True}
        command += ["--halving", *_options(limits)]
    name = grid if grid == built_in else Path(grid).stem
    title = f"{workspace.title(dataset)}: {name}"
    return JobRequest(kind, spec, title, shlex.join(command))


def _whole(name: str, value: Any, least: int, most: int = 1_000_000_000) -> int:
    """Return ``value`` if it is an integer from ``least`` to ``most``; otherwise raise ConfigError."""
    if not isinstance(value, int) or not least <= value <= most:
        raise ConfigError("Give a whole number from {least} to {most}.", field=name, least=least, most=most)
    return value


def _share(value: Any) -> float:
    try:
        share = float(str(value).replace(",", "."))
    except ValueError:
        share = 0.0
    if not 0.0 < share <= 1.0:
        raise ConfigError("Give a number above 0 and at most 1.", field="share")
    return share


def _options(settings: Mapping[str, Any]) -> list[str]:
    return [word for key, value in settings.items() for word in (f"--{key.replace('_', '-')}", str(value))]
