"""Optional converters of the network to formats of other runtimes, and code that they share.

A converted network computes a whole window for each decision, unlike the exported C, which computes each sample once.
The caller must resample, replace invalid values, calibrate the sensors of a layout with ``self_calibration``, compute
derived channels and smooth the probabilities.
"""

from __future__ import annotations

import json
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArchError, BadInput, BundleError, ConfigError, check_known
from plushsense.core.files import write_file
from plushsense.core.layouts import Layout
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import check_windows
from plushsense.runtime.fixed import LOGIT_LIMIT
from plushsense.runtime.integer import IntegerNetwork
from plushsense.windows.features import InputUnits, Scaler

Floats = NDArray[np.float32]
Windows = NDArray[np.int64]

RAW = "raw"
LOGITS = "logits"
PROBABILITIES = "probabilities"
LIMIT = LOGIT_LIMIT / 256  # of the logits of the integer network
# Largest difference of float32 logits from the float64 reference, relative to the largest logit.
TOLERANCE = 1e-4
NOT_EXACT = (
    "Compared with the network in whole numbers, which the C in the toy equals bit for bit; this file only comes "
    "close: a code may differ by 1 where this runtime rounds the other way."
)


@dataclass(frozen=True)
class Converted:
    """A file for another runtime.

    ``largest_difference`` of its logits from those of the original network (`Network.forward`, or
    `IntegerNetwork.forward` / 256 for the int8 formats) on test windows; None if the format's runtime is not installed.
    ``notes`` are sentences for users of the file.
    """

    path: Path
    bytes: int
    largest_difference: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Conversion:
    """Result of a converter: the bytes of the file; the other fields as in `Converted`."""

    data: bytes
    largest_difference: float | None
    notes: tuple[str, ...]


class Format(NamedTuple):
    """A format: its file name, a description of the contents, and the converter as ``module:function``.

    The module is one of this package; the function takes a `ConversionJob` and returns a `Conversion`.
    """

    file_name: str
    holds: str
    converter: str


CONVERTERS: dict[str, Format] = {
    "onnx": Format("model.onnx", "ONNX, floats", "onnx:to_onnx"),
    "onnx-int8": Format("model.int8.onnx", "ONNX, int8 with QuantizeLinear", "onnx:to_integer_onnx"),
    "tflite": Format("model.tflite", "LiteRT, floats", "tflite:to_tflite"),
    "tflite-int8": Format("model.int8.tflite", "LiteRT, int8 convolutions", "tflite:to_integer_tflite"),
    "matlab": Format("model.mat", "MATLAB, weights in the shapes of its layers", "matlab:to_matlab"),
}


def refuse_unwritable(arch: Arch, suffix: str) -> None:
    """Raise ArchError for a network with a vector layer or deviations, which this suffix cannot hold here."""
    if arch.vector is not None:
        raise ArchError(
            f"{arch.title} begins with a vector layer, which PlushSense does not write to {suffix} files: take the "
            "format onnx, onnx-int8 or the C of plushsense export, or train a network without a vector layer."
        )
    if arch.pooling != "mean":
        raise ArchError(
            f"{arch.title} has the pooling '{arch.pooling}', which PlushSense does not write to {suffix} files: take "
            "the format onnx, onnx-int8 or the C of plushsense export, or train it with --pooling mean."
        )


def refuse_window(arch: Arch, format_name: str) -> None:
    """Raise ArchError for a network with padding, which a format of 8 bits cannot hold here."""
    if arch.padding != "stream":
        raise ArchError(
            f"{arch.title} has the padding '{arch.padding}', which PlushSense does not write to {format_name}: take "
            f"onnx, onnx-int8 or tflite, or train {arch.symbol} with --padding stream."
        )


def check_format(name: str) -> None:
    """Raise ConfigError for an unknown format."""
    check_known(name, CONVERTERS, "format", ConfigError)


