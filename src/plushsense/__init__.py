"""PlushSense understands how people touch a soft toy.

    import plushsense as ps

    ps.import_recordings("recordings/", "DS", layout="plush-15")
    dataset = ps.open_dataset("DS")
    model = ps.train(dataset)                      # a Bundle, with scores and curves
    result = ps.evaluate(dataset, split="leave-one-subject-out")

Names are loaded when first used: ``import plushsense`` brings in no PyTorch, not even NumPy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plushsense.core.gestures import GestureSet, load_gestures
    from plushsense.core.layouts import Layout, load_layout
    from plushsense.dataset.backup import backup, check_backup, restore
    from plushsense.dataset.importing.importers import import_recordings
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.privacy.pseudonymise import pseudonymise
    from plushsense.devices.opening import open_device
    from plushsense.experiments.baselines.run import baselines
    from plushsense.experiments.search.run import search
    from plushsense.experiments.sweep.run import sweep
    from plushsense.models.arch import Arch
    from plushsense.models.bundle import Bundle
    from plushsense.runtime.classifier import StreamClassifier
    from plushsense.windows.cut import WindowSpec, cut_windows
    from plushsense.workflow.api import evaluate, load, simulate, train
    from plushsense.workflow.datasets import check_dataset, forget
    from plushsense.workflow.estimator import PlushClassifier
    from plushsense.workflow.export import export
    from plushsense.workflow.reporting import write_report

from plushsense.core.version import __version__ as __version__

_WHERE = {
    "import_recordings": "plushsense.dataset.importing.importers",
    "open_dataset": "plushsense.dataset.index",
    "WindowSpec": "plushsense.windows.cut",
    "cut_windows": "plushsense.windows.cut",
    "Arch": "plushsense.models.arch",
    "Bundle": "plushsense.models.bundle",
    "train": "plushsense.workflow.api",
    "evaluate": "plushsense.workflow.api",
    "load": "plushsense.workflow.api",
    "simulate": "plushsense.workflow.api",
    "export": "plushsense.workflow.export",
    "write_report": "plushsense.workflow.reporting",
    "baselines": "plushsense.experiments.baselines.run",
    "forget": "plushsense.workflow.datasets",
    "search": "plushsense.experiments.search.run",
    "sweep": "plushsense.experiments.sweep.run",
    "backup": "plushsense.dataset.backup",
    "check_backup": "plushsense.dataset.backup",
    "restore": "plushsense.dataset.backup",
    "pseudonymise": "plushsense.dataset.privacy.pseudonymise",
    "check_dataset": "plushsense.workflow.datasets",
    "PlushClassifier": "plushsense.workflow.estimator",
    "open_device": "plushsense.devices.opening",
    "StreamClassifier": "plushsense.runtime.classifier",
    "Layout": "plushsense.core.layouts",
    "load_layout": "plushsense.core.layouts",
    "GestureSet": "plushsense.core.gestures",
    "load_gestures": "plushsense.core.gestures",
}

__all__ = [
    "Arch",
    "Bundle",
    "GestureSet",
    "Layout",
    "PlushClassifier",
    "StreamClassifier",
    "WindowSpec",
    "backup",
    "baselines",
    "check_backup",
    "check_dataset",
    "cut_windows",
    "evaluate",
    "export",
    "forget",
    "import_recordings",
    "load",
    "load_gestures",
    "load_layout",
    "open_dataset",
    "open_device",
    "pseudonymise",
    "restore",
    "search",
    "simulate",
    "sweep",
    "train",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'plushsense' has no attribute '{name}'; it offers {', '.join(__all__)}")
    value = getattr(importlib.import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
