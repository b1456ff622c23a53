"""The network for other runtimes: optional converters, each beside the tool that it needs.

They recompute a whole window a decision; the C of the export computes each sample once. The clock, the derived
channels, the validity rule and the smoothing stay with the caller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.deploy.convert.as_onnx import to_integer_onnx, to_onnx
from plushsense.deploy.convert.as_tflite import to_integer_tflite, to_tflite
from plushsense.deploy.convert.facts import Converted, Job
from plushsense.models.bundle import Bundle
from plushsense.models.integer import IntegerNetwork

__all__ = ["CONVERTERS", "Converted", "Format", "convert"]


@dataclass(frozen=True)
class Format:
    """A format: the file it is written to, what it holds, the function that writes it."""

    file_name: str
    holds: str
    write: Callable[[Job, Path], Converted]
    integer: bool = False


CONVERTERS: dict[str, Format] = {
    "onnx": Format("model.onnx", "ONNX, floats", to_onnx),
    "onnx-int8": Format("model.int8.onnx", "ONNX, int8 with QuantizeLinear", to_integer_onnx, integer=True),
    "tflite": Format("model.tflite", "LiteRT, floats", to_tflite),
    "tflite-int8": Format("model.int8.tflite", "LiteRT, int8 convolutions", to_integer_tflite, integer=True),
}


def convert(
    bundle: Bundle,
    path: str | Path,
    format_name: str,
    *,
    integer: IntegerNetwork | None = None,
    windows: NDArray[Any] | None = None,
) -> Converted:
    """Write ``bundle`` to ``path`` in a format of `CONVERTERS`, tried in that format's runtime before it is written.

    Args:
        integer: the network in whole numbers, which the int8 formats hold.
        windows: raw integer windows (N, C, T) to try it on, beside made-up ones.

    Raises:
        ConfigError: for an unknown format.
        MissingExtraError: with the install command, when the format's package is not there.
        ArchError, BadInput: for a network that the format cannot hold.
        BundleError: when the result does not give the network's answers.
    """
    if format_name not in CONVERTERS:
        raise ConfigError(
            f"Unknown format '{format_name}': accepted are {', '.join(CONVERTERS)}.{nearest(format_name, CONVERTERS)}"
        )
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return CONVERTERS[format_name].write(Job.of(bundle, integer, windows), path)
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written ({cause}): choose another place.") from None