def convert(bundle: Bundle, path: str | Path, format_name: str, *, windows: NDArray[Any] | None = None) -> Converted:
    """Convert ``bundle`` to a format of `CONVERTERS`, test the result in that format's runtime, and write it.

    Args:
        windows: integer windows (N, C, T), `WindowSet.integers`, to test with, in addition to generated ones.

    Raises:
        ConfigError: for an unknown format.
        MissingExtraError: if the package for the format is not installed, with the command to install it.
        ArchError, BadInput: for a network that the format does not support.
        BundleError: if the logits differ from the network's; for int8, also for a bundle without calibration.
    """
    check_format(format_name)
    converter = pkgutil.resolve_name(f"{__name__}.{CONVERTERS[format_name].converter}")
    result: Conversion = converter(ConversionJob.of(bundle, windows))
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, result.data)
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written ({cause}): choose another path.") from None
    return Converted(path, len(result.data), result.largest_difference, result.notes)


@dataclass(frozen=True)
class ConversionJob:
    """Input of a converter: the bundle, and raw windows (N, C, T) for comparison.

    The first ``given`` windows are from the caller, the others are generated.
    """

    bundle: Bundle
    windows: Windows
    given: int

    @classmethod
    def of(cls, bundle: Bundle, windows: NDArray[Any] | None) -> ConversionJob:
        """Create the job, with generated windows after the given ones.

        Raises:
            BadInput: for windows of another shape.
        """
        all_windows = made_up_windows(bundle)
        if windows is not None:
            check_windows(bundle.arch, windows.shape)
            given = windows[:, :, windows.shape[2] - bundle.arch.span :].astype(np.int64)
            all_windows = np.concatenate([given, all_windows])
        return cls(bundle, all_windows, 0 if windows is None else len(windows))

    @property
    def tried(self) -> str:
        """The numbers of windows as text."""
        made = len(self.windows) - self.given
        return f"{made} made-up windows" if not self.given else f"{self.given} given and {made} made-up windows"

    @property
    def values(self) -> Floats:
        """The windows (N, C, T) as values for the input of a file."""
        return InputUnits.of(self.bundle.layout).values(self.windows).astype(np.float32)

    def reference(self) -> NDArray[np.float64]:
        """Return the logits (N, K) of the float network."""
        return self.bundle.network().forward(self.bundle.scaler.apply(self.windows))


def made_up_windows(bundle: Bundle, n: int = 24) -> Windows:
    """Generate raw windows (n, C, span): random walks and noise around the mean of each channel."""
    rng = np.random.default_rng(20)
    shape = (n, bundle.arch.channels, bundle.arch.span)
    walk = np.cumsum(rng.normal(size=shape), axis=2) / np.sqrt(shape[2] / 4) + rng.normal(size=(*shape[:2], 1))
    scaled = (
        np.where(np.arange(n)[:, None, None] % 3 == 0, rng.normal(size=shape), walk)
        * rng.choice([0.5, 1, 3], n)[:, None, None]
    )
    scaler = bundle.scaler
    unit = 1 / np.where(scaler.scale == 0, 1.0, scaler.scale)
    return np.asarray(np.rint(scaler.offset[:, None] + scaled * unit[:, None]), dtype=np.int64)


def in_float32(scaler: Scaler, start: NDArray[np.float64] | float = 0.0) -> tuple[Floats, ...]:
    """Return (offset, gain, rest), each (C,), so that ``(x - offset) * gain + rest`` is the scaling plus ``start``.

    The rest has the part of a large offset that float32 cannot hold.
    """
    offset = scaler.offset.astype(np.float32)
    rest = (offset - scaler.offset) * scaler.scale + start
    return offset, scaler.scale.astype(np.float32), rest.astype(np.float32)


