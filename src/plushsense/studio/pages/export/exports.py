"""Read facts of bundles, export folders, formats and targets for the export page."""

from __future__ import annotations

import hashlib
import importlib.util
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.errors import PlushSenseError
from plushsense.core.sentences import Sentence
from plushsense.dataset.files import sha256_of
from plushsense.dataset.publishing.tables import list_package_files
from plushsense.deploy.code import FACTS, ModelFacts, read_facts
from plushsense.deploy.convert import CONVERTERS
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.targets import TARGETS, missing_tools
from plushsense.models.bundle import Bundle
from plushsense.studio.app.jobs import DONE, Jobs, StudioJob
from plushsense.studio.app.workspace import EXPORTS, Workspace

_NEEDS = {
    "onnx": ("onnx", ("onnx", "onnxruntime")),
    "tflite": ("tflite", ("ai_edge_litert", "flatbuffers")),
    "matlab": ("matlab", ("scipy",)),
}
"""The extra and the modules that an export format needs, by the first word of the format's name."""


def _note(error: PlushSenseError, reason: str, path: Path) -> Sentence:
    """Return the message of an error as a note; ``reason`` is that of an error without one."""
    return Sentence.of(error) if error.reason else Sentence(str(error), reason=reason, name=path.stem)


@dataclass(frozen=True)
class BundleFacts:
    """A bundle, with the reasons ``problem`` if it cannot be read, and ``cannot`` if it cannot be exported."""

    path: Path
    bundle: Bundle | None = None
    problem: Sentence | None = None
    cannot: Sentence | None = None
    bytes: int = 0

    @classmethod
    def of(cls, path: Path) -> BundleFacts:
        """Read a bundle; store an error as ``problem`` or ``cannot``."""
        try:
            bundle = Bundle.load(path)
        except PlushSenseError as refusal:
            return cls(path, problem=_note(refusal, "bundle_unreadable", path))
        cannot = None
        try:
            integer_model(bundle)
        except PlushSenseError as refusal:
            cannot = _note(refusal, "bundle_undeployable", path)
        return cls(path, bundle, cannot=cannot, bytes=path.stat().st_size)

    @property
    def simulated(self) -> bool:
        """True if the bundle was trained on simulated data."""
        return self.bundle is not None and bool(self.bundle.provenance.get("simulated", False))


@dataclass(frozen=True)
class ExportFacts:
    """Facts of an export folder.

    Attributes:
        problem: the reason if the folder cannot be read.
        files: size of each file in bytes.
        digest: hash of all files, see `folder_digest`.
    """

    folder: Path
    problem: Sentence | None = None
    facts: ModelFacts | None = None
    files: dict[str, int] = field(default_factory=dict)
    digest: str = ""
    made_s: float = 0.0

    @property
    def name(self) -> str:
        return self.folder.name

    @classmethod
    def of(cls, folder: Path) -> ExportFacts:
        """Read an export folder; store an error as ``problem``."""
        try:
            facts = read_facts(folder)
            files = {p.relative_to(folder).as_posix(): p.stat().st_size for p in list_package_files(folder)}
            return cls(folder, None, facts, files, folder_digest(folder), (folder / FACTS).stat().st_mtime)
        except PlushSenseError as refusal:
            return cls(folder, problem=_note(refusal, "export_damaged", folder))


def exports_of(workspace: Workspace) -> list[Path]:
    """List the export folders of a workspace, newest first."""
    folders = [p.parent for p in (workspace.folder / EXPORTS).glob(f"*/{FACTS}") if not p.parent.name.startswith(".")]
    return sorted(folders, key=lambda p: -(p / FACTS).stat().st_mtime)


def folder_digest(folder: Path) -> str:
    """Return a SHA-256 hash over the names and contents of all files in a folder."""
    total = hashlib.sha256()
    for path in list_package_files(folder):
        total.update(f"{path.relative_to(folder).as_posix()}\0{sha256_of(path)}\n".encode())
    return total.hexdigest()


def newest_job(jobs: Jobs, task: str, place: Path) -> StudioJob | None:
    """Return the newest successful job of a task whose ``spec["place"]`` is ``place``, or None."""
    return next((j for j in jobs.all(task) if j.state == DONE and j.spec.get("place") == str(place)), None)


def formats() -> dict[str, str]:
    """Map each export format to the extra that must be installed for it, or "" if nothing is missing."""
    missing = {}
    for name in CONVERTERS:
        extra, modules = _NEEDS[name.partition("-")[0]]
        missing[name] = "" if all(importlib.util.find_spec(m) for m in modules) else extra
    return missing


def targets() -> dict[str, list[str]]:
    """Map each target of ``verify`` to the Debian packages that are missing; this runs compilers."""
    return {name: missing_tools(name) for name in TARGETS}
