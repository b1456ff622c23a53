"""Write the export folder: the C library, the model as C data, golden vectors, and facts about the model as JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.files import new_folder, read_bytes
from plushsense.core.templates import fill_text
from plushsense.deploy.golden import write_golden
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import HEAD_BYTES, IntegerModel, image_check, image_head, layout_check, memory_bytes

FACTS = "export.json"
IMAGE = "plush_model.bin"
BUNDLE = "model.plush"
LIBRARY = ("plushsense.h", "plushsense.c")
MODEL = ("plush_model.h", "plush_model.c")
GOLDEN = "golden"
MOST_FILE_BYTES = 16 << 20  # that are read of a file of an export, other than golden vectors
TOY_BYTES = 516  # size of a plush_toy with 32-bit pointers (a test compiles it)

Extra = Callable[[Path, dict[str, Any]], object]

_MOST_NAME = 10  # so that an Arduino library called NAME_plush has at most the 16 characters that arduino-lint accepts
_NAME = re.compile(r"(?!.*(?:arduino|library))[a-z][a-z0-9]*(?:_[a-z0-9]+)*")
# https://semver.org: what the manifests of Arduino, PlatformIO and ESP-IDF all accept.
_VERSION = re.compile(
    r"(0|[1-9][0-9]*)(\.(0|[1-9][0-9]*)){2}"
    r"(-(0|[1-9][0-9]*|[0-9]*[a-zA-Z-][0-9a-zA-Z-]*)(\.(0|[1-9][0-9]*|[0-9]*[a-zA-Z-][0-9a-zA-Z-]*))*)?"
)
_PAGE = re.compile(r"https?://[^\s\"'\\]+")
_HASH = re.compile(r"[0-9a-f]{16,64}")
# Identifiers and C files of the library and the model, but not the command `plushsense` or the file of the image.
_OWN = r"(?:(?:PLUSH|plush)_(?!model\.bin\b)\w|plushsense\.[ch]\b|PLUSHSENSE_H\b)"


@dataclass(frozen=True)
class ExportResult:
    """Result of an export; ``files`` are relative to ``folder``.

    ``flash_bytes`` is the size of the model, without the code (which ``plushsense profile`` measures); ``ram_bytes`` is
    the memory of one toy including its struct, with 32-bit pointers.
    """

    folder: Path
    files: tuple[str, ...]
    flash_bytes: int
    ram_bytes: int
    facts: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the object that ``plushsense export --json`` prints."""
        return {
            **{key: value for key, value in self.facts.items() if key != "files"},
            "folder": str(self.folder),
            "files": list(self.files),
            "flash_bytes": self.flash_bytes,
            "ram_bytes": self.ram_bytes,
        }


def emit(
    model: IntegerModel, bundle: Bundle, out: str | Path, extras: Sequence[Extra] = (), name: str = ""
) -> ExportResult:
    """Write an export folder atomically.

    Args:
        model: model for the toy, made from ``bundle``.
        bundle: also written to the folder (names, scores, float network), without the codes of the training people.
        out: a folder that does not exist yet, or is empty.
        extras: functions that add files to the finished folder (packages for build systems, other formats).
        name: prefix of all C names and C files (`prefixed`), so that several exports link into one program.

    Raises:
        BadInput: if the folder is not empty, or cannot be written.
        ConfigError: for a name that is not accepted.
    """
    check_name(name)
    out = Path(out)
    with new_folder(out, BadInput) as part:
        facts = _write(model, bundle, part, name)
        for extra in extras:
            extra(part, facts)
        files = sorted(p.relative_to(part).as_posix() for p in part.rglob("*") if p.is_file())
        facts["files"] = sorted({*files, FACTS})
        (part / FACTS).write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", "utf-8", newline="\n")
    return ExportResult(out, tuple(facts["files"]), facts["model_bytes"], facts["memory_bytes"] + TOY_BYTES, facts)


