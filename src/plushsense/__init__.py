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
    from plushsense.apps.api import evaluate, load, simulate, train
    from plushsense.apps.baselining import baselines
    from plushsense.apps.checking import check_dataset
    from plushsense.apps.estimator import PlushClassifier
    from plushsense.apps.exporting import export
    from plushsense.apps.reporting import write_report
    from plushsense.apps.retraining import forget
    from plushsense.apps.searching import search
    from plushsense.apps.sweeping import sweep
    from plushsense.core.gestures import GestureSet, load_gestures
    from plushsense.core.signal import Layout, load_layout
    from plushsense.dataset.backup import backup, check_backup, restore
    from plushsense.dataset.importers import import_recordings
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.pseudonymise import pseudonymise
    from plushsense.devices.opening import open_device
    from plushsense.live.stream import StreamClassifier
    from plushsense.models.arch import Arch
    from plushsense.models.bundle import Bundle
    from plushsense.windows.cut import WindowSpec, cut_windows

__version__ = "0.1.0"

_WHERE = {
    "import_recordings": "plushsense.dataset.importers",
    "open_dataset": "plushsense.dataset.index",
    "WindowSpec": "plushsense.windows.cut",
    "cut_windows": "plushsense.windows.cut",
    "Arch": "plushsense.models.arch",
    "Bundle": "plushsense.models.bundle",
    "train": "plushsense.apps.api",
    "evaluate": "plushsense.apps.api",
    "load": "plushsense.apps.api",
    "simulate": "plushsense.apps.api",
    "export": "plushsense.apps.exporting",
    "write_report": "plushsense.apps.reporting",
    "baselines": "plushsense.apps.baselining",
    "forget": "plushsense.apps.retraining",
    "search": "plushsense.apps.searching",
    "sweep": "plushsense.apps.sweeping",
    "backup": "plushsense.dataset.backup",
    "check_backup": "plushsense.dataset.backup",
    "restore": "plushsense.dataset.backup",
    "pseudonymise": "plushsense.dataset.pseudonymise",
    "check_dataset": "plushsense.apps.checking",
    "PlushClassifier": "plushsense.apps.estimator",
    "open_device": "plushsense.devices.opening",
    "StreamClassifier": "plushsense.live.stream",
    "Layout": "plushsense.core.signal",
    "load_layout": "plushsense.core.signal",
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
