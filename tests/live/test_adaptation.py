"""One person's gestures move the dense layer, where that helps, and nothing else; what was moved can be moved back."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.errors import BadInput, BundleError, ConfigError
from plushsense.deploy.quantize import calibrated, integer_network
from plushsense.live.adaptation import (
    Examples,
    Personal,
    PersonalSpec,
    fit_dense,
    judge,
    personalise,
    restore_original,
)
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax

pytestmark = pytest.mark.slow

Make = Callable[..., Bundle]
SAMPLES = 48


def gestures(seed: int, each: int, classes: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raw windows (N, 3, T), classes and recordings: every class a movement of its own, one or two windows each."""
    draw = np.random.default_rng(seed)
    x, y, recording = [], [], []
    t = np.arange(SAMPLES)
    for k in range(classes):
        for _ in range(each):
            number = len(set(recording))
            phase = draw.uniform(0, 6)
            for _ in range(draw.integers(1, 3)):
                wave = 60 * np.sin(t * (0.05 + 0.25 * k) + phase)
                x.append(np.stack([wave, 30 * k + 0 * wave, -wave]) + draw.normal(0, 15, (3, SAMPLES)))
                y.append(k)
                recording.append(number)
    return np.round(np.array(x)).astype(np.int32), np.array(y), np.array(recording)


def touched(bundle: Bundle, seed: int = 1, each: int = 3, spec: PersonalSpec | None = None) -> Personal:
    return personalise(bundle, *gestures(seed, each), subject="S07", spec=spec)


def right(bundle: Bundle, seed: int = 2) -> float:
    x, y, recording = gestures(seed, 10)
    found = judge(bundle.network().probabilities(bundle.scaler.apply(x)), y, recording).scores
    return found.right / found.recordings


def test_other_recordings_of_the_person_are_read_better(bundle: Make) -> None:
    one = bundle()
    done = touched(one)
    assert done.accepted and done.after.right > done.before.right and done.after.log_loss < done.before.log_loss
    assert right(one) < 0.6 and right(done.bundle) > right(one) + 0.3
    assert done.used == one.gestures.labels and done.without == ()


def test_only_the_dense_layer_moves(bundle: Make) -> None:
    one, other = bundle(), touched(bundle()).bundle
    moved = {name for name in one.weights if not np.array_equal(one.weights[name], other.weights[name])}
    assert moved == {"dense.weight", "dense.bias"}
    assert replace(other, weights=one.weights, personal={}).to_bytes() == one.to_bytes()


def test_undo_gives_the_very_bytes(bundle: Make, tmp_path) -> None:
    one = bundle(smoothing_s=0.2)
    kept = Bundle.load(touched(one).bundle.save(tmp_path / "mine.plush"))
    assert kept.adapted_to == "S07" and "adapted to S07" in repr(kept)
    assert restore_original(kept).to_bytes() == one.to_bytes()
    with pytest.raises(BundleError, match="nothing to undo"):
        restore_original(one)


def test_adapting_twice_is_adapting_anew(bundle: Make) -> None:
    first = touched(bundle(), seed=5).bundle
    assert touched(first).bundle.to_bytes() == touched(bundle()).bundle.to_bytes()


def test_the_bundle_keeps_nothing_of_the_person_but_the_code_and_counts(bundle: Make) -> None:
    adapted = touched(bundle()).bundle
    kept, export = adapted.personal, adapted.without_people()
    assert set(kept) == {"subject", "recordings", "gestures", "strength", "leave_one_recording_out", "original"}
    assert "S07" not in repr(export.personal) and "original" not in export.personal
    assert export.adapted_to == "somebody"
    with pytest.raises(BundleError, match="an export leaves that out"):
        restore_original(export)


def test_recordings_with_wrong_labels_change_nothing(bundle: Make) -> None:
    one = bundle()
    x, _, recording = gestures(1, 4)
    draw = np.random.default_rng(0)
    for _ in range(5):
        labels = draw.permutation(np.repeat(np.arange(4), 4))
        done = personalise(one, x, labels[recording], recording, subject="S07")
        assert not done.accepted and done.bundle is one and "cannot be told apart" in done.reason


def test_without_a_clear_gain_it_stays_as_it_is(bundle: Make) -> None:
    one = bundle()
    done = touched(one, spec=PersonalSpec(margin=100.0))
    assert not done.accepted and done.bundle is one and "not clearly help" in done.reason


def test_a_bundle_that_knows_the_person_is_not_made_worse(bundle: Make) -> None:
    known = replace(touched(bundle(), seed=3, each=20).bundle, personal={})
    for seed in range(6):
        done = touched(known, seed=10 + seed, each=2)
        assert right(done.bundle) >= right(known) - 0.05


