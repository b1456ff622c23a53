"""Bundles: a trained model in one file (``*.plush``), with all that is needed to run it and to assess it.

The file has the safetensors format, never pickle. Its only metadata entry, ``plushsense``, is JSON with the format, the
version, the content, and the SHA-256 of content and tensors. Equal bundles give equal bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from plushsense.core.errors import BadInput, BundleError
from plushsense.core.files import check_output_file, read_bytes, write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.toml import check_table, load_table
from plushsense.dataset.readings import Readings
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.models.arch import Arch
from plushsense.models.reference import CHUNK, DENSE, Network, check_weights
from plushsense.windows.features import Scaler

FORMAT = "plushsense-bundle"
VERSION = 1
_PEOPLE = ("subjects", "validation_subjects")
_AGAIN = "copy it again from where it came, or train again"


# Offsets and scales beyond them cannot come from 32-bit values.
_MOST_OFFSET, _SCALES = 2.0**40, (1e-15, 1e9)
# Larger weights and calibrations could overflow in four layers of floats; seconds of windows are few.
_MOST_WEIGHT = 1e20
_MOST = {"calibration": 1e30, "windowing": 1e6}
_MOST_BYTES = 256 << 20
_FILE_BEGIN = '{"__metadata__":{"plushsense"'
_DEEPEST = 32  # tables within tables
# What a network may take to run: numbers kept or computed at once (512 MiB of floats), multiply-accumulates of a
# decision, and of those that are due at once after a gap.
_MOST_NUMBERS, _MOST_MACS, _MOST_GAP_MACS = 1 << 26, 1_000_000_000, 100_000_000_000


@dataclass(frozen=True)
class _Origin:
    """The types of those keys of ``provenance`` that are read again; people are counts in an export."""

    subjects: tuple[str, ...] | int = ()
    validation_subjects: tuple[str, ...] | int = ()
    dataset: str | None = None
    dataset_hash: str | None = None
    split: str | None = None
    preset: str | None = None
    code_version: str | None = None
    simulated: bool | None = None
    training: dict[str, Any] = field(default_factory=dict)
    scores: dict[str, Any] = field(default_factory=dict)
    estimator: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Scores:
    """The types of those keys of the scores in ``provenance`` that are read again."""

    accuracy: float | None = None
    macro_f1: float | None = None
    windows: int | None = None
    split: str | None = None
    leaky: bool | None = None
    nobody: dict[str, Any] | None = None
    int8: dict[str, Any] | None = None


@dataclass(frozen=True)
class _Adaptation:
    """The types of those keys of ``personal`` that are read again."""

    subject: str | None = None
    leave_one_recording_out: dict[str, dict[str, Any]] = field(default_factory=dict)
    original: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Windowing:
    """The types of those keys of ``windowing`` that are read again."""

    window_s: float = 0.0
    step_s: float = 0.0
    context: str = ""
    span_s: float = 0.0
    longest_factor: float = 0.0
    anywhere: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class Bundle:
    """A trained network with its layout, scaling, gestures and settings. The order of ``gestures`` is the class index.

    The dictionaries are plain values for JSON.

    Attributes:
        scaler: scaling of the integers that the toy computes (`WindowSet.integers`), not of values in units.
        windowing: settings with which the windows were cut.
        decision: settings of live decisions (`plushsense.runtime.decisions.DecideSpec`).
        provenance: origin of the weights: data set hash, subjects, code version, split, scores.
        calibration: value ranges in training windows, for 8-bit scales (``deploy/quantize``); no samples. May be empty.
        personal: for whom the dense layer was adapted, and the layer before (`plushsense.live.adaptation`); or empty.
        readings: what the sensors read in the training recordings; None: unknown, as in bundles of earlier versions, or
            if the training had arrays alone.

    Raises:
        BundleError: if the parts do not fit together, or a number is out of range.
    """

    arch: Arch
    weights: Mapping[str, NDArray[np.float32]]
    layout: Layout
    scaler: Scaler
    gestures: GestureSet
    windowing: dict[str, Any] = field(default_factory=dict)
    decision: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    personal: dict[str, Any] = field(default_factory=dict)
    readings: Readings | None = None

    def __post_init__(self) -> None:
        check_weights(self.arch, self.weights)
        for name, found, needed in (
            ("inputs in the layout", self.layout.n_inputs, self.arch.channels),
            ("offsets in the scaling", np.size(self.scaler.offset), self.arch.channels),
            ("scales in the scaling", np.size(self.scaler.scale), self.arch.channels),
            ("gestures in the set", len(self.gestures), self.arch.classes),
        ):
            if found != needed:
                raise BundleError(f"The bundle does not fit together: {found} {name}, the network needs {needed}.")
        if not (np.isfinite(self.scaler.offset).all() and np.isfinite(self.scaler.scale).all()):
            raise BundleError("The bundle's scaling holds a value that is not finite: train again.")
        low, high = _SCALES
        scales, offsets = np.asarray(self.scaler.scale), np.asarray(self.scaler.offset)
        if ((scales < low) | (scales > high)).any() or (np.abs(offsets) > _MOST_OFFSET).any():
            raise BundleError(
                f"The bundle's scaling is out of range (scales {low:g} to {high:g}, offsets to ±{_MOST_OFFSET:g}): "
                "train again."
            )
        for name, weight in self.weights.items():
            if np.size(weight) and np.abs(weight).max() > _MOST_WEIGHT:
                raise BundleError(f"The weights '{name}' hold a value beyond ±{_MOST_WEIGHT:g}: train again.")
        if self.readings is not None and (problem := self.readings.problem(self.layout)):
            raise BundleError(f"The readings in the bundle hold {problem}: train again.")
        _check_size(self.arch, self.layout)

    def __repr__(self) -> str:
        filters = "/".join(str(f) for f in self.arch.filters)
        return (
            f"Bundle({self.arch.symbol} {filters} {self.arch.padding}, {len(self.gestures)} gestures, "
            f"layout {self.layout.name}{f', adapted to {self.adapted_to}' if self.personal else ''})"
        )

    @property
    def adapted_to(self) -> str | None:
        """Code of the person to whom the bundle is adapted, "somebody" if unknown; None if it is not adapted."""
        return str(self.personal.get("subject", "somebody")) if self.personal else None

    @property
    def simulated(self) -> bool:
        """Whether the network was trained on virtual people; then nothing that it answers is a result."""
        return bool(self.provenance.get("simulated"))

    def network(self) -> Network:
        """Return the NumPy network with these weights."""
        return Network(self.arch, self.weights)

    def without_people(self) -> Bundle:
        """Return the bundle for an export: without people's codes and the weights before an adaptation; idempotent."""
        personal = {key: value for key, value in self.personal.items() if key not in ("subject", "original")}
        return replace(self, provenance=_without_people(self.provenance), personal=personal)

    def save(self, path: str | Path) -> Path:
        """Write the bundle atomically, creating missing folders; return the path. An earlier bundle is replaced.

        Raises:
            BundleError: if the file cannot be written, or exists and is not a bundle.
        """
        path = check_bundle_path(path)
        data = self.to_bytes()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, data)
        except OSError as cause:
            raise BundleError(f"The bundle '{path}' cannot be written ({cause}): choose another place.") from None
        return path

    @classmethod
    def load(cls, path: str | Path) -> Bundle:
        """Read a bundle.

        Raises:
            BundleError: if the file is missing, incomplete, altered, of another version, or not a bundle.
        """
        path = Path(path)
        try:
            data = read_bytes(path, _MOST_BYTES)
        except FileNotFoundError:
            raise BundleError(
                f"There is no bundle '{path}': check the path, or make one with plushsense train."
            ) from None
        except OSError as cause:
            if path.is_dir():
                raise BundleError(f"'{path}' is a folder: give a *.plush file made by plushsense train.") from None
            raise BundleError(f"The bundle '{path}' cannot be read ({cause}).") from None
        return cls.from_bytes(data, path)

    @classmethod
    def from_bytes(cls, data: bytes, path: str | Path = "in memory") -> Bundle:
        """Read a bundle from the bytes of its file; ``path`` names it in messages.

        Raises:
            BundleError: as in `load`.
        """
        head = _header(data, path)
        version = head.get("version")
        if version != VERSION:
            raise BundleError(
                f"The bundle '{path}' has the version {version!r}; this PlushSense reads {VERSION}: "
                "use the PlushSense that wrote it, or train again."
            )
        content = head.get("content")
        try:
            weights: dict[str, NDArray[Any]] = load_tensors(data)
        except (SafetensorError, KeyError, ValueError, TypeError) as cause:
            raise BundleError(f"{_damaged(path)} ({cause}).") from None
        try:
            genuine = head.get("sha256") == _digest(_canonical(content), weights)
        except (ValueError, RecursionError):  # a number that is not finite; tables nested without end
            genuine = False
        if not isinstance(content, dict) or not genuine:
            raise BundleError(f"{_damaged(path)} (its checksum does not match).")
        try:
            _check_numbers(content)
            _check_tables(content)
            for name, weight in weights.items():
                if weight.dtype != np.float32:
                    raise BundleError(f"the weights '{name}' are of {weight.dtype}: accepted is float32.")
            bundle = cls(
                Arch.from_dict(content["arch"]),
                weights,
                Layout.from_dict(content["layout"], "layout of the bundle"),
                Scaler.from_dict(content["scaling"]),
                GestureSet.from_dict(content["gestures"], "gesture set of the bundle"),
                content["windowing"],
                content["decision"],
                content["provenance"],
                content.get("calibration", {}),
                content.get("personal", {}),
                load_table(content["readings"], Readings, "readings", BundleError) if "readings" in content else None,
            )
            implied = bundle._implied()
            changed = [key for key in implied if content.get(key) != implied[key]]
            bundle._check_earlier()
        except KeyError as missing:
            raise BundleError(f"The bundle '{path}' cannot be used: it lacks {missing}.") from None
        except (BadInput, TypeError, ValueError, OverflowError) as cause:
            why = "a text in it has half a character" if isinstance(cause, UnicodeEncodeError) else cause
            raise BundleError(f"The bundle '{path}' cannot be used: {why}") from None
        if changed:
            was, now = content.get(changed[0], "not stored"), implied[changed[0]]
            raise BundleError(
                f"The bundle '{path}' was written under other rules ({changed[0]} was {was}, is {now}): train again."
            )
        return bundle

    def _check_earlier(self) -> None:
        """Raise BundleError if the layer before an adaptation does not fit the network."""
        if earlier := self.personal.get("original"):
            with np.errstate(over="ignore"):
                layer = {name: np.array(earlier[name], dtype=np.float32) for name in DENSE}
            check_weights(self.arch, {**self.weights, **layer})

    def _implied(self) -> dict[str, Any]:
        """Return values that follow from the parts, for programs in other languages."""
        return {
            "features": list(self.layout.inputs),
            "clock": {
                "rate_hz": self.layout.rate_hz,
                "period_us": self.layout.period_us,
                "gap_ms": self.layout.gap_ms,
            },
            "pool": self.arch.pooled,
            "step": self.arch.step,
            "span": self.arch.span,
        }

    def to_bytes(self) -> bytes:
        """Return the bytes of the file that `save` writes.

        Raises:
            BundleError: for content that `from_bytes` refuses.
        """
        content: dict[str, Any] = _plain(
            {
                "arch": self.arch.to_dict(),
                "layout": self.layout.to_dict(),
                "scaling": self.scaler.to_dict(),
                "gestures": self.gestures.to_dict(),
                "windowing": self.windowing,
                "decision": self.decision,
                "provenance": self.provenance,
                **({"calibration": self.calibration} if self.calibration else {}),
                **({"personal": self.personal} if self.personal else {}),
                **({"readings": asdict(self.readings)} if self.readings else {}),
                **self._implied(),
            }
        )
        _check_numbers(content)
        _check_tables(content)
        weights = {n: np.ascontiguousarray(w, dtype=np.float32) for n, w in sorted(self.weights.items())}
        head = {
            "format": FORMAT,
            "version": VERSION,
            "sha256": _digest(_canonical(content), weights),
            "content": content,
        }
        return bytes(save_tensors(weights, metadata={"plushsense": _canonical(head)}))


