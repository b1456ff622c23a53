"""Make the code of an export: the C library, the model as C data, the names in them, and facts about the model."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.files import read_bytes
from plushsense.core.layouts import Layout
from plushsense.core.sentences import join_names
from plushsense.core.templates import fill_text
from plushsense.core.toml import load_table
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import HEAD_BYTES, IntegerModel, image_check, image_head, layout_check, memory_bytes

IMAGE = "plush_model.bin"
BUNDLE = "model.plush"
LIBRARY = ("plushsense.h", "plushsense.c")
CALIBRATE = "plush_calibrate.h"  # also of the library, for a model with sensors that calibrate themselves
MODEL = ("plush_model.h", "plush_model.c")
GOLDEN = "golden"
FACTS = "export.json"
MOST_FILE_BYTES = 16 << 20  # that are read of a file of an export, other than golden vectors
TOY_BYTES = 488  # size of a plush_toy with 32-bit pointers (a test compiles it)

_FAR_ZERO = 0.05
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
class ChannelFacts:
    """Name and unit of a channel."""

    name: str
    unit: str


@dataclass(frozen=True)
class RestFacts:
    """What an accelerometer reads while it is held still: 1 g.

    ``value`` is the length of its ``channels`` in ``unit``, as lines and files have them, ``steps`` the same in the
    integers of the C, less ``zero``; ``steps`` is 0 if it is not known. ``is_estimated`` as in
    `plushsense.dataset.readings.GravityReading`.
    """

    channels: tuple[str, ...]
    steps: int = 0
    value: float = 0.0
    unit: str = ""
    zero: tuple[int, ...] = (0, 0, 0)
    is_estimated: bool = False

    @property
    def sentence(self) -> str:
        """What is known, for people."""
        length = f"|{', '.join(self.channels)}|"
        if not self.steps:
            return (
                f"what {length} reads at rest, so its scale, is not known: the bundle is of an earlier PlushSense or "
                "trained on arrays; export --dataset DS measures it"
            )
        # In a sentence, a small zero would only distract.
        far = math.hypot(*self.zero) > _FAR_ZERO * self.steps
        zero = f" around {join_names(self.zero)}" if far else ""
        unit = "counts" if self.unit == "count" else self.unit
        doubt = "; estimated, as the recordings do not determine it" if self.is_estimated else ""
        value = f"{self.value:,.0f}" if self.value >= 100 else f"{self.value:g}"
        return f"at rest {length}{zero} is about {value} {unit}".rstrip() + doubt


@dataclass(frozen=True)
class GestureFacts:
    """A gesture, and the suffix of its constant in the C."""

    label: str
    affect: str
    c_name: str


@dataclass(frozen=True)
class ConversionFacts:
    """A file for another runtime; the fields as in `plushsense.deploy.convert.Converted`."""

    file: str
    bytes: int
    largest_difference: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ModelFacts:
    """Facts about an exported model, as ``export.json`` holds them; ``name`` and ``url`` are "" for none."""

    title: str
    symbol: str
    filters: tuple[int, ...]
    layout: str
    layout_check: int
    channels: tuple[ChannelFacts, ...]
    rest: tuple[RestFacts, ...] = ()
    inputs: tuple[str, ...]
    classes: int
    gestures: tuple[GestureFacts, ...]
    step: int
    step_ms: float
    span: int
    receptive_field: int
    pool: int
    period_us: int
    rate_hz: float
    gap_ms: int
    fault_ms: int
    still_ms: int
    recover_ms: int
    smoothing: int
    parameters: int
    macs_per_step: int
    macs_per_window: int
    padding: str
    model_bytes: int
    model_id: int
    model_version: str
    training: str
    memory_bytes: int
    simulated: bool
    provenance: Mapping[str, Any]
    personal: Mapping[str, Any] = field(default_factory=dict)
    code_version: str
    name: str = ""
    url: str = ""
    conversions: Mapping[str, ConversionFacts] = field(default_factory=dict)
    files: tuple[str, ...] = ()

    @property
    def flash_bytes(self) -> int:
        """Size of the model, without the code (which ``plushsense profile`` measures)."""
        return self.model_bytes

    @property
    def ram_bytes(self) -> int:
        """Memory of one toy including its struct, with 32-bit pointers."""
        return self.memory_bytes + TOY_BYTES

    def to_json(self) -> dict[str, object]:
        """Return the content of ``export.json``; what is empty by default is left out."""
        optional = ("personal", "name", "url", "conversions", "files", "rest")
        return {key: value for key, value in asdict(self).items() if value or key not in optional}


def read_facts(folder: str | Path) -> ModelFacts:
    """Read the facts of an export folder; keys of other versions are left out.

    Raises:
        BadInput: if the folder is no export, or its facts cannot be read.
    """
    path = Path(folder) / FACTS

    def damaged(problem: object) -> BadInput:
        return BadInput(
            "'{path}' {problem}: export the model again.", path=path, problem=problem, name=Path(folder).name
        )

    known = {f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(ModelFacts)}
    try:
        table = json.loads(read_bytes(path, MOST_FILE_BYTES).decode())
        if not isinstance(table, dict):
            raise TypeError("it holds no table")
    except (FileNotFoundError, NotADirectoryError):
        problem = f"'{folder}' is no export" if Path(folder).exists() else f"There is no export '{folder}'"
        raise BadInput(
            "{problem}: make one with plushsense export BUNDLE OUT.", problem=problem, name=Path(folder).name
        ) from None
    except (OSError, ValueError, TypeError, RecursionError) as cause:
        raise damaged(f"cannot be read ({cause})") from None
    if missing := [key for key, is_required in known.items() if is_required and key not in table]:
        raise damaged(f"lacks {', '.join(sorted(missing))}")
    try:
        facts = load_table({key: value for key, value in table.items() if key in known}, ModelFacts, FACTS, BadInput)
    except BadInput as cause:
        raise damaged(f"cannot be read ({str(cause).removesuffix('.')})") from None
    if facts.name and not _accepted(facts.name):
        raise damaged(f"has the name {facts.name!r}, which no export has")
    return facts


def check_names(name: str = "", *, url: str = "", model_version: str = "") -> None:
    """Check the name of an export, the web page and the version of its model; "" stands for none.

    Raises:
        ConfigError: for one that is not accepted.
    """
    if name and not _accepted(name):
        raise ConfigError(
            f"'{name}' cannot be the name of an export: accepted are up to {_MOST_NAME} lower-case letters, digits and "
            "single underscores between them, a letter first, without the words arduino and library."
        )
    if url and not _PAGE.fullmatch(url):
        raise ConfigError(f"'{url}' is no address of a web page: accepted is one that begins with http:// or https://.")
    if model_version and not _VERSION.fullmatch(model_version):
        raise ConfigError(
            f"'{model_version}' is no version of a model: accepted are three numbers, as 1.2.0, and after a hyphen a "
            "pre-release, as 1.2.0-beta.1 (semver.org)."
        )


def _accepted(name: str) -> bool:
    return len(name) <= _MOST_NAME and _NAME.fullmatch(name) is not None


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


def code_files(model: IntegerModel, bundle: Bundle) -> dict[str, bytes]:
    """Return the contents of the C and model files of an export without a name, by file name.

    A program is compiled from these files only. They depend only on the model and on names in the bundle, so that they
    can be compared with the files of an export of unknown origin.
    """
    image = model.to_bytes()
    facts = facts_of(model, bundle, image)
    return {
        **{name: text.encode() for name, text in library_files(calibrate=bool(model.layout.self_calibration)).items()},
        MODEL[0]: _header(facts, model.layout).encode(),
        MODEL[1]: _source(model, facts.title).encode(),
        IMAGE: image,
    }


def library_files(*, calibrate: bool = False) -> dict[str, str]:
    """Return the files of the C library by name; ``calibrate``: with that for sensors that calibrate themselves."""
    folder = files("plushsense.deploy") / "c"
    texts = {name: (folder / name).read_text(encoding="utf-8") for name in (*LIBRARY, *[CALIBRATE] * calibrate)}
    if calibrate:
        texts[LIBRARY[0]] = texts[LIBRARY[0]].replace("/* #undef PLUSH_CALIBRATE */", "#define PLUSH_CALIBRATE")
    return texts


def facts_of(model: IntegerModel, bundle: Bundle, image: bytes) -> ModelFacts:
    """Return the facts about a model, without the name, page and files of an export."""
    arch, layout = model.network.arch, model.layout
    code_version = version("plushsense")
    # Provenance may come from elsewhere, and goes into C.
    model_version, training = (str(bundle.provenance.get(key, "")) for key in ("model_version", "dataset_hash"))
    names = c_names(model.gestures.labels)
    return ModelFacts(
        title=arch.title,
        symbol=arch.symbol,
        filters=arch.filters,
        layout=layout.name,
        layout_check=layout_check(layout),
        channels=tuple(ChannelFacts(c.name, c.unit) for c in layout.channels),
        rest=rest_facts(bundle),
        inputs=layout.inputs,
        classes=arch.classes,
        gestures=tuple(
            GestureFacts(g.label, g.affect, name) for g, name in zip(model.gestures.gestures, names, strict=True)
        ),
        step=arch.step,
        step_ms=arch.step * layout.period_us / 1000,
        span=arch.span,
        receptive_field=arch.receptive_field,
        pool=arch.pooled,
        period_us=layout.period_us,
        rate_hz=layout.rate_hz,
        gap_ms=layout.gap_ms,
        fault_ms=model.rules.health.fault_ms,
        still_ms=model.rules.health.still_ms,
        recover_ms=model.rules.health.recover_ms,
        smoothing=model.smoothing,
        parameters=arch.parameters,
        macs_per_step=arch.macs_per_step,
        macs_per_window=arch.macs_per_window,
        padding=arch.padding,
        model_bytes=len(image),
        model_id=image_check(image),
        model_version=model_version if _VERSION.fullmatch(model_version) else code_version,
        training=training if _HASH.fullmatch(training) else "",
        memory_bytes=memory_bytes(model),
        simulated=bundle.simulated,
        provenance=bundle.provenance,
        personal=bundle.personal,
        code_version=code_version,
    )


def rest_facts(bundle: Bundle) -> tuple[RestFacts, ...]:
    """Return what each accelerometer reads at rest, but for those that calibrate themselves or show no gravity."""
    layout, readings = bundle.layout, bundle.readings
    groups = [axes for axes in layout.accelerometers if not set(axes) & set(layout.self_calibration)]
    if readings is None:
        return tuple(map(RestFacts, groups))
    found = []
    for rest in readings.rest:
        if rest.axes in groups:
            channel, steps = layout.channels[layout.index(rest.axes[0])], max(1, round(rest.one_g))
            value, zero = float(f"{rest.one_g * channel.step:.4g}"), tuple(map(round, rest.zero))
            found.append(RestFacts(rest.axes, steps, value, channel.unit, zero, rest.is_estimated))
    return tuple(found)


def c_names(labels: Sequence[str]) -> tuple[str, ...]:
    """Convert labels to unique suffixes of C identifiers: ``Back stroke 1`` becomes ``BACK_STROKE_1``.

    A letter with a diacritic becomes its base letter.
    """
    suffixes: list[str] = []
    for label in labels:
        letters = (c for c in unicodedata.normalize("NFKD", label.upper()) if not unicodedata.combining(c))
        plain = "".join(c if c.isascii() and c.isalnum() else " " for c in letters)
        name = "_".join(plain.split()) or "GESTURE"
        number, free = 2, name
        while free in suffixes:
            number, free = number + 1, f"{name}_{number}"
        suffixes.append(free)
    return tuple(suffixes)


def _header(facts: ModelFacts, layout: Layout) -> str:
    names = c_names([c.name for c in facts.channels])
    # C has no literal for the lowest number.
    lows = ("INT32_MIN" if low == -(1 << 31) else low for low in layout.valid_min_int.tolist())
    channels = list(zip(names, facts.channels, lows, layout.valid_max_int.tolist(), strict=True))
    return fill_text("plushsense.deploy", "templates/plush_model.h.j2", facts=facts, channels=channels)


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
