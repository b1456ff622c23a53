"""Predictions come back from their file as they went in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.evaluation.scores import Predictions, read_predictions, write_predictions


def test_they_come_back(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    given = Predictions(
        ("b", "a", "p_c"),
        np.array(["P1", "P2", "P2", "none"]),
        np.array(["P1/x", "P2/y", "P2/y", "z"]),
        np.array([0, 0, 1, 0]),
        np.array(["loop", "stream", "stream", "inside"]),
        np.array(["fold 1", "fold 1", "fold 2", "fold 2"]),
        np.array([2, 0, 0, 1]),
        random.random((4, 3)).astype(np.float32),
    )
    found = read_predictions(write_predictions(tmp_path / "p.parquet", given))
    assert found.labels == given.labels
    for name in ("subject", "recording", "window", "context", "fold", "truth", "probabilities", "predicted"):
        assert np.array_equal(getattr(found, name), getattr(given, name)), name


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.parquet"
    with pytest.raises(BadInput, match="There are no predictions at .*evaluate again"):
        read_predictions(path)
    path.write_text("no parquet", encoding="utf-8")
    with pytest.raises(BadInput, match="holds no predictions"):
        read_predictions(path)