def check_bundle_path(path: str | Path) -> Path:
    """Return the path; raise BundleError if a bundle cannot be written there, or would replace another kind of file."""
    check_output_file(Path(path), _FILE_BEGIN, "a bundle", BundleError)
    return Path(path)


def known_people(provenance: Mapping[str, Any], keys: Sequence[str] = _PEOPLE) -> set[str]:
    """Return the codes of the people in the training and validation data, without "nobody" and unknown people.

    An export states only their number, so that there are none.
    """
    listed = [provenance.get(key) for key in keys]
    codes = {str(code) for each in listed if isinstance(each, list | tuple) for code in each}
    return codes - {NOBODY, UNKNOWN_SUBJECT}


def is_training_content(bundle: Bundle, dataset: Dataset) -> bool:
    """Return whether a bundle was trained on the present content of a data set, with gestures merged as in it."""
    return bundle.provenance.get("dataset_hash") == dataset.with_gestures(bundle.gestures).hash


def trained_people(bundle: Bundle, dataset: Dataset) -> set[str]:
    """Return the people of a data set on whom a bundle was trained or tuned, or to whom it was adapted.

    If the bundle comes from a data set of another name and other content, equal codes stand for other people. The
    person that it was adapted to is always included, because the bundle does not name that person's data set.
    """
    origin = bundle.provenance
    same = origin.get("dataset") in (None, dataset.head.name) or is_training_content(bundle, dataset)
    adapted = set() if bundle.adapted_to is None else {bundle.adapted_to}
    return adapted | (known_people(origin) if same else set())


