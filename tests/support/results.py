"""Results as the studio reads them from files, without the files."""

from __future__ import annotations

from pathlib import Path

from plushsense.studio.app.stored_results import ResultRow


def row(name: str, parameters: int, f1: float | None) -> ResultRow:
    """Return the result of a trial with two folds."""
    spread = {"spread": "folds", "units": 2, "accuracy": f1, "accuracy_sd": None, "macro_f1": f1, "macro_f1_sd": 0.01}
    words = dict.fromkeys(("dataset", "data", "schedule", "split", "context", "seeds", "trial"), "")
    marks = {"leaky": False, "simulated": True}
    return ResultRow(
        id=name, kind="trial", path=Path(name), network=name, parameters=parameters, macs=1, when_s=0.0,
        **words, **marks, **spread,  # type: ignore[arg-type]
    )  # fmt: skip
