"""The page of a check: complete in itself, escaped, bounded, and with the odd recordings named."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.quality.checking import CheckReport, check
from plushsense.dataset.statistics import duration_bands
from plushsense.dataset.trimming import suggest_trims
from plushsense.reports import figures, quality, quality_figures
from plushsense.reports.quality_figures import trim_page
from plushsense.windows.cut import WindowSpec, cut_windows

pytestmark = pytest.mark.slow

ACCEL = load_layout("accel-3")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> CheckReport:
    """Six people; one recording never stopped, one with a gap, one stuck; a label that would break a page."""
    folder = tmp_path_factory.mktemp("page")
    rng = np.random.default_rng(0)
    for person in range(6):
        where = folder / "src" / f"P{person + 1}"
        where.mkdir(parents=True)
        at = 1000
        parts = []
        for k, label in enumerate(("Wave & <b>", "Wave & <b>", "Tap", "Tap")):
            rows = 3000 if (person, k) == (1, 0) else 200 + int(rng.integers(0, 20))
            wave = 4000 * np.sin(np.arange(rows) / 9) * np.sin(np.pi * np.arange(rows) / rows) ** 2
            values = np.rint(np.outer(wave, [1, 0.5, -0.3]) + rng.normal(0, 60, (rows, 3))).astype(np.int64)
            clock = at + np.arange(rows, dtype=np.int64) * 10
            if (person, k) == (2, 0):
                clock[90:] += 400
            if (person, k) == (3, 2):
                values[30:190, 1] = 7
            at = int(clock[-1]) + 2000
            frames = Frames(values, clock, clock + 10**12)
            parts.append(frames)
            write_recording(where / recording_filename(label, 10**12 + at, rows), frames, ACCEL)
        stream = Frames(
            np.concatenate([p.values for p in parts]),
            np.concatenate([p.device_ms for p in parts]),
            np.concatenate([p.device_ms for p in parts]) + 10**12,
        )
        (where / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    return check(import_recordings(folder / "src", folder / "DS", layout=ACCEL, name="<script>").dataset)


@pytest.fixture(scope="module")
def page(result: CheckReport) -> str:
    return quality.render(result)


def test_the_page_asks_for_nothing_outside_itself(page: str) -> None:
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)
    assert "<script" not in page
    assert "&lt;script&gt;" in page, "the data set's name is shown, escaped"
    assert '<meta name="generator" content="PlushSense">' in page


def test_each_finding_is_there_and_what_needs_a_decision_first(result: CheckReport, page: str) -> None:
    assert {"never-stopped", "gaps", "stuck"} <= {f.check for f in result.findings}
    for name in {f.check for f in result.findings}:
        assert f'<h2 id="{name}">' in page
    shares = re.search(
        r'#gaps">gaps</a></td><td class="n">(\d*)</td><td class="n">(\d*)</td><td class="n">(\d*)</td>', page
    )
    assert shares is not None
    assert sum(int(n or 0) for n in shares.groups()) == len(result.findings_of("gaps"))
    decide = page[page.index("<h2>To decide</h2>") : page.index("<h2>Gesture by gesture</h2>")]
    for f in result.undecided:
        assert f.recording.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;") in decide
    overlays = page[page.index("<h2>Gesture by gesture</h2>") : page.index('<h2 id="')]
    assert overlays.count("<img") == 2, "a picture a gesture"


def test_the_odd_recordings_are_named_in_the_overlay(result: CheckReport) -> None:
    (gesture,) = [f.gesture for f in result.findings_of("never-stopped")]
    figure = quality.gesture_figure(result, gesture)
    legend = figure.axes[0].get_legend()
    assert legend is not None
    named = [text.get_text() for text in legend.get_texts()]
    assert any("P2/" in n and "never-stopped" in n for n in named)
    assert len(figure.axes[0].lines) == 12, "a line a recording"
    _, high = figure.axes[0].get_xlim()
    assert high < 10, "the one of 30 s does not squeeze the others"


def test_accepted_findings_are_not_named(result: CheckReport) -> None:
    accepted = replace(result, findings=tuple(replace(f, accepted=True) for f in result.findings))
    (gesture,) = {f.gesture for f in result.findings_of("never-stopped")}
    assert quality.gesture_figure(accepted, gesture).axes[0].get_legend() is None
    page = quality.render(accepted)
    assert page.count('<tr class="accepted">') == len(result.findings)


@pytest.mark.exhaustive
def test_pictures_are_bounded_and_the_page_says_so(result: CheckReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "PICTURE_BYTES", 150_000)
    page = quality.render(result)
    assert len(page) < 300_000
    left_out = re.search(r"<strong>(\d+) pictures were left out</strong>", page)
    assert left_out is not None
    assert int(left_out[1]) > 0
    assert "This picture was left out" in page


def test_a_check_is_drawn_so_often_at_most(result: CheckReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "PLOTS", 1)
    (gaps,) = [s for s in re.split("<h2 ", quality.render(result)) if s.startswith('id="gaps"')]
    assert gaps.count("<img") == 2, "the clock and the signal of one recording"
    assert "6 more findings of this check are not drawn" in gaps


def test_the_place_is_marked_in_rows_of_the_file(result: CheckReport) -> None:
    (stuck,) = [f for f in result.findings_of("stuck") if f.recording]
    info = next(r for r in result.dataset.recordings if r.id == stuck.recording)
    frames = result.dataset.read(info)
    figure = quality_figures.signals(frames, ACCEL, stuck.rows, stuck.channels)
    (axes,) = figure.axes
    assert [line.get_label() for line in axes.lines if not line.get_label().startswith("_")] == ["y"]
    (span,) = axes.patches
    assert (span.get_x(), span.get_x() + span.get_width()) == (31, 190)


def test_the_durations_are_those_of_the_review_page(result: CheckReport, page: str) -> None:
    bands = duration_bands(result.dataset)
    axes = quality_figures.durations(bands).axes[0]
    drawn = [[float(x) for x in line.get_xdata()] for line in axes.lines if line.get_marker() in ("o", "D", ">")]
    assert sum(map(len, drawn)) == len(result.dataset.used)
    outside = [x for line in axes.lines if line.get_marker() in ("D", ">") for x in line.get_xdata()]
    assert len(outside) == sum(len(b.outliers) for b in bands) >= 1
    assert max(outside) == pytest.approx(axes.get_xlim()[1], rel=0.01) and max(outside) < max(
        b.statistics.max for b in bands
    ), "never stopped: at the edge"
    assert [t.get_text() for t in axes.get_yticklabels()] == [f"{b.gesture} ({len(b.seconds)})" for b in bands]
    boxes = [(p.get_x(), p.get_x() + p.get_width()) for p in axes.patches]
    assert boxes == [(pytest.approx(b.low_s), pytest.approx(b.high_s)) for b in bands]
    assert "duration" in axes.get_xlabel() and axes.get_xlabel().endswith("(s)")
    for row, band in zip(quality.duration_rows(bands).rows, bands, strict=True):
        assert (row["mean"], row["median"]) == (band.mean_s, band.statistics.median)
        assert (row["low"], row["high"], row["outside"]) == (band.low_s, band.high_s, len(band.outliers))
    assert page.count("<h2>Durations</h2>") == 1


def test_a_short_recording_is_drawn_as_it_is_looped_and_a_long_one_as_it_is_cut(result: CheckReport) -> None:
    dataset, spec = result.dataset, WindowSpec(context="loop")
    (short,) = quality.example_recordings(dataset, spec)
    figure, said = quality_figures.windows(dataset, short, spec)
    top, rows = figure.axes
    (own, again, edge) = top.lines
    windows = cut_windows(dataset, spec)
    (mine,) = np.flatnonzero(windows.recording == windows.recording_ids.index(short.id))
    assert [*own.get_ydata(), *list(again.get_ydata())[1:]] == windows.x[mine, 0].tolist(), "what is trained on"
    samples = len(own.get_xdata())
    assert edge.get_xdata()[0] == samples / 100 and len(rows.patches) == 1
    assert f"{samples} samples at 100 Hz give 1 window of 250 samples, filled by repeating" in said
    assert "count" in top.get_ylabel() and rows.get_xlabel() == "seconds since the start of the recording"

    long = max(dataset.used, key=lambda r: r.rows)
    figure, said = quality_figures.windows(dataset, long, spec)
    all_windows = cut_windows(dataset, replace(spec, longest_factor=0.0))
    number = int((all_windows.recording == all_windows.recording_ids.index(long.id)).sum())
    bars = figure.axes[1].patches
    assert len(bars) == number == 56 and f"give {number} windows of 250 samples, one every 50 samples" in said
    assert [(bar.get_x(), bar.get_width()) for bar in bars] == [(pytest.approx(i / 2), 2.5) for i in range(number)]


def test_the_report_of_a_data_set_shows_durations_and_windows(cli: Any, result: CheckReport, tmp_path: Path) -> None:
    path = result.dataset.path
    assert cli("report", tmp_path / "r.html", "--dataset", path).status == 0
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "the paper&#39;s Figure 3" in page or "the paper's Figure 3" in page
    assert page.count("filled by repeating the recording") == 1 and "<script" not in page
    longest = max(result.dataset.used, key=lambda r: r.rows).id
    assert cli("report", tmp_path / "r.html", "--dataset", path, "--recording", longest).status == 0
    assert "give 56 windows" in (tmp_path / "r.html").read_text(encoding="utf-8")
    wrong = cli("report", tmp_path / "r.html", "--dataset", path, "--recording", "P1/none")
    assert wrong.status == 2 and "P1/none" in wrong.err


def test_the_same_data_give_the_same_bytes(result: CheckReport) -> None:
    gesture = result.dataset.gestures.labels[0]
    assert figures.png(quality.gesture_figure(result, gesture)) == figures.png(quality.gesture_figure(result, gesture))


@pytest.mark.filterwarnings("error")
def test_a_recording_of_one_row_is_drawn_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "src" / "bo").mkdir(parents=True)
    one = Frames(np.array([[1, 2, 3]]), np.array([5]), np.array([10**12]))
    write_recording(tmp_path / "src" / "bo" / "Tap_1000000000000_1.csv", one, ACCEL)
    dataset = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset
    assert "<h3>Tap</h3>" in quality.render(check(dataset))
    assert figures.png(trim_page(dataset, suggest_trims(dataset))).startswith(b"\x89PNG")