def _without_people(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bundle's provenance with the number of people instead of their codes; idempotent."""
    people = {
        key: {str(n) for n in provenance[key]} - {NOBODY} for key in _PEOPLE if isinstance(provenance.get(key), list)
    }
    names = set().union(*people.values())
    named = re.compile(
        "|".join(rf"(?<!\w){re.escape(n)}(?!\w)" for n in sorted(names, key=len, reverse=True)) or "(?!)"
    )

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: plain(each) for key, each in value.items() if str(key) not in names}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return named.sub("…", value) if isinstance(value, str) else value

    counted = {key: provenance[key] for key in _PEOPLE if isinstance(provenance.get(key), int)}
    others = {key: plain(value) for key, value in provenance.items() if key not in _PEOPLE}
    return others | counted | {key: len(codes) for key, codes in people.items()}


def _check_size(arch: Arch, layout: Layout) -> None:
    """Raise BundleError for a network that takes too much memory or time to run."""
    streams = arch.padding == "stream"
    rows = CHUNK if streams else arch.window
    layers = list(zip(arch.layers, arch.inputs, strict=True))
    kept = (rows + arch.receptive_field) * arch.channels + arch.blocks * arch.layers[-1].filters
    kept += sum((layer.reach + 2 * rows) * max(read, layer.filters) for layer, read in layers)
    taps = max(rows * layer.kernel * read for layer, read in layers)
    if max(kept, taps) > _MOST_NUMBERS:
        raise BundleError(
            f"{arch.title} keeps or computes {max(kept, taps):,} numbers at once: accepted are up to "
            f"{_MOST_NUMBERS:,}, so take shorter layers or a shorter window."
        )
    macs = arch.macs_per_step + (arch.blocks * arch.layers[-1].filters if streams else 0)
    steps_of_gap = layout.gap_ms * layout.rate_hz / 1000 / arch.step
    if macs > _MOST_MACS or macs * steps_of_gap > _MOST_GAP_MACS:
        raise BundleError(
            f"{arch.title} takes {macs:,} multiply-accumulates for a decision, and bridges gaps of {layout.gap_ms} ms: "
            f"accepted are up to {_MOST_MACS:,} for a decision, and {_MOST_GAP_MACS:,} for those of a gap."
        )