@pytest.mark.parametrize(("keep", "what"), [((0,), "hold"), ((), "tap")])
def test_too_few_recordings_are_refused_with_what_is_missing(bundle: Make, keep: tuple[int, ...], what: str) -> None:
    x, y, recording = gestures(1, 2)
    once = np.isin(y, keep) | (recording == recording[np.flatnonzero(y == 3)[0]])
    with pytest.raises(BadInput, match=f"too few.*{what}"):
        personalise(bundle(), x[once], y[once], recording[once], subject="S07")


def test_gestures_not_shown_stay_and_what_speaks_for_the_shown_ones_too(bundle: Make) -> None:
    one = bundle()
    x, y, recording = gestures(1, 3, classes=2)
    weight, bias = (one.weights[f"dense.{name}"].astype(float) for name in ("weight", "bias"))
    features = one.network().features(one.scaler.apply(x))
    moved, offset = fit_dense(weight, bias, Examples(features, y, recording), 0.1)
    assert np.array_equal(moved[2:], weight[2:]) and np.array_equal(offset[2:], bias[2:])

    def spoke(w: np.ndarray, b: np.ndarray) -> float:
        logits = np.log(np.exp(features @ w[:2].T + b[:2]).sum(axis=1))
        each = [logits[recording == r].mean() for r in np.unique(recording)]
        return float(np.mean(each))

    assert spoke(moved, offset) == pytest.approx(spoke(weight, bias), abs=1e-9)
    assert not np.allclose(moved[:2], weight[:2])


def test_it_is_the_maximum_a_posteriori(bundle: Make) -> None:
    """No small step from what was found is better, but for the shift of all classes alike, which changes no answer."""
    one, strength = bundle(), 0.3
    x, y, recording = gestures(1, 3)
    weight, bias = (one.weights[f"dense.{name}"].astype(float) for name in ("weight", "bias"))
    features = one.network().features(one.scaler.apply(x))
    count = np.array([1 / (3 * (recording == r).sum()) for r in recording])

    def cost(w: np.ndarray, b: np.ndarray) -> float:
        b = b - (b - bias).mean()
        losses = -np.log(softmax(features @ w.T + b)[np.arange(len(y)), y])
        return float((count * losses).sum() + strength / 2 * (((w - weight) ** 2).sum() + ((b - bias) ** 2).sum()))

    moved, offset = fit_dense(weight, bias, Examples(features, y, recording), strength)
    least, draw = cost(moved, offset), np.random.default_rng(0)
    assert least < cost(weight, bias) - 0.1
    for _ in range(200):
        step = 1e-3 * draw.normal(size=(4, weight.shape[1] + 1))
        assert cost(moved + step[:, :-1], offset + step[:, -1]) > least


def test_a_strong_pull_leaves_the_trained_weights(bundle: Make) -> None:
    one = bundle()
    x, y, recording = gestures(1, 3)
    weight, bias = (one.weights[f"dense.{name}"].astype(float) for name in ("weight", "bias"))
    examples = Examples(one.network().features(one.scaler.apply(x)), y, recording)
    far = [np.abs(fit_dense(weight, bias, examples, s)[0] - weight).max() for s in (0.1, 10.0, 1e6)]
    assert far[0] > far[1] > far[2] and far[2] < 1e-4


def test_long_recordings_count_no_more_than_short_ones(bundle: Make) -> None:
    one = bundle()
    x, y, recording = gestures(1, 3)
    weight, bias = (one.weights[f"dense.{name}"].astype(float) for name in ("weight", "bias"))
    examples = Examples(one.network().features(one.scaler.apply(x)), y, recording)
    again = np.concatenate([np.arange(len(y)), np.flatnonzero(recording == 0), np.flatnonzero(recording == 0)])
    once, more = fit_dense(weight, bias, examples, 0.3), fit_dense(weight, bias, examples.take(again), 0.3)
    assert np.allclose(once[0], more[0], atol=1e-6) and np.allclose(once[1], more[1], atol=1e-6)


def test_in_8_bits_the_adapted_layer_is_as_true_as_the_trained_one(bundle: Make) -> None:
    x = gestures(4, 20)[0]
    one = calibrated(bundle(), x)
    other = touched(one).bundle
    assert other.calibration == one.calibration
    for each in (one, other):
        said = each.network().forward(each.scaler.apply(x)).argmax(axis=1)
        assert (integer_network(each).forward(x).argmax(axis=1) == said).mean() > 0.97


@pytest.mark.parametrize(
    "bad", [{"strengths": ()}, {"strengths": (0.0,)}, {"least": 1}, {"margin": -1.0}, {"separation": 1.0}]
)
def test_settings_out_of_range(bad: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        PersonalSpec(**bad)


def test_no_pytorch_on_the_way() -> None:
    code = "import sys, plushsense.live.adaptation, plushsense.experiments.adaptation; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
