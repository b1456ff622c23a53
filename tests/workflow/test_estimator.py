"""PlushClassifier as users of scikit-learn meet it."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.errors import ArchError, ArrayError, BundleError, ConfigError
from plushsense.core.gestures import Gesture, GestureSet, load_gestures
from plushsense.core.layouts import load_layout
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_windows
from plushsense.models.reference import softmax
from plushsense.scoring.splits import Splitter, parse_split
from plushsense.windows.cut import WindowSpec

pytestmark = [pytest.mark.usefixtures("scikit_learn"), pytest.mark.apart("estimator")]
SRC = Path(__file__).resolve().parents[2] / "src"

TINY: dict[str, Any] = {"arch": "3", "filters": (4,), "padding": "causal", "epochs": 20, "learning_rate": 0.03}


def test_scikit_learns_own_checks() -> None:
    from sklearn.utils.estimator_checks import check_estimator

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # None of the checks is expected to fail, those of weights included: windows of 2 to 20 samples, in rows of one
        # channel.
        done = check_estimator(ps.PlushClassifier(), on_fail="raise")
    assert len(done) > 40 and {check["status"] for check in done} <= {"passed", "skipped"}


def waves(n: int = 60, seed: int = 0, samples: int = 60) -> tuple[Any, Any, Any]:
    """Slow and fast waves of two channels (N, 2, T), which is which, and whose of six people."""
    rng = np.random.default_rng(seed)
    y = np.arange(n) % 2
    t = np.arange(samples) / 20
    x = np.stack([np.sin(2 * np.pi * (1 + 3 * k) * t + rng.uniform(0, 6)) for k in y])[:, None, :]
    return np.concatenate([x, rng.normal(0, 0.1, x.shape)], axis=1), y, np.arange(n) // 2 % 6


def small(**settings: Any) -> ps.PlushClassifier:
    return ps.PlushClassifier(**{"arch": "9", "filters": (4,), "epochs": 15, "learning_rate": 0.03, **settings})


def test_it_learns_and_answers_in_every_form() -> None:
    x, y, _ = waves()
    test, truth, _ = waves(20, seed=1)
    model = small().fit(x, y)
    assert model.score(test, truth) > 0.9
    assert model.n_features_in_ == 120
    probabilities = model.predict_proba(test)
    assert np.allclose(probabilities.sum(axis=1), 1)
    assert np.array_equal(model.decision_function(test) > 0, model.predict(test) == 1)
    assert np.array_equal(model.predict_proba(test.reshape(20, -1)), probabilities), "rows are channel after channel"
    rows = small(channels=2).fit(x.reshape(60, -1), y)
    assert np.array_equal(rows.predict_proba(test), probabilities)
    three = small().fit(x, np.arange(60) % 3)
    assert three.decision_function(test).shape == (20, 3)
    assert np.allclose(softmax(three.decision_function(test)), three.predict_proba(test))


@pytest.mark.parametrize(
    "labels",
    [
        np.array(["slow", "fast"]),
        np.array([7, -2]),
        np.array([False, True]),
        np.array([1.0, 2.0]),
        np.array(["a", "A"]),
        np.array(["", "x"]),
        np.array(["slow", "fast"], dtype=object),
    ],
    ids=["text", "int", "bool", "float", "case", "empty", "object"],
)
@pytest.mark.exhaustive_for("bool", "case", "empty", "int")
def test_labels_keep_their_type(labels: Any, tmp_path: Path) -> None:
    x, y, _ = waves()
    model = small().fit(x, labels[y])
    assert set(model.classes_.tolist()) == set(labels.tolist())
    again = ps.PlushClassifier.from_bundle(model.save(tmp_path / "m.plush"))
    for one in (model, pickle.loads(pickle.dumps(model)), again):
        assert one.predict(x).dtype == model.classes_.dtype == labels.dtype
        assert one.score(x, labels[y]) > 0.9


def test_the_same_random_state_gives_the_same_bundle() -> None:
    from sklearn.base import clone

    x, y, _ = waves()
    one, two, other = (small(random_state=s).fit(x, y).bundle_.to_bytes() for s in (3, 3, 4))
    assert one == two != other
    first, second = (small(random_state=np.random.RandomState(5)).fit(x, y) for _ in range(2))
    assert first.bundle_.to_bytes() == second.bundle_.to_bytes()
    assert np.array_equal(
        clone(first.set_params(random_state=3)).fit(x, y).predict_proba(x),
        small(random_state=3).fit(x, y).predict_proba(x),
    )


def test_whole_numbers_are_read_as_they_are_and_floats_finely_at_any_scale() -> None:
    x, y, _ = waves()
    counts = np.round(5000 * x).astype(np.int32)
    model = small().fit(counts, y)
    assert [c.step for c in model.bundle_.layout.channels] == [1.0, 1.0]
    assert np.array_equal(model.bundle_.scaler.offset, counts.mean(axis=(0, 2)))
    assert np.allclose(
        small().fit(counts.astype(float), y).predict_proba(x * 5000), model.predict_proba(counts), atol=1e-3
    )
    plain = small().fit(x, y).predict_proba(x)
    for moved in (1e-9 * x, 1e12 * x, 1000.0 + x, np.float32(3) * x.astype(np.float32)):
        assert np.allclose(small().fit(moved, y).predict_proba(moved), plain, atol=0.01)
    flat = np.where([[True], [False]], x, 0.1)
    assert small().fit(flat, y).score(flat, y) > 0.9, "a constant channel does no harm"
    assert np.isfinite(model.predict_proba(1e12 * x)).all()
    assert small().fit(1000.0 + x, y).bundle_.layout.channels[0].step <= x[:, 0].std() / 2**16


def test_short_windows_get_a_shorter_default_network_and_are_told_so() -> None:
    x, y, _ = waves()
    with pytest.warns(UserWarning, match=r"windows of 60 samples, fewer than .* shortened to 4_10_18") as noted:
        model = small(arch=None, filters=(4, 4, 4), epochs=1).fit(x, y)
    assert [w.filename for w in noted] == [__file__]
    assert model.bundle_.arch.symbol == "4_10_18"
    assert (model.bundle_.arch.receptive_field, model.bundle_.arch.span) == (30, 59)
    assert model.predict(x).shape == (60,)
    long = np.tile(x, 3)[:, :, :122]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = small(arch=None, filters=(4, 4, 4), epochs=1).fit(long, y)
    assert (model.bundle_.arch.symbol, model.bundle_.arch.span) == ("14d1_19d2_19d4", 122), "just long enough"
    for samples in (60, 79):
        with pytest.raises(ArrayError, match=f"{samples} samples, but 80 with padding 'stream' needs at least 80:"):
            small(arch="80", epochs=1).fit(long[:, :, :samples], y)
    assert small(arch="80", epochs=1).fit(long[:, :, :80], y).bundle_.arch.span == 80
    with pytest.warns(UserWarning, match="60 samples, but 80 with padding 'mirror' needs at least 80:"):
        small(arch="80", padding="mirror", epochs=1).fit(x, y)


def test_weights_count_windows_and_their_order_does_not_matter() -> None:
    x, y, people = waves()
    rng = np.random.default_rng(2)
    weights = rng.integers(0, 4, 60)
    repeats, shuffled = np.repeat(np.arange(60), weights), rng.permutation(60)
    plain = small(epochs=5).fit(x[repeats], y[repeats]).predict_proba(x)
    weighted = small(epochs=5).fit(x[shuffled], y[shuffled], sample_weight=weights[shuffled])
    assert np.array_equal(weighted.predict_proba(x), plain)
    rare = small(epochs=5, class_weight={0: 0.01}).fit(x, y, sample_weight=np.full(60, 1e-3))
    assert rare.predict(x).mean() > 0.9, "class 0 hardly counts, and the scale of all weights not at all"
    held = small(epochs=2, preset="loso").fit(x, y, groups=people, sample_weight=weights + 0.5).history_
    assert held[-1]["validation_loss"] is not None


def test_balanced_classes_count_alike() -> None:
    from plushsense.workflow.estimator import balanced_by_class

    y, weights = np.array(["a", "a", "a", "b"]), np.array([1.0, 1.0, 2.0, 1.0])
    assert balanced_by_class(weights, y, "balanced").tolist() == [0.625, 0.625, 1.25, 2.5]
    assert balanced_by_class(weights, y, {"b": 3.0}).tolist() == [1.0, 1.0, 2.0, 3.0]
    for wrong in ("equal", {"a": -1.0}, {"a": 0.0, "b": 0.0}):
        with pytest.raises(ValueError, match="class_weight"):
            balanced_by_class(weights, y, wrong)


def test_groups_choose_folds_and_who_decides_when_to_stop() -> None:
    from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

    x, y, people = waves()
    scores = cross_val_score(small(), x, y, groups=people, cv=LeaveOneGroupOut(), error_score="raise")
    assert len(scores) == 6
    assert scores.mean() > 0.9
    stopped = small(preset="loso").fit(x, y, groups=people).bundle_.provenance
    assert len(stopped["validation_subjects"]) == 1
    assert set(stopped["subjects"]) | set(stopped["validation_subjects"]) == {str(p) for p in range(6)}
    assert small().fit(x, y, groups=people).bundle_.provenance["validation_subjects"] == [], "nobody is held back"


def test_metadata_routing_brings_groups_to_fit() -> None:
    import sklearn
    from sklearn.model_selection import GroupKFold, cross_val_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    x, y, people = waves()
    seen: list[Any] = []

    class Watched(ps.PlushClassifier):
        def fit(self, X: Any, y: Any, groups: Any = None) -> Any:
            seen.append(groups)
            return super().fit(X, y, groups=groups)

    with sklearn.config_context(enable_metadata_routing=True):
        for model in (Watched(**TINY), Watched(**TINY).set_fit_request(groups=False)):
            cross_val_score(model, x, y, params={"groups": people}, cv=GroupKFold(3), error_score="raise")
        chain = make_pipeline(StandardScaler(), Watched(channels=2, **TINY))
        cross_val_score(chain, x.reshape(60, -1), y, params={"groups": people}, cv=GroupKFold(3), error_score="raise")
    told = [g is not None for g in seen]
    assert told == [True] * 3 + [False] * 3 + [True] * 3
    assert all(len(np.unique(g)) == 4 for g in seen if g is not None)


def test_pipelines_and_grids() -> None:
    from sklearn.model_selection import GridSearchCV, GroupKFold
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    x, y, people = waves()
    chain = make_pipeline(StandardScaler(), small(channels=2))
    grid = {
        "plushclassifier__arch": ["9", "3_3"],
        "plushclassifier__filters": [(4, 4), "2,2"],
        "plushclassifier__epochs": np.array([1, 12]),
    }
    found = GridSearchCV(chain, grid, cv=GroupKFold(2), error_score="raise").fit(x.reshape(60, -1), y, groups=people)
    assert found.best_score_ > 0.9
    assert found.best_params_["plushclassifier__epochs"] == 12
    assert len(found.cv_results_["params"]) == 8


def test_a_classifier_of_cut_windows_is_a_bundle_that_reads_the_toy(
    dataset: Dataset, recordings: Path, tmp_path: Path, cli: Any
) -> None:
    from sklearn.base import clone
    from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

    windows = ps.cut_windows(dataset)
    y = np.array(windows.labels)[windows.y]
    model = ps.PlushClassifier(filters=(4, 4, 4), epochs=10, layout=dataset.layout)
    assert len(cross_val_score(model, windows.x, y, groups=windows.subject, cv=LeaveOneGroupOut())) == 5
    path = model.fit(windows.x, y, groups=windows.subject).save(tmp_path / "m.plush", gestures=dataset.gestures)
    bundle = ps.load(path)
    assert bundle.layout == dataset.layout
    assert bundle.gestures.labels == tuple(model.classes_)
    assert bundle.provenance["subjects"] == sorted(dataset.subjects)
    reference = bundle.network().probabilities(bundle.scaler.apply(windows.integers))
    ours = model.predict_proba(windows.x)
    assert np.abs(reference - ours).max() < 1e-5

    from plushsense.training.fit import predict

    torch = predict(bundle.arch, dict(bundle.weights), bundle.scaler, windows)
    assert np.abs(torch - ours).max() < 1e-5
    again = ps.PlushClassifier.from_bundle(path)
    assert np.array_equal(again.predict_proba(windows.x), ours)
    assert clone(again).get_params()["epochs"] == 10
    stream = recordings / "P1" / "fulldatastream.csv"
    ran = cli("live", "--device", f"replay://{stream}?speed=0&layout=accel-3", "--model", path, "--json")
    assert ran.status == 0, ran.err
    assert '"tracking"' in ran.out


def test_a_network_with_a_vector_layer_trains_as_evaluate_trains_it(dataset: Dataset) -> None:
    windows = ps.cut_windows(dataset.with_inputs(dataset.layout.for_vectors()))
    settings: dict[str, Any] = {"arch": "v4_5", "filters": (3, 4), "epochs": 1, "layout": dataset.layout.for_vectors()}
    for given, batch in (({}, 32), ({"batch": 64}, 64), ({"preset": "search"}, 64)):
        trained = ps.PlushClassifier(**settings, **given).fit(windows.x, windows.y).bundle_.provenance["training"]
        tempo = "random-tempo:0.3" in trained.get("augment", ())
        assert (trained["batch"], tempo) == (batch, "preset" not in given)


def test_a_splitter_gives_the_folds_of_an_evaluation(dataset: Dataset) -> None:
    from sklearn.model_selection import cross_val_score

    windows = ps.cut_windows(dataset, WindowSpec(context="loop"))
    for split in ("leave-one-subject-out", "by-subject:2", "by-recording:3", "windows:4"):
        cv = Splitter(split, windows.subject, windows.recording, seed=3)
        ours = [test.tolist() for _, test in cv.split(windows.x, windows.y)]
        assert ours == [fold.test.tolist() for fold in fold_windows(windows, windows, parse_split(split), 3)]
    model = ps.PlushClassifier(filters=(2, 2, 2), epochs=1, layout=dataset.layout)
    cv = Splitter("by-subject:2", windows.subject, windows.recording)
    assert len(cross_val_score(model, windows.x, windows.y, cv=cv, error_score="raise")) == 2


def test_any_bundle_becomes_a_classifier(bundle: Path, dataset: Dataset) -> None:
    loaded = ps.load(bundle)
    windows = ps.cut_windows(dataset.with_inputs(loaded.layout))
    model = ps.PlushClassifier.from_bundle(bundle)
    assert model.classes_.tolist() == list(loaded.gestures.labels)
    expected = loaded.network().probabilities(loaded.scaler.apply(windows.integers))
    assert np.allclose(model.predict_proba(windows.x), expected)
    assert set(model.predict(windows.x)) <= set(windows.labels)


def test_affects_come_from_the_gesture_set() -> None:
    x, y, _ = waves()
    model = small().fit(x, np.array(["Tail pull", "head stroke 1"])[y])
    assert model.to_bundle().gestures.affects == ("none", "none")
    named = model.to_bundle(load_gestures("plush-18"))
    assert (named.gestures.labels, named.gestures.affects) == (("Tail pull", "head stroke 1"), ("negative", "positive"))


def test_a_pickle_holds_a_bundle_and_nothing_of_pytorch(tmp_path: Path) -> None:
    x, y, _ = waves()
    model = small().fit(x, y)
    data = pickle.dumps(model)
    assert b"torch" not in data
    assert model.bundle_.to_bytes() in data
    assert np.array_equal(pickle.loads(data).predict_proba(x), model.predict_proba(x))
    (tmp_path / "m.pickle").write_bytes(data)
    np.save(tmp_path / "x.npy", x)
    code = (
        "import sys, pickle\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': raise ModuleNotFoundError('no torch', name='torch')\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "import numpy as np\n"
        "model, x = pickle.load(open('m.pickle', 'rb')), np.load('x.npy')\n"
        "print(model.score(x, np.arange(60) % 2))\n"
        "from plushsense.core.errors import MissingExtraError\n"
        "try:\n    model.fit(x, np.arange(60) % 2)\n"
        "except MissingExtraError as error:\n    print(error)\n"
    )
    out = alone(code, tmp_path)
    assert float(out.splitlines()[0]) > 0.9
    assert "pip install 'plushsense[train]'" in out


def test_without_scikit_learn_the_name_loads_and_the_class_says_what_to_install(tmp_path: Path) -> None:
    code = (
        "import sys; import plushsense as ps\n"
        "assert not {'numpy', 'sklearn', 'torch'} & set(sys.modules)\n"
        "sys.modules['sklearn'] = None\n"
        "from plushsense import *\n"
        "try:\n    PlushClassifier()\nexcept ps.core.errors.MissingExtraError as error:\n    print(error)\n"
    )
    assert "pip install 'plushsense[baselines]'" in alone(code, tmp_path)


def alone(code: str, where: Path) -> str:
    """What a Python of its own prints."""
    paths = os.pathsep.join([str(SRC), os.environ.get("PYTHONPATH", "")])
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=where, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_what_does_not_fit_is_refused_in_a_sentence() -> None:
    from sklearn.exceptions import NotFittedError

    x, y, people = waves()
    rows = x.reshape(60, -1)
    holes = x.copy()
    holes[4, 1, 7] = np.nan
    accel = load_layout("accel-3")
    three = np.round(1000 * np.concatenate([x, x[:, :1]], axis=1))
    for match, model, X, labels, groups in (
        (r"1 of 60 windows, first in window 4, channel 1, sample 7", small(), holes, y, None),
        (r"NaN or infinity in 60", small(), np.full_like(x, np.inf), y, None),
        (r"expected \(N, C, T\)", small(), x[None], y, None),
        (r"n_features = 120, and 7 channels", small(channels=7), rows, y, None),
        (r"windows of 2 channels .*expected is .*3 channels, as channels or layout say", small(channels=3), x, y, None),
        (r"channels is 0", small(channels=0), rows, y, None),
        (r"channels is 2, but the layout 'accel-3' has 3", small(channels=2, layout=accel), three, y, None),
        (
            r"-628.5 in 'x', which the layout 'accel-3' counts in steps of 1",
            small(layout="accel-3"),
            three + 0.5,
            y,
            None,
        ),
        (r"beyond 32 bits", small(layout="accel-3"), three * 1e9, y, None),
        (r"at least 2 samples", small(channels=120), rows, y, None),
        (r"1 class with a weight \(0\)", small(), x, np.zeros(60, dtype=int), None),
        (r"groups has the shape \(59,\)", small(), x, y, people[:-1]),
        (r"60 channels of 2 samples.*swapaxes\(X, 1, 2\), or channels=60", small(), x.swapaxes(1, 2), y, None),
        (r"60 channels of 2 samples.*swapaxes\(X, 1, 2\)\.", small(channels=2), x.swapaxes(1, 2), y, None),
        (r"Unknown label type", small(), x, y + 0.5 * np.pi * np.arange(60), None),
    ):
        with pytest.raises(ValueError, match=match) as refused:
            model.fit(X, labels, groups=groups)
        if "label type" not in match:
            assert isinstance(refused.value, ArrayError)
    for kind, match, settings in (
        (ConfigError, "Unknown preset 'peple'", {"preset": "peple"}),
        (ConfigError, "epochs is 0", {"epochs": 0}),
        (ArchError, "filter counts", {"arch": "3_3"}),
    ):
        with pytest.raises(kind, match=match):
            small(**settings).fit(x, y)
    with pytest.raises(NotFittedError):
        small().predict(x)
    with pytest.raises(NotFittedError):
        small().to_bundle()
    model = small().fit(x, y)
    with pytest.raises(ArrayError, match=r"\(60, 1, 60\): expected \(N, 2, 60\), as in fit"):
        model.predict(x[:, :1])
    with pytest.raises(ValueError, match="expecting 120 features"):
        model.predict(rows[:, :60])
    with pytest.raises(ArrayError, match="window 4"):
        model.predict(holes)
    with pytest.raises(ArrayError, match=r"\(60, 60, 2\): expected .* give np.swapaxes"):
        model.predict(x.swapaxes(1, 2))
    for weights, match in (
        (np.ones(59), "shape"),
        (-np.ones(60), "Negative"),
        (np.zeros(60), "non-zero|0 class"),
    ):
        with pytest.raises(ValueError, match=match):
            model.fit(x, y, sample_weight=weights)


def test_forget_finds_a_classifier_that_was_told_whose_windows_they_are(dataset: Dataset, tmp_path: Path) -> None:
    from plushsense.workflow.forgetting import trained_on

    windows = ps.cut_windows(dataset)
    model = ps.PlushClassifier(filters=(2, 2, 2), epochs=1, layout="accel-3")
    model.fit(windows.x, windows.y, groups=windows.subject).save(tmp_path / "m.plush")
    found = trained_on(dataset.path, "P2", [tmp_path])
    assert [f.certain for f in found] == [False]
    assert "arrays given to PlushClassifier" in found[0].message


@pytest.mark.parametrize("dtype", [65536, "V99999999", "x", None, "<U999999"])
def test_class_labels_that_do_not_fit_are_refused(dtype: object) -> None:
    from plushsense.workflow.estimator import labels_from

    gestures = GestureSet("two", (Gesture("a"), Gesture("b")))
    provenance = {"estimator": {"labels": ["a", "b"], "dtype": dtype}}
    with pytest.raises(BundleError):
        labels_from(SimpleNamespace(provenance=provenance, gestures=gestures))  # type: ignore[arg-type]


def test_windows_of_different_lengths_get_a_way_out() -> None:
    import pandas as pd

    x, y, _ = waves(20)
    uneven = [w[:, : 60 - k % 3] for k, w in enumerate(x)]
    cells = np.empty((20, 2), dtype=object)
    held = np.empty(20, dtype=object)
    for k, w in enumerate(uneven):
        held[k], cells[k, 0], cells[k, 1] = w, *w
    nested = pd.DataFrame({name: [pd.Series(row) for row in cells[:, c]] for c, name in enumerate("ab")})
    for windows in (uneven, held, cells, [w.tolist() for w in uneven], nested, [[w[0], w[1][:50]] for w in x]):
        with pytest.raises(ArrayError, match=r"of different lengths.*np\.stack\(\[w\[:, :n\] for w in X\]\)"):
            small().fit(windows, y)
    model = small(epochs=1).fit(x, y)
    with pytest.raises(ArrayError, match="different lengths"):
        model.predict(uneven)
    for windows in (list(x), [w.tolist() for w in x]):
        np.testing.assert_array_equal(model.predict_proba(windows), model.predict_proba(x))


def test_fractions_where_whole_numbers_were_trained_on_are_reported() -> None:
    x, y, _ = waves(20)
    model = small(epochs=1).fit(np.rint(100 * x).astype(int), y)
    with pytest.warns(UserWarning, match="X has fractions, but the windows in fit were whole numbers"):
        model.predict(x)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(np.rint(100 * x))
        small(epochs=1).fit(x, y).predict(x + 0.001)
