"""The faults that can be planted: each changes one thing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.deploy.faults import TEXTS, faults_of
from plushsense.deploy.targets import C_FOLDER


def test_the_texts_of_the_faults_stand_in_our_c(small: Path) -> None:
    source = (C_FOLDER / "plushsense.c").read_text(encoding="utf-8")
    found = faults_of((small / "plush_model.bin").read_bytes(), source)
    assert len({f.name for f in found}) == len(found) == len(TEXTS) + 10
    for fault in found:
        assert (fault.image is None) != (fault.source is None)
        assert fault.source != source
    image = np.frombuffer((small / "plush_model.bin").read_bytes(), dtype=np.uint8)
    for fault in found:
        if fault.image is not None:
            # The checksum and one number.
            changed = np.flatnonzero(np.frombuffer(fault.image, dtype=np.uint8) != image)
            assert 1 <= (changed >= 16).sum() <= 2 and ((changed >= 12) & (changed < 16)).any()
    with pytest.raises(BadInput, match="stands 0 times"):
        faults_of((small / "plush_model.bin").read_bytes(), source.replace("+ 16384u", "+ 16385u"))
