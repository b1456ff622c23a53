"""Read facts of bundles, export folders, formats and targets for the export page."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.errors import PlushSenseError
from plushsense.core.sentences import Message
from plushsense.dataset.files import list_package_files
from plushsense.deploy.code import FACTS, ModelFacts, read_facts
from plushsense.deploy.convert import CONVERTERS
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.targets import TARGETS, missing_tools
from plushsense.models.bundle import Bundle
from plushsense.studio.app.jobs import DONE, Jobs, StudioJob
from plushsense.studio.app.workspace import EXPORTS, Workspace, folder_digest

_NEEDS = {
    "onnx": ("onnx", ("onnx", "onnxruntime")),
    "tflite": ("tflite", ("ai_edge_litert", "flatbuffers")),
    "matlab": ("matlab", ("scipy",)),
}
"""The extra and the modules that an export format needs, by the first word of the format's name."""


def _note(error: PlushSenseError, template: str, path: Path) -> Message:
    """Return the message of an error; ``template`` is used for one that is not made of a template."""
    return error.message if error.message.values else Message(template, name=path.stem)


@dataclass(frozen=True)
class BundleFacts:
    """A bundle, with the reasons ``problem`` if it cannot be read, and ``cannot`` if it cannot be exported."""

    path: Path
    bundle: Bundle | None = None
    problem: Message | None = None
    cannot: Message | None = None
    bytes: int = 0

    @classmethod
    def of(cls, path: Path) -> BundleFacts:
        """Read a bundle; store an error as ``problem`` or ``cannot``."""
        try:
            bundle = Bundle.load(path)
        except PlushSenseError as refusal:
            return cls(
                path,
                problem=_note(
                    refusal,
                    "The network “{name}” cannot be read: its file is damaged, or is none of PlushSense. Get another "
                    "copy, or train it again.",
                    path,
                ),
            )
        cannot = None
        try:
            integer_model(bundle)
        except PlushSenseError as refusal:
            cannot = _note(
                refusal, "The network “{name}” cannot run in a toy. Train it again with the default settings.", path
            )
        return cls(path, bundle, cannot=cannot, bytes=path.stat().st_size)

    @property
    def simulated(self) -> bool:
        """True if the bundle was trained on simulated data."""
        return self.bundle is not None and self.bundle.simulated


@dataclass(frozen=True)
class ExportFacts:
    """Facts of an export folder.

    Attributes:
        problem: the reason if the folder cannot be read.
        files: size of each file in bytes.
        digest: hash of all files, see `folder_digest`.
    """

    folder: Path
    problem: Message | None = None
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
            return cls(
                folder, problem=_note(refusal, "The export “{name}” is damaged. Export the network again.", folder)
            )


def exports_of(workspace: Workspace) -> list[Path]:
    """List the export folders of a workspace, newest first."""
    folders = [p.parent for p in (workspace.folder / EXPORTS).glob(f"*/{FACTS}") if not p.parent.name.startswith(".")]
    return sorted(folders, key=lambda p: -(p / FACTS).stat().st_mtime)


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