def read_facts(folder: str | Path) -> dict[str, Any]:
    """Read the facts of an export folder.

    Raises:
        BadInput: if the folder is no export, or its facts cannot be read.
    """
    path = Path(folder) / FACTS
    try:
        facts = json.loads(read_bytes(path, MOST_FILE_BYTES).decode())
        if not isinstance(facts, dict):
            raise TypeError("it holds no table")
        needed = {"title", "channels", "classes", "memory_bytes", "model_bytes"} - set(facts)
    except (FileNotFoundError, NotADirectoryError):
        problem = f"'{folder}' is no export" if Path(folder).exists() else f"There is no export '{folder}'"
        raise BadInput(
            "{problem}: make one with plushsense export BUNDLE OUT.", problem=problem, name=Path(folder).name
        ) from None
    except (OSError, ValueError, TypeError, RecursionError) as cause:
        raise BadInput(
            "'{path}' cannot be read ({cause}): export the model again.", path=path, cause=cause, name=Path(folder).name
        ) from None
    name = facts.get("name", "")
    if name and not _accepted(name):
        raise BadInput(
            "'{path}' has the name {file!r}, which no export has: export the model again.",
            path=path,
            file=name,
            name=Path(folder).name,
        )
    if needed:
        raise BadInput(
            "'{path}' lacks {needed}: export the model again.",
            path=path,
            needed=", ".join(sorted(needed)),
            name=Path(folder).name,
        )
    return dict(facts)


def check_name(name: str) -> None:
    """Check the name of an export; the empty one stands for none.

    Raises:
        ConfigError: for a name that is not accepted.
    """
    if name and not _accepted(name):
        raise ConfigError(
            f"'{name}' cannot be the name of an export: accepted are up to {_MOST_NAME} lower-case letters, digits and "
            "single underscores between them, a letter first, without the words arduino and library."
        )


def check_page(url: object) -> None:
    """Check the address of the web page of a model; raise ConfigError for one that is not accepted."""
    if not isinstance(url, str) or not _PAGE.fullmatch(url):
        raise ConfigError(f"'{url}' is no address of a web page: accepted is one that begins with http:// or https://.")


def check_model_version(version: str) -> None:
    """Check a version of a model; raise ConfigError for one that is not accepted."""
    if not _VERSION.fullmatch(version):
        raise ConfigError(
            f"'{version}' is no version of a model: accepted are three numbers, as 1.2.0, and after a hyphen a "
            "pre-release, as 1.2.0-beta.1 (semver.org)."
        )


def _accepted(name: object) -> bool:
    return isinstance(name, str) and len(name) <= _MOST_NAME and _NAME.fullmatch(name) is not None


def prefixed(text: str, name: str) -> str:
    """Put the name of an export before all of its C names and C files in a text.

    ``left`` gives ``left_plush_push``, ``LEFT_PLUSH_OK`` and ``left_plushsense.h``. Macros and include guards are
    included. An empty name changes nothing.
    """
    if not name:
        return text
    return re.sub(rf"(?<!\w){_OWN}", lambda m: f"{name.upper() if m[0][0] == 'P' else name}_{m[0]}", text)


def without_prefix(text: bytes, name: str) -> bytes:
    """Undo `prefixed` for the bytes of a file."""
    if not name:
        return text
    return re.sub(rf"(?<!\w)(?:{name}|{name.upper()})_(?={_OWN})".encode(), b"", text)


def _write(model: IntegerModel, bundle: Bundle, folder: Path, name: str) -> dict[str, Any]:
    bundle = bundle.without_people()
    code = code_files(model, bundle)
    for file, content in code.items():
        plain = content if file == IMAGE else prefixed(content.decode(), name).encode()
        (folder / prefixed(file, name)).write_bytes(plain)
    facts = facts_of(model, bundle, code[IMAGE]) | ({"name": name} if name else {})
    bundle.save(folder / BUNDLE)
    write_golden(model, bundle.scaler, folder / GOLDEN)
    return facts


def code_files(model: IntegerModel, bundle: Bundle) -> dict[str, bytes]:
    """Return the contents of the C and model files of an export without a name, by file name.

    A program is compiled from these files only. They depend only on the model and on names in the bundle, so that they
    can be compared with the files of an export of unknown origin.
    """
    image = model.to_bytes()
    facts = facts_of(model, bundle, image)
    return {
        **{name: library_text(name, calibrate=bool(model.layout.self_calibration)).encode() for name in LIBRARY},
        MODEL[0]: _header(facts).encode(),
        MODEL[1]: _source(model, facts["title"]).encode(),
        IMAGE: image,
    }


