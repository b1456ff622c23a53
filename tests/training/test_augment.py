from __future__ import annotations

import numpy as np
import torch

from plushsense.training.augment import Turn, rotations
from plushsense.windows.features import Scaler


def test_rotations_are_rotations_of_the_asked_spread() -> None:
    turns = rotations(4000, 30.0, torch.Generator().manual_seed(0))
    eye = torch.eye(3).expand_as(turns)
    assert torch.allclose(turns @ turns.transpose(1, 2), eye, atol=1e-5)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(len(turns)), atol=1e-5)
    cosine = ((turns.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    assert abs(float((angle**2).mean().sqrt()) - 30.0) < 1.5


def test_turned_windows_keep_every_vectors_length_and_the_other_channels() -> None:
    rng = np.random.default_rng(0)
    raw = rng.integers(-9000, 9000, (20, 7, 50))
    scaler = Scaler.fit(raw)
    x = torch.from_numpy(scaler.apply(raw))
    turn = Turn(((0, 1, 2), (4, 5, 6)), scaler, 45.0, torch.device("cpu"))
    out = turn(x, torch.Generator().manual_seed(1)).double().numpy()
    back = out / scaler.scale[:, None] + scaler.offset[:, None]
    for axes in ((0, 1, 2), (4, 5, 6)):
        was = np.linalg.norm(raw[:, axes], axis=1)
        assert np.allclose(np.linalg.norm(back[:, axes], axis=1), was, rtol=1e-3)
        assert np.abs(back[:, axes] - raw[:, axes]).max() > 1000
    assert np.array_equal(out[:, 3].astype(np.float32), x[:, 3].numpy())
    # One toy: both vectors of a window turn alike.
    a, b = (np.linalg.lstsq(raw[0, s].T, back[0, s].T, rcond=None)[0] for s in ([0, 1, 2], [4, 5, 6]))
    assert np.allclose(a, b, atol=1e-3)


def test_without_vectors_or_degrees_nothing_happens() -> None:
    scaler = Scaler(np.zeros(3), np.ones(3))
    x = torch.randn(4, 3, 10)
    for vectors, degrees in (((), 45.0), (((0, 1, 2),), 0.0)):
        turn = Turn(vectors, scaler, degrees, torch.device("cpu"))
        assert turn.idle
        assert turn(x, torch.Generator()) is x
