"""Explain a bundle on a data set: choose people, windows and gestures, and write the page."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput, BundleError, DatasetError, check_known, need, python_warning
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.version import __version__
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.experiments.people.explanation_report import explanation_page
from plushsense.experiments.people.occlusion import BLOCK_S, Blocks, ExplainedGesture, explain_gesture
from plushsense.jobs.journal import job_id
from plushsense.models.bundle import Bundle, known_people, trained_people
from plushsense.windows.cut import WindowSet, whole_gestures
from plushsense.workflow.preparation import Warn, windows_for
from plushsense.workflow.reporting import check_results

TABLE, PAGE = "explain.json", "explain.html"
WINDOWS = 20


def explain_id(bundle: Bundle, dataset: Dataset, gestures: Sequence[str] | None = None) -> str:
    """Return an identifier of 20 hexadecimal digits, equal for equal bundles, data and gestures."""
    digest = hashlib.sha256(bundle.to_bytes()).hexdigest()
    chosen = None if gestures is None else sorted(set(gestures))
    return job_id({"explanation": digest, "data": dataset.hash, "gestures": chosen, "settings": [BLOCK_S, WINDOWS]})


def explain(
    bundle: Bundle | str | os.PathLike[str],
    dataset: Dataset | str | os.PathLike[str],
    *,
    gestures: Sequence[str] | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    warn: Warn = python_warning,
) -> dict[str, Any]:
    """Explain a bundle's decisions on windows that it reads correctly, of people on whom it was not trained.

    At most 20 windows of each gesture are used, spread evenly over its recordings. If the bundle knows everybody, its
    validation people are used, or else all people, with a warning. Recordings of nobody, such as those at rest, are
    always used.

    Args:
        gestures: labels; by default all gestures of the bundle that are in the data set.
        out: a folder for ``explain.json`` and ``explain.html``; an error if it holds another explanation, unless
            ``overwrite``.

    Returns:
        ``sources``: names of the channels and vectors (S); ``edges_s``: times of the edges of the B blocks in seconds
        before the decision, (B + 1); ``gestures``: for each {gesture, windows, probability, attribution (S × B, means
        in nats), shares (of each source in the positive attribution), decided_s (the block with the highest sum,
        or None if no block supports the gesture),
        deletion {shares, attributed, random}, area, area_random, example, recording (of the example)}; ``area`` and
        ``area_random``: means over the gestures; ``unread``: gestures without a correctly read window.

    Raises:
        BundleError: if the data set has another layout; BadInput: for a gesture that the bundle or the data lacks.
        DatasetError: if no window is read correctly.
    """
    bundle = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    dataset = as_dataset(dataset).with_inputs(bundle.layout).with_gestures(bundle.gestures)
    chosen = _chosen_gestures(bundle, dataset, gestures, warn)
    identity = explain_id(bundle, dataset, gestures)
    if out is not None:
        need("matplotlib", extra="reports")
        check_results(Path(out), "An explanation", TABLE, identity, replace=overwrite)
    network = bundle.network()
    spec = whole_gestures(bundle.windowing)
    windows = windows_for(dataset, bundle.arch, spec, bundle.gestures.subset(chosen), warn)
    windows, trained_on = _people_not_met(windows, bundle, dataset, warn)
    explained: list[ExplainedGesture] = []
    unread = []
    for number, name in enumerate(windows.labels):
        label = bundle.gestures.index(name)
        at = np.flatnonzero(windows.y == number)
        x = windows.integers[at][:, :, -bundle.arch.span :]
        read = np.flatnonzero(network.forward(bundle.scaler.apply(x)).argmax(axis=1) == label) if len(at) else at
        if not len(read):
            unread.append(name)
            continue
        read = read[np.unique(np.linspace(0, len(read) - 1, WINDOWS).round().astype(np.int64))]
        found = explain_gesture(network, x[read], bundle, label, seed=label)
        used = at[read]
        found.row["recording"] = windows.recording_ids[windows.recording[used[found.row.pop("example")]]]
        found.row["people"] = sorted(set(windows.subject[used].tolist()) - {NOBODY})
        explained.append(found)
    if unread:
        warn(f"no window is read correctly of: {', '.join(unread)}")
    if not explained:
        raise DatasetError(
            f"The bundle reads no window of {', '.join(unread)} in '{dataset.head.name}' correctly, so nothing can "
            "be explained: choose other gestures, or train longer."
        )
    blocks = Blocks.of(bundle.layout, bundle.arch.span)
    rows = [each.row for each in explained]
    result: dict[str, Any] = {
        "sources": list(blocks.names),
        "edges_s": ((blocks.starts - bundle.arch.span) / bundle.layout.rate_hz).tolist(),
        "gestures": rows,
        "area": float(np.mean([row["area"] for row in rows])),
        "area_random": float(np.mean([row["area_random"] for row in rows])),
        "unread": unread,
        "trained_on": trained_on,
        "id": identity,
        "name": bundle.arch.title,
        "dataset": dataset.head.name,
        "simulated": dataset.head.simulated or bool(bundle.provenance.get("simulated")),
        "code_version": __version__,
    }
    if out is not None:
        page = explanation_page(result, explained, bundle.layout, blocks)
        with dataset.generation.writing():
            Path(out).mkdir(parents=True, exist_ok=True)
            write_file(Path(out) / PAGE, page)
            write_file(Path(out) / TABLE, json.dumps(result, ensure_ascii=False, indent=1))
    return result


def _chosen_gestures(bundle: Bundle, dataset: Dataset, gestures: Sequence[str] | None, warn: Warn) -> list[str]:
    """Return the gestures to explain, after checking that the bundle and the data set fit."""
    own, read = dataset.layout, bundle.layout
    if (own.channels, own.inputs, own.period_us) != (read.channels, read.inputs, read.period_us):
        raise BundleError(
            f"The bundle reads the layout '{read.name}' ({', '.join(read.inputs)} at {read.rate_hz:g} Hz), and "
            f"'{dataset.head.name}' has '{own.name}' ({', '.join(own.inputs)} at {own.rate_hz:g} Hz) or other offsets "
            "or ranges: give a data set of the same sensors."
        )
    there = {r.gesture for r in dataset.used}
    if gestures is None:
        if absent := [label for label in bundle.gestures.labels if label not in there]:
            warn(f"not in '{dataset.head.name}': {', '.join(absent)}")
        gestures = [label for label in bundle.gestures.labels if label in there]
        if not gestures:
            labels = ", ".join(bundle.gestures.labels)
            raise BadInput(f"'{dataset.head.name}' has no recording of a gesture of the bundle ({labels}).")
    elif not gestures:
        raise BadInput(f"No gesture is chosen: give some of {', '.join(bundle.gestures.labels)}.")
    for label in gestures:
        check_known(label, bundle.gestures.labels, "gesture of the bundle", BadInput)
        if label not in there:
            raise BadInput(f"'{dataset.head.name}' has no recording of '{label}': leave it out of --gestures.")
    return list(gestures)


def _people_not_met(windows: WindowSet, bundle: Bundle, dataset: Dataset, warn: Warn) -> tuple[WindowSet, bool]:
    """Return the windows of people on whom the bundle was not trained, or all windows and True if there are none.

    If everybody here is in the bundle's training or validation data, people of the validation data are used.
    """
    if not known_people(bundle.provenance):
        warn("the bundle does not say on whom it was trained: perhaps on these people")
    met = trained_people(bundle, dataset)
    # Of a network that was trained again on everybody, the validation people are training people, too.
    held_out = set(known_people(bundle.provenance, ["validation_subjects"]))
    held_out -= set(known_people(bundle.provenance, ["subjects"]))
    for known in (met, met - held_out):
        theirs = np.isin(windows.subject, sorted(known))
        people = sorted(set(windows.subject[~theirs].tolist()) - {NOBODY})
        if people:
            if known != met:
                warn(f"everybody here is known to the bundle: explained on its validation people, {', '.join(people)}")
            return windows.take(np.flatnonzero(~theirs)), False
    if theirs.any():
        warn("TRAINED ON: the bundle was trained on everybody here; the explanation need not hold for other people")
    return windows, bool(theirs.any())