def input_codes(network: IntegerNetwork) -> tuple[Scaler, NDArray[np.float64]]:
    """Return a scaling of integers and what to add, (C,); rounded and clipped to 0…255, these are the first inputs.

    Because of rounding they can differ by 1 from those of `InputScale`.
    """
    scale = network.inputs
    unit = np.ldexp(1.0, -scale.after)
    gain = scale.multiplier * unit * np.ldexp(1.0, -scale.before)
    parts = [np.asarray(part, dtype=np.float64) for part in (scale.offset, gain, scale.bias * unit - 0.5)]
    return Scaler(*parts[:2]), parts[2]


def sum_scales(multiplier: NDArray[Any], before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.float64]:
    """Return the scales of a layer's sums as floats; at least 2^-32, because runtimes reject 0."""
    return np.asarray(np.maximum(multiplier * np.ldexp(1.0, -(before + after)), 2.0**-32))


def describe(bundle: Bundle, tensor: str) -> dict[str, str]:
    """Return the metadata for a file as texts (``metadata_props`` of ONNX, metadata of .tflite).

    Args:
        tensor: name, type and shape of the input, for the sentence about it.
    """
    arch, layout = bundle.arch, bundle.layout
    provenance = bundle.provenance
    facts: dict[str, Any] = {
        "title": arch.title,
        "padding": arch.padding,
        "norm": arch.norm,
        "layout": layout.name,
        "channels": list(layout.inputs),
        "gestures": list(bundle.gestures.labels),
        "affect": [g.affect for g in bundle.gestures.gestures],
        "span": arch.span,
        "step": arch.step,
        "rate_hz": layout.rate_hz,
        "units": list(InputUnits.of(layout).names),
        "input": _input_text(layout, tensor),
        "simulated": bundle.simulated,
        "code_version": str(provenance.get("code_version", "")),
    }
    return {k: v if isinstance(v, str) else json.dumps(v, ensure_ascii=False) for k, v in facts.items()}


def _input_text(layout: Layout, tensor: str) -> str:
    """Return a sentence about the input: tensor, units, and what the caller computes before."""
    offsets = {c.name: 0.0 if c.name in layout.self_calibration else c.offset for c in layout.channels}
    measured = f"{'self-calibrated ' * bool(layout.self_calibration)}values as the toy sends them"
    parts = [f"{measured}, in the units listed under 'units', at {layout.rate_hz:g} Hz after the clock rule"]
    for derived in layout.derived:
        of = [f"({name} - {offsets[name]:g})" if offsets[name] else name for name in derived.of]
        root = f"sqrt({' + '.join(f'{part}^2' for part in of)})"
        mean = f"the running mean of {of[0]} over {1 << layout.gravity_shift} samples"
        if derived.name in layout.inputs:
            parts.append(f"{derived.name} is {root if derived.kind == 'magnitude' else mean}")
    return "; ".join([tensor, *parts, "the newest sample is the last"])


def compared(
    job: ConversionJob,
    data: bytes,
    logits: NDArray[Any],
    title: str,
    notes: tuple[str, ...],
    expected: NDArray[np.float64] | None = None,
) -> Conversion:
    """Compare the logits (N, K) of a file with the expected ones and return the conversion.

    Args:
        notes: sentences about the file, for its users.
        expected: logits that the file approximates; None: those of the float network, which it must match up to
            rounding.

    Raises:
        BundleError: if the logits of a float file differ from the network's.
    """
    exact = expected is None
    reference = job.reference() if expected is None else expected
    largest = float(np.abs(logits - reference).max())
    same = int((logits.argmax(axis=1) == reference.argmax(axis=1)).sum())
    if exact and not largest <= TOLERANCE * max(1.0, float(np.abs(reference).max())):
        raise BundleError(
            f"The {title} file gives other answers than the bundle (logits differ by up to {largest:.3g}) and is not "
            "written: please report this with the bundle."
        )
    sentence = (
        f"On {job.tried}: logits differ by at most {largest:.2g}, the same gesture in {same} of {len(reference)}."
    )
    return Conversion(data, largest, (sentence, *notes))
