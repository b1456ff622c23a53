"""PlushSense: recognise touch gestures on a soft toy, from recordings to C code for the toy.

For example::

    import plushsense as ps

    ps.import_recordings("recordings/", "DS", layout="plush-15")
    dataset = ps.open_dataset("DS")
    trained = ps.train(dataset)
    result = ps.evaluate(dataset, split="leave-one-subject-out")

Names are loaded when they are first used: ``import plushsense`` imports neither PyTorch nor NumPy. ``docs/python.md``
lists the modules of all other public functions.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from plushsense.core.version import __version__

if TYPE_CHECKING:
    from plushsense.dataset.importing.importers import import_recordings
    from plushsense.dataset.index import open_dataset
    from plushsense.devices.opening import open_device
    from plushsense.models.arch import Arch
    from plushsense.runtime.classifier import StreamClassifier
    from plushsense.windows.cut import cut_windows
    from plushsense.workflow.api import evaluate, load, train
    from plushsense.workflow.datasets import check_dataset
    from plushsense.workflow.estimator import PlushClassifier
    from plushsense.workflow.export import export
    from plushsense.workflow.reporting import write_report

__all__ = [
    "Arch",
    "PlushClassifier",
    "StreamClassifier",
    "__version__",
    "check_dataset",
    "cut_windows",
    "evaluate",
    "export",
    "import_recordings",
    "load",
    "open_dataset",
    "open_device",
    "train",
    "write_report",
]

_MODULES = {
    "Arch": "models.arch",
    "PlushClassifier": "workflow.estimator",
    "StreamClassifier": "runtime.classifier",
    "check_dataset": "workflow.datasets",
    "cut_windows": "windows.cut",
    "evaluate": "workflow.api",
    "export": "workflow.export",
    "import_recordings": "dataset.importing.importers",
    "load": "workflow.api",
    "open_dataset": "dataset.index",
    "open_device": "devices.opening",
    "train": "workflow.api",
    "write_report": "workflow.reporting",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'plushsense' has no attribute '{name}'; its names are {', '.join(__all__)}")
    value = getattr(importlib.import_module(f"plushsense.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