def library_text(name: str, *, calibrate: bool = False) -> str:
    """Return a file of the C library; ``calibrate``: with the code for sensors that calibrate themselves."""
    text = (files("plushsense.deploy") / "c" / name).read_text(encoding="utf-8")
    parts = r"#ifdef PLUSH_CALIBRATE\b[^\n]*\n(.*?)(?:#else\n(.*?))?#endif /\* PLUSH_CALIBRATE \*/\n"
    return re.sub(parts, lambda found: (found[1] if calibrate else found[2]) or "", text, flags=re.S)


def facts_of(model: IntegerModel, bundle: Bundle, image: bytes) -> dict[str, Any]:
    """Return the facts about a model that ``export.json`` holds, without the name, page and files of an export."""
    arch, layout = model.network.arch, model.layout
    code_version = version("plushsense")
    # Provenance may come from elsewhere, and goes into C.
    model_version, training = (str(bundle.provenance.get(key, "")) for key in ("model_version", "dataset_hash"))
    names = c_names(model.gestures.labels)
    return {
        "title": arch.title,
        "symbol": arch.symbol,
        "filters": list(arch.filters),
        "layout": layout.name,
        "layout_check": layout_check(layout),
        "channels": [{"name": c.name, "unit": c.unit} for c in layout.channels],
        "inputs": list(layout.inputs),
        "classes": arch.classes,
        "gestures": [
            {"label": g.label, "affect": g.affect, "c_name": name}
            for g, name in zip(model.gestures.gestures, names, strict=True)
        ],
        "step": arch.step,
        "step_ms": arch.step * layout.period_us / 1000,
        "span": arch.span,
        "receptive_field": arch.receptive_field,
        "pool": arch.pooled,
        "period_us": layout.period_us,
        "rate_hz": layout.rate_hz,
        "gap_ms": layout.gap_ms,
        "smoothing": model.smoothing,
        "parameters": arch.parameters,
        "macs_per_step": arch.macs_per_step,
        "macs_per_window": arch.macs_per_window,
        "padding": arch.padding,
        "model_bytes": len(image),
        "model_id": image_check(image),
        "model_version": model_version if _VERSION.fullmatch(model_version) else code_version,
        "training": training if _HASH.fullmatch(training) else "",
        "memory_bytes": memory_bytes(model),
        "simulated": bool(bundle.provenance.get("simulated", False)),
        "provenance": bundle.provenance,
        **({"personal": bundle.personal} if bundle.personal else {}),
        "code_version": code_version,
    }


def c_names(labels: Sequence[str]) -> tuple[str, ...]:
    """Convert labels to unique suffixes of C identifiers: ``Back stroke 1`` becomes ``BACK_STROKE_1``."""
    suffixes: list[str] = []
    for label in labels:
        plain = "".join(c if c.isascii() and c.isalnum() else " " for c in label)
        name = "_".join(plain.upper().split()) or "GESTURE"
        number, free = 2, name
        while free in suffixes:
            number, free = number + 1, f"{name}_{number}"
        suffixes.append(free)
    return tuple(suffixes)


def _header(facts: Mapping[str, Any]) -> str:
    channels = facts["channels"]
    names = c_names([c["name"] for c in channels])
    return fill_text(
        "plushsense.deploy",
        "templates/plush_model.h.j2",
        facts=facts,
        channels=list(zip(names, channels, strict=True)),
    )


def _source(model: IntegerModel, title: str) -> str:
    sections = model.sections()
    head = image_head(b"".join(data for _, data in sections), version=model.image_version)
    description = f"head: PLSH, version, bytes, CRC-32 of what follows ({HEAD_BYTES} bytes)"
    return fill_text(
        "plushsense.deploy",
        "templates/plush_model.c.j2",
        title=title,
        image=IMAGE,
        sections=[(description, head), *sections],
    )
