"""What the export page knows without a browser: bundles in plain values, exports, what was found out about them."""

from __future__ import annotations

import hashlib
import importlib.util
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.apps.studio.house import EXPORTS, House
from plushsense.apps.studio.jobs import DONE, Job, Jobs
from plushsense.core.errors import PlushSenseError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.freshness import sha256_of
from plushsense.dataset.publish.archive import files_of
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.deploy.calibration import integer_model
from plushsense.deploy.convert import CONVERTERS
from plushsense.deploy.emit import FACTS, TOY_BYTES, read_facts
from plushsense.deploy.targets import TARGETS, missing_tools
from plushsense.models.bundle import Bundle

_NEEDS = {
    "onnx": ("onnx", ("onnx", "onnxruntime")),
    "tflite": ("tflite", ("ai_edge_litert", "flatbuffers")),
    "espdl": ("espdl", ("onnx", "esp_ppq", "torch")),
}
"""Formats by the first word of their names: the extra that brings them, and its modules."""


@dataclass(frozen=True)
class BundleFacts:
    """A bundle in plain values; ``problem``: why it cannot be read, ``cannot``: why it cannot be exported."""

    path: Path
    problem: str = ""
    cannot: str = ""
    title: str = ""
    padding: str = ""
    layout: str = ""
    gestures: tuple[str, ...] = ()
    dataset: str = ""
    people: int = 0
    simulated: bool = False
    adapted_to: str = ""
    scores: dict[str, Any] = field(default_factory=dict)
    bytes: int = 0

    @classmethod
    def of(cls, path: Path) -> BundleFacts:
        """Read it; a broken one becomes its ``problem``. Some milliseconds."""
        try:
            bundle = Bundle.load(path)
        except PlushSenseError as refusal:
            return cls(path, problem=str(refusal))
        try:
            integer_model(bundle)
            cannot = ""
        except PlushSenseError as refusal:
            cannot = str(refusal)
        origin = bundle.provenance
        people = origin.get("subjects")
        scores = origin.get("scores")
        return cls(
            path,
            cannot=cannot,
            title=bundle.arch.title,
            padding=bundle.arch.padding,
            layout=bundle.layout.name,
            gestures=tuple(bundle.gestures.labels),
            dataset=str(origin.get("dataset", "")),
            people=len(set(people) - {NOBODY, UNKNOWN_SUBJECT}) if isinstance(people, list) else int(people or 0),
            simulated=bool(origin.get("simulated", False)),
            adapted_to=bundle.adapted_to or "",
            scores=dict(scores) if isinstance(scores, dict) and "accuracy" in scores else {},
            bytes=path.stat().st_size,
        )


@dataclass(frozen=True)
class ExportFacts:
    """An export folder of the house; ``problem``: why it cannot be read. ``digest`` is `digest` of its files now."""

    folder: Path
    problem: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)
    digest: str = ""
    made_s: float = 0.0

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def flash_bytes(self) -> int:
        """The model's data; the code comes on top."""
        return int(self.facts["model_bytes"])

    @property
    def ram_bytes(self) -> int:
        """Of one toy, where pointers have 32 bits."""
        return int(self.facts["memory_bytes"]) + TOY_BYTES

    @classmethod
    def of(cls, folder: Path) -> ExportFacts:
        """Read it; a broken one becomes its ``problem``."""
        try:
            facts = read_facts(folder)
            files = {p.relative_to(folder).as_posix(): p.stat().st_size for p in files_of(folder)}
            return cls(folder, "", facts, files, digest(folder), (folder / FACTS).stat().st_mtime)
        except PlushSenseError as refusal:
            return cls(folder, problem=str(refusal))


def exports_of(house: House) -> list[Path]:
    """The export folders of the house, the newest first."""
    found = [p.parent for p in (house.folder / EXPORTS).glob(f"*/{FACTS}") if not p.parent.name.startswith(".")]
    return sorted(found, key=lambda p: -(p / FACTS).stat().st_mtime)


def digest(folder: Path) -> str:
    """One SHA-256 over all files of a folder with their names: whether it is still what was looked at."""
    total = hashlib.sha256()
    for path in files_of(folder):
        total.update(f"{path.relative_to(folder).as_posix()}\0{sha256_of(path)}\n".encode())
    return total.hexdigest()


def newest(jobs: Jobs, task: str, place: Path) -> Job | None:
    """The newest work of a task that was done on this place; its ``spec["place"]``."""
    return next((j for j in jobs.all(task) if j.state == DONE and j.spec.get("place") == str(place)), None)


def formats() -> dict[str, str]:
    """Every format for another runtime, and the extra that it lacks here; "": it can be written."""
    return {name: _lacks(name) for name in CONVERTERS}


def _lacks(name: str) -> str:
    extra, modules = _NEEDS[name.partition("-")[0]]
    return "" if all(importlib.util.find_spec(m) for m in modules) else extra


def targets() -> dict[str, list[str]]:
    """Every target of ``verify``, and the Debian packages that it lacks here. Runs compilers."""
    return {name: missing_tools(name) for name in TARGETS}
