"""A new metric is a function and a line in ``METRICS``: evaluation, text, report and sweep tables follow."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import numpy as np
from plushsense.scoring import metrics
metrics.METRICS["kappa"] = metrics.Metric(lambda counts: 0.25, "kappa")

from plushsense.cli.evaluate import lines
from plushsense.evaluation.crossval import compare_deployed
from plushsense.evaluation.scores import FoldRecord, Predictions, compute_scores
from plushsense.experiments.sweep import tables as sweep
from plushsense.reports import evaluation as report
from plushsense.experiments.sweep import folder, trials

n = 12
subject = np.repeat(["P1", "P2"], n // 2)
rng = np.random.default_rng(0)
read = Predictions(
    ("a", "b"), subject, np.arange(n).astype(str), np.zeros(n, np.int64), np.repeat("stream", n), subject,
    rng.integers(0, 2, n), rng.dirichlet((1.0, 1.0), n).astype(np.float32),
)
folds = [FoldRecord(name, (name,), (6, 0, 6), 1, 0.0) for name in ("P1", "P2")]
found = compute_scores(read, folds, ("positive", "negative"), True)
int8 = compare_deployed(found, found, read, read)
found = {**found.to_json(), "int8": int8.to_json()}
assert found["kappa"]["mean"] == found["pooled"]["kappa"] == found["by_recording"]["kappa"] == 0.25
assert found["subjects"][0]["kappa"] == found["folds"][1]["kappa"] == 0.25
assert found["int8"]["loss"]["kappa"]["mean"] == 0.0 and found["int8"]["rows"][0]["kappa_int8"] == 0.25
head = {"split": "by-subject:2", "context": "stream", "train_context": "stream", "seeds": [0], "leaky": False}
text = "\\n".join(lines({**head, "simulated": False, **found}))
assert "kappa           0.250" in text and "kappa lost          0.000" in text
assert report.metric_table({**head, **found}).rows[-2]["name"] == "Kappa"
assert report._subject_rows([found])[0]["cells"][0]["kappa"] == "0.25"
assert len(report._comparison_rows([{**head, **found, "title": "t"}])[0]["scores"]) == 3
assert {"kappa", "kappa_sd"} <= trials.TRIAL_COLUMNS.keys() and "kappa" in folder._RUN_COLUMNS
assert "Kappa" in [c.head for c in trials.listed_columns(terminal=True)]
assert "Kappa" in [c.head for c in sweep._metric_columns(without="accuracy")]
"""


def test_a_new_metric_is_a_function_and_a_line() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