def _check_numbers(content: Mapping[str, Any]) -> None:
    """Raise BundleError for numbers beyond `_MOST`, whole ones beyond 64 bits, and tables nested too deep."""
    below: list[tuple[int, str, Any]] = [(1, str(key), value) for key, value in content.items()]
    while below:
        depth, part, value = below.pop()
        if isinstance(value, dict | list):
            if depth > _DEEPEST:
                raise BundleError(f"{part} has tables nested more than {_DEEPEST} deep.")
            below += [(depth + 1, part, each) for each in (value.values() if isinstance(value, dict) else value)]
        elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
            raise BundleError(f"{part} holds a whole number beyond 64 bits.")
        elif isinstance(value, int | float) and abs(value) > _MOST.get(part, math.inf):
            raise BundleError(f"{part} holds {value:g}: accepted are numbers up to ±{_MOST[part]:g}.")


def _check_tables(content: Mapping[str, Any]) -> None:
    """Raise BundleError if tables in the content of a bundle have values of wrong types; further keys are allowed."""
    # All texts must be fit for files in UTF-8.
    json.dumps(content, ensure_ascii=False).encode()
    tables = ("arch", "layout", "scaling", "gestures", "windowing", "decision", "provenance", "calibration", "personal")
    for name in tables:
        if not isinstance(content.get(name, {}), dict):
            raise BundleError(f"{name} is {content[name]!r}: accepted is a table.")
    origin = content["provenance"]
    for name, table, kind in (
        ("windowing", content["windowing"], _Windowing),
        ("personal", content.get("personal", {}), _Adaptation),
        ("provenance", origin, _Origin),
        ("scores", origin.get("scores") if isinstance(origin.get("scores"), dict) else {}, _Scores),
    ):
        known = {f.name for f in fields(kind)}
        _, problems = check_table({key: value for key, value in table.items() if key in known}, kind, name)
        if problems:
            raise BundleError(problems[0])


