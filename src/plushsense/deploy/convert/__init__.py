"""Optional converters of the network to formats of other runtimes.

They compute a whole window for each decision; the C of the export computes each sample once. The caller provides the
clock, the derived channels, the validity rule and the smoothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.core.files import write_file
from plushsense.deploy.convert.espdl import to_espdl
from plushsense.deploy.convert.facts import Conversion, ConversionJob, Converted
from plushsense.deploy.convert.onnx import to_integer_onnx, to_onnx
from plushsense.deploy.convert.tflite import to_integer_tflite, to_tflite
from plushsense.models.bundle import Bundle

__all__ = ["CONVERTERS", "Converted", "Format", "check_format", "convert"]


@dataclass(frozen=True)
class Format:
    """A format: its file name, a description of the contents, and the converter."""

    file_name: str
    holds: str
    write: Callable[[ConversionJob], Conversion]


CONVERTERS: dict[str, Format] = {
    "onnx": Format("model.onnx", "ONNX, floats", to_onnx),
    "onnx-int8": Format("model.int8.onnx", "ONNX, int8 with QuantizeLinear", to_integer_onnx),
    "tflite": Format("model.tflite", "LiteRT, floats", to_tflite),
    "tflite-int8": Format("model.int8.tflite", "LiteRT, int8 convolutions", to_integer_tflite),
    "espdl": Format("model.espdl", "ESP-DL for the ESP32-S3, int8", to_espdl),
    "espdl-esp32": Format("model.esp32.espdl", "ESP-DL for the ESP32, int8", partial(to_espdl, target="esp32")),
    "espdl-esp32p4": Format(
        "model.esp32p4.espdl", "ESP-DL for the ESP32-P4, int8", partial(to_espdl, target="esp32p4")
    ),
}


def check_format(name: str) -> None:
    """Raise ConfigError for an unknown format."""
    if name not in CONVERTERS:
        raise ConfigError(f"Unknown format '{name}': accepted are {', '.join(CONVERTERS)}.{nearest(name, CONVERTERS)}")


def convert(
    bundle: Bundle,
    path: str | Path,
    format_name: str,
    *,
    windows: NDArray[Any] | None = None,
) -> Converted:
    """Write ``bundle`` to ``path`` in a format of `CONVERTERS`, tried in that format's runtime before it is written.

    Args:
        windows: raw integer windows (N, C, T) to try it on, beside made-up ones.

    Raises:
        ConfigError: for an unknown format.
        MissingExtraError: with the install command, when the format's package is not there.
        ArchError, BadInput: for a network that the format cannot hold.
        BundleError: when the result does not give the network's answers; for int8, a bundle without calibration.
    """
    check_format(format_name)
    result = CONVERTERS[format_name].write(ConversionJob.of(bundle, windows))
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, result.data)
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written ({cause}): choose another path.") from None
    return Converted(path, len(result.data), result.largest_difference, result.notes)
