"""From a bundle to what reads a stream with it: the float network, or the whole numbers of the chip."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plushsense.live.decide import DecideSpec
    from plushsense.live.integer import BothEngines
    from plushsense.live.stream import StreamReader
    from plushsense.models.bundle import Bundle

ENGINES = ("float", "int8", "both")


def classifier_of(bundle: Bundle, decide: DecideSpec | None, engine: str) -> StreamReader | BothEngines:
    """What reads the stream; ``engine`` is one of `ENGINES`.

    Raises:
        BundleError: for ``int8`` and ``both``, where the network cannot be deployed.
    """
    from plushsense.deploy.calibration import integer_model
    from plushsense.live.integer import BothEngines, IntegerClassifier
    from plushsense.live.stream import StreamClassifier

    if engine == "float":
        return StreamClassifier(bundle, decide)
    integer = IntegerClassifier(integer_model(bundle, decide))
    return integer if engine == "int8" else BothEngines(integer, StreamClassifier(bundle, decide))