def _header(data: bytes, path: str | Path) -> dict[str, Any]:
    """Return the JSON metadata of a bundle, after checking that the file is complete."""
    other_file = f"'{path}' is not a PlushSense bundle: give a *.plush file made by plushsense train"
    length = int.from_bytes(data[:8], "little")
    if len(data) < 10 or data[8:9] != b"{":
        raise BundleError(f"{other_file}." if data else f"'{path}' is empty: {_AGAIN}.")
    if 8 + length > len(data):
        # In a file of another format, these bytes give an absurdly large length.
        raise BundleError(f"{_damaged(path)} (it ends within its header)." if length < 1 << 26 else f"{other_file}.")
    try:
        outer = json.loads(data[8 : 8 + length])
        ends = [v["data_offsets"][1] for name, v in outer.items() if name != "__metadata__"]
        inner = outer.get("__metadata__", {}).get("plushsense")
        if inner is None:
            raise BundleError(f"{other_file} (this is a safetensors file of something else, or a damaged bundle).")
        head = json.loads(inner)
        if head["format"] != FORMAT or "version" not in head:
            raise BundleError(f"{other_file}.")
        missing = 8 + length + max(ends, default=0) - len(data)
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError):
        raise BundleError(f"{_damaged(path)} (its header cannot be read).") from None
    if missing > 0:
        raise BundleError(f"{_damaged(path)} ({missing} bytes are missing at its end).")
    return dict(head)


def _damaged(path: str | Path) -> str:
    return f"The bundle '{path}' is damaged: {_AGAIN}"


def _canonical(content: Any) -> str:
    return json.dumps(content, sort_keys=True, ensure_ascii=True, allow_nan=False, separators=(",", ":"))


def _digest(content: str, weights: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the content and of every tensor with its name, type and shape."""
    total = hashlib.sha256(content.encode())
    for name in sorted(weights):
        values = np.ascontiguousarray(weights[name])
        total.update(f"\n{name} {values.dtype.str} {values.shape}\n".encode())
        total.update(values.tobytes())
    return total.hexdigest()


def _plain(value: Any) -> Any:
    """Convert a value for JSON: NumPy values and paths to plain ones, keys to text, NaN and infinity to None."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, set | frozenset):
        return sorted(_plain(v) for v in value)
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Path):
        return str(value)
    raise BundleError(f"A bundle holds plain values only, not {value!r} of the type {type(value).__name__}.")
