"""Write the export folder: C library, model, golden vectors, packages, files for other runtimes, and facts as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.files import new_folder
from plushsense.deploy.code import (
    BUNDLE,
    FACTS,
    GOLDEN,
    IMAGE,
    ConversionFacts,
    ModelFacts,
    check_names,
    code_files,
    facts_of,
)
from plushsense.deploy.convert import CONVERTERS, convert
from plushsense.deploy.golden import write_golden
from plushsense.deploy.package import export_files
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import IntegerModel


@dataclass(frozen=True)
class ExportResult:
    """Result of an export; ``files`` are relative to ``folder``, the sizes as in `ModelFacts`."""

    folder: Path
    facts: ModelFacts

    @property
    def files(self) -> tuple[str, ...]:
        return self.facts.files

    @property
    def flash_bytes(self) -> int:
        return self.facts.flash_bytes

    @property
    def ram_bytes(self) -> int:
        return self.facts.ram_bytes

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``plushsense export --json`` prints."""
        facts = self.facts.to_json()
        del facts["files"]
        sizes = {"flash_bytes": self.flash_bytes, "ram_bytes": self.ram_bytes}
        return {**facts, "folder": str(self.folder), "files": list(self.files), **sizes}


def emit(
    model: IntegerModel,
    bundle: Bundle,
    out: Path,
    *,
    name: str = "",
    url: str = "",
    also: Sequence[str] = (),
    windows: NDArray[Any] | None = None,
) -> ExportResult:
    """Write an export folder atomically.

    Args:
        model: model for the toy, made from ``bundle``.
        bundle: also written to the folder (names, scores, float network), without the codes of the training people.
        out: a folder that does not exist yet, or is empty.
        name: prefix of all C names and C files (`plushsense.deploy.code.prefixed`), so that several exports link into
            one program.
        url: web page of the model, for the manifests.
        also: formats for other runtimes (`plushsense.deploy.convert.CONVERTERS`).
        windows: integer windows (N, C, T) to test the converted files with.

    Raises:
        BadInput: if the folder is not empty, or cannot be written.
        ConfigError: for a name or address that is not accepted.
        ArchError, BundleError, MissingExtraError: as `plushsense.deploy.convert.convert`.
        LayoutError: for a layout with values that the toy's line format cannot represent.
    """
    check_names(name, url=url)
    bundle = bundle.without_people()
    code = code_files(model, bundle)
    with new_folder(out, BadInput) as part:
        conversions = {}
        for other in dict.fromkeys(also):
            done = convert(bundle, part / CONVERTERS[other].file_name, other, windows=windows)
            conversions[other] = ConversionFacts(done.path.name, done.bytes, done.largest_difference, done.notes)
        facts = replace(facts_of(model, bundle, code[IMAGE]), name=name, url=url, conversions=conversions)
        for file, content in export_files(bundle, facts, code).items():
            (part / file).parent.mkdir(parents=True, exist_ok=True)
            (part / file).write_bytes(content)
        bundle.save(part / BUNDLE)
        write_golden(model, bundle.scaler, part / GOLDEN)
        files = {p.relative_to(part).as_posix() for p in part.rglob("*") if p.is_file()}
        facts = replace(facts, files=tuple(sorted({*files, FACTS})))
        text = json.dumps(facts.to_json(), indent=1, ensure_ascii=False)
        (part / FACTS).write_text(text + "\n", "utf-8", newline="\n")
    return ExportResult(out, facts)
