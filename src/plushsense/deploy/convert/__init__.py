"""The network for other runtimes: optional converters, each beside the tool that it needs.

They recompute a whole window a decision; the C of the export computes each sample once. The clock, the derived
channels, the validity rule and the smoothing stay with the caller.
"""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.deploy.convert.as_espdl import to_espdl
from plushsense.deploy.convert.as_onnx import to_integer_onnx, to_onnx
from plushsense.deploy.convert.as_tflite import to_integer_tflite, to_tflite
from plushsense.deploy.convert.facts import Converted, Job, Made
from plushsense.models.bundle import Bundle

__all__ = ["CONVERTERS", "Converted", "Format", "check_format", "convert"]


@dataclass(frozen=True)
class Format:
    """A format: the file it is written to, what it holds, the function that writes it."""

    file_name: str
    holds: str
    write: Callable[[Job], Made]


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
    """Refuse a format that there is not: ConfigError with those that there are."""
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
    made = CONVERTERS[format_name].write(Job.of(bundle, windows))
    path = Path(path)
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(made.data)
        part.replace(path)
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written ({cause}): choose another place.") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return Converted(path, len(made.data), made.largest_difference, made.notes)
