from __future__ import annotations

import numpy as np
import pytest
import torch

from plushsense.core.errors import ConfigError
from plushsense.training.augment import (
    AUGMENTATIONS,
    Augmentation,
    Channels,
    augmentations,
    parse_augmentation,
    rotations,
)
from plushsense.training.spec import PRESETS, preset
from plushsense.windows.features import Scaler


def test_rotations_are_rotations_of_the_asked_spread() -> None:
    turns = rotations(4000, 30.0, torch.Generator().manual_seed(0))
    eye = torch.eye(3).expand_as(turns)
    assert torch.allclose(turns @ turns.transpose(1, 2), eye, atol=1e-5)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(len(turns)), atol=1e-5)
    cosine = ((turns.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    assert abs(float((angle**2).mean().sqrt()) - 30.0) < 1.5


def test_rotated_windows_keep_every_vectors_length_and_the_other_channels() -> None:
    rng = np.random.default_rng(0)
    raw = rng.integers(-9000, 9000, (20, 7, 50))
    scaler = Scaler.fit(raw)
    x = torch.from_numpy(scaler.apply(raw))
    augment = augmentations(["random-rotation:45"], Channels(((0, 1, 2), (4, 5, 6)), scaler, torch.device("cpu")))
    assert augment is not None
    out = augment(x, torch.Generator().manual_seed(1)).double().numpy()
    back = out / scaler.scale[:, None] + scaler.offset[:, None]
    for axes in ((0, 1, 2), (4, 5, 6)):
        was = np.linalg.norm(raw[:, axes], axis=1)
        assert np.allclose(np.linalg.norm(back[:, axes], axis=1), was, rtol=1e-3)
        assert np.abs(back[:, axes] - raw[:, axes]).max() > 1000
    assert np.array_equal(out[:, 3].astype(np.float32), x[:, 3].numpy())
    # One toy: both vectors of a window rotate alike.
    a, b = (np.linalg.lstsq(raw[0, s].T, back[0, s].T, rcond=None)[0] for s in ([0, 1, 2], [4, 5, 6]))
    assert np.allclose(a, b, atol=1e-3)


def moved(names: list[str], raw: np.ndarray, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Raw windows of an accelerometer, a gyroscope and gravity, before and after an augmentation."""
    vectors = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
    scaler = Scaler.fit(raw, vectors)
    augment = augmentations(names, Channels(vectors, scaler, torch.device("cpu"), has_gravity=True))
    assert augment is not None
    out = augment(torch.from_numpy(scaler.apply(raw)), torch.Generator().manual_seed(seed)).double().numpy()
    return raw.astype(float), out / scaler.scale[:, None] + scaler.offset[:, None]


def still_and_moving(n: int = 30) -> np.ndarray:
    rng = np.random.default_rng(0)
    gravity = rng.integers(-4000, 4000, (n, 3, 1)) * np.ones((1, 1, 40), dtype=np.int64)
    movement = np.cumsum(rng.integers(-200, 200, (n, 3, 40)), axis=2)
    return np.concatenate([gravity + movement, rng.integers(-900, 900, (n, 3, 40)), 16 * gravity], axis=1)


def test_gain_strengthens_movement_and_leaves_gravity() -> None:
    before, after = moved(["random-gain:0.5"], still_and_moving())
    assert np.allclose(after[:, 6:], before[:, 6:], atol=0.5)
    rest = before[:, 6:] / 16
    factors = (after[:, :3] - rest)[:, :, -1] / (before[:, :3] - rest)[:, :, -1]
    usable = np.abs((before[:, :3] - rest)[:, :, -1]) > 200
    spread = np.array([f[u] for f, u in zip(factors, usable, strict=True) if u.all()])
    assert np.allclose(spread, spread[:, :1], rtol=0.02)
    assert spread.min() > 1 / 1.51 and spread.max() < 1.51 and spread.std() > 0.1
    assert np.allclose(after[0, 3:6] / before[0, 3:6], spread[0, 0], rtol=0.05)


def test_tilt_turns_gravity_alone() -> None:
    before, after = moved(["random-tilt:20"], still_and_moving())
    assert np.allclose(after[:, :6], before[:, :6], atol=0.5)
    was, now = before[:, 6:, 0], after[:, 6:, 0]
    assert np.allclose(np.linalg.norm(was, axis=1), np.linalg.norm(now, axis=1), rtol=1e-3)
    cosine = (was * now).sum(axis=1) / np.linalg.norm(was, axis=1) ** 2
    assert 3 < np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 30


def played(name: str, x: torch.Tensor, seed: int = 0) -> torch.Tensor:
    channels = Channels((), Scaler(np.zeros(x.shape[1]), np.ones(x.shape[1])), torch.device("cpu"))
    augment = augmentations([name], channels)
    assert augment is not None
    return augment(x, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", ["random-tempo:0.3", "random-warp:0.4"])
def test_a_window_played_at_another_speed_passes_through_the_same_values(name: str) -> None:
    # The first channel counts the samples, so it tells the moment that each new sample comes from.
    at = torch.arange(200.0)
    x = torch.stack([at, 3.0 * at - 50.0])[None].expand(300, 2, 200).contiguous()
    moment, double = played(name, x).unbind(1)
    assert torch.equal(moment[:, -1], torch.full((300,), 199.0))
    assert torch.allclose(double, 3.0 * moment - 50.0, atol=1e-3)
    steps = moment.diff(dim=1)
    assert float(steps.min()) >= 0.0 and float(moment.min()) >= 0.0
    assert torch.equal(played(name, x), played(name, x)) and not torch.equal(played(name, x), played(name, x, 1))


def test_tempo_is_even_and_warp_is_not() -> None:
    x = torch.arange(400.0)[None, None].expand(500, 1, 400).contiguous()
    even, uneven = (played(name, x)[:, 0, 200:].diff(dim=1) for name in ("random-tempo:0.3", "random-warp:0.4"))
    assert float(even.std(dim=1).max()) < 1e-3
    speed = even.mean(dim=1)
    assert 1 / 1.301 < float(speed.min()) < 0.8 and 1.25 < float(speed.max()) < 1.301
    assert float(uneven.std(dim=1).median()) > 0.1
    # At the knots, the logarithm of the speed has the spread that is given.
    last = played("random-warp:0.4", x)[:, 0].diff(dim=1)[:, -1].log()
    assert abs(float(last.std()) - 0.4) < 0.05 and abs(float(last.mean())) < 0.06


def test_what_a_faster_window_lacks_is_held_at_its_beginning() -> None:
    x = torch.arange(100.0)[None, None].expand(200, 1, 100).contiguous()
    out = played("random-tempo:0.5", x)[:, 0]
    faster = out[:, -1] - out[:, -2] > 1.3
    assert bool(faster.any()) and bool((out[faster][:, :20] == 0.0).all())


def test_tempo_and_warp_are_played_in_one_pass() -> None:
    x = torch.arange(200.0)[None, None].expand(100, 1, 200).contiguous()
    channels = Channels((), Scaler(np.zeros(1), np.ones(1)), torch.device("cpu"))
    both = augmentations(["random-tempo:0.3", "random-warp:0.4"], channels)
    tempo, warp = (augmentations([name], channels) for name in ("random-tempo:0.3", "random-warp:0.4"))
    assert both is not None and tempo is not None and warp is not None
    random = torch.Generator().manual_seed(0)
    in_turn = warp(tempo(x, random), random)[:, 0]
    at_once = both(x, torch.Generator().manual_seed(0))[:, 0]
    # Near the beginning, each pass in turn may hold a sample.
    moving = in_turn[:, 1:] > in_turn[:, :-1] + 0.01
    assert float(moving.float().mean()) > 0.8
    equal = (at_once - in_turn)[:, 1:][moving].abs() < 0.01
    assert float(equal.float().mean()) > 0.98


def test_gain_and_tilt_need_gravity() -> None:
    channels = Channels(((0, 1, 2),), Scaler(np.zeros(3), np.ones(3)), torch.device("cpu"))
    assert augmentations(["random-gain:0.3", "random-tilt:8"], channels) is None


def test_without_vectors_or_degrees_nothing_happens() -> None:
    scaler = Scaler(np.zeros(3), np.ones(3))
    for vectors, degrees in (((), 45), (((0, 1, 2),), 0)):
        channels = Channels(vectors, scaler, torch.device("cpu"))
        assert augmentations([f"random-rotation:{degrees}"], channels) is None


def test_a_new_augmentation_is_a_function_and_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def noise(strength: float, channels: Channels):  # type: ignore[no-untyped-def]
        return lambda x, random: x + strength * torch.randn(x.shape, generator=random)

    monkeypatch.setitem(AUGMENTATIONS, "noise", Augmentation(noise, 1.0, "standard deviations"))
    spec = preset("people", augment=["random-rotation:45", "noise:0.1"])
    assert spec.to_dict()["augment"] == ["random-rotation:45", "noise:0.1"] and "turn_deg" not in spec.to_dict()
    assert spec.key() != PRESETS["people"].key()
    augment = augmentations(spec.augment, Channels((), Scaler(np.zeros(3), np.ones(3)), torch.device("cpu")))
    assert augment is not None
    x = torch.zeros(2, 3, 50)
    out = augment(x, torch.Generator().manual_seed(0))
    assert 0.05 < float(out.std()) < 0.2 and float(x.abs().max()) == 0.0


@pytest.mark.parametrize("text", ["random-rotation", "random-rotation:x", "random-rotation:181", "random-rotation:-1"])
def test_a_strength_that_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"0 \(off\) to 180 degrees"):
        parse_augmentation(text)
