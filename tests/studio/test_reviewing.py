"""Reviewing without a browser: what stands, decisions and their undoing, filters, what is kept, what is drawn."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, MarkState, append_marks, read_marks
from plushsense.dataset.trimming import TrimDecisions, decide_trims, suggest_trims
from plushsense.studio.app.selections import Selections
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.review import signals as review_signals
from plushsense.studio.pages.review.controller import DONE, NO_FINDING, TO_DO, RecordingFilter, filter_and_sort
from plushsense.studio.pages.review.review import Review, Reviews
from plushsense.studio.pages.review.signals import ACTIVITY, ALL
from support.reviewed import ROW_S, made, marks, raw_hash

ME, VISIT = "me", "visit"


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    made(tmp_path / "home" / "datasets" / "waves", people=2, waves=5)
    workspace = Workspace(tmp_path / "home")
    yield workspace
    workspace.close()


@pytest.fixture
def review(workspace: Workspace) -> Review:
    review = workspace.part(Reviews).open("datasets/waves")
    review.prepared.wait(60.0)
    assert review.prepared.checked is not None
    return review


def waves(review: Review) -> list[str]:
    return [i for i, info in review.infos.items() if info.gesture == "Wave"]


def test_what_is_suggested_is_the_librarys(review: Review) -> None:
    dataset = open_dataset(review.path)
    for trim in suggest_trims(dataset):
        assert review.trim(trim.recording.id).suggestion == trim.suggestion
        row = review.rows[trim.recording.id]
        assert row.state == trim.state
        assert row.seconds == pytest.approx(trim.seconds[-1], abs=0.02)


def test_suggestions_are_kept_and_not_made_again(
    workspace: Workspace, review: Review, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object) -> None:
        raise AssertionError("made again although nothing changed")

    monkeypatch.setattr(review_signals, "suggest_trims", refuse)
    again = Review(review.path)
    again.prepared.wait(60.0)
    assert again.prepared.suggestions == review.prepared.suggestions
    assert again.prepared.shapes == review.prepared.shapes


def test_accepting_marks_the_suggestion_and_undo_brings_all_back(review: Review) -> None:
    before = raw_hash(review.path)
    first, second, third = waves(review)[:3]
    suggested = review.trim(first).suggestion.start
    assert review.accept(VISIT, first, ME)
    assert not review.accept(VISIT, first, ME), "it stands already"
    review.set(second, start=20)
    assert review.rows[second].state == "draft"
    assert review.accept(VISIT, second, ME)
    assert review.exclude(VISIT, [third], ME, "broken off")
    said = [(m["recording"], m["action"], m["start"], m["how"], m["who"], m["why"]) for m in marks(review.path)]
    assert said == [
        (first, "trim", suggested, "suggested", ME, ""),
        (second, "trim", 20, "hand", ME, ""),
        (third, "exclude", 0, "", ME, "broken off"),
    ]
    assert [review.rows[i].state for i in (first, second, third)] == ["accepted", "adjusted", "excluded"]
    undone = []
    while (last := review.undo(VISIT, ME)) is not None:
        undone.append(last.recording)
    assert undone == [third, second, first]
    assert all(s == MarkState() for s in read_marks(review.path).values())
    assert len(marks(review.path)) == 6, "nothing is ever taken out of the file"
    assert raw_hash(review.path) == before


def test_undo_restores_an_older_mark_by_hand(review: Review) -> None:
    first = waves(review)[0]
    append_marks(review.path, [Mark(first, "trim", "old", start=7, stop=99, how="hand")])
    review.look()
    review.set(first, start=30)
    assert review.accept(VISIT, first, ME)
    assert read_marks(review.path)[first].start == 30
    review.undo(VISIT, ME)
    assert read_marks(review.path)[first] == MarkState(start=7, stop=99, how="hand")


def test_where_no_start_is_visible_all_of_it_is_kept_by_hand(review: Review) -> None:
    rest = next(i for i in review.infos if i not in waves(review))
    assert review.rows[rest].state == "none"
    assert review.accept(VISIT, rest, ME)
    assert review.standing(rest) == MarkState(how="hand")
    assert review.rows[rest].done


def test_two_windows_do_not_fight(review: Review) -> None:
    first, second = waves(review)[:2]
    review.accept("left", first, ME)
    review.accept("right", second, ME)
    assert review.undo("left", ME) is not None
    assert review.undo("left", ME) is None, "the other window's decision is not mine to take back"
    assert review.standing(second).trimmed
    review.accept("left", first, ME)
    review.exclude("right", [first], ME, "odd")
    review.set(second, start=3)
    review.accept("left", second, ME)
    append_marks(review.path, [Mark(second, "trim", "somebody", start=44, how="hand")])
    with pytest.raises(DatasetError, match="has been changed in another window"):
        review.undo("left", ME)
    assert review.standing(second).start == 44
    assert review.undo("left", ME) is not None, "excluding does not touch the trim"
    assert review.standing(first) == MarkState(excluded=True)


def test_marks_of_other_programs_are_seen(review: Review) -> None:
    first = waves(review)[0]
    version = review.version
    review.look()
    assert review.version == version
    append_marks(review.path, [Mark(first, "exclude", "x", "y")])
    review.look()
    assert review.rows[first].state == "excluded"
    assert review.version > version


def test_drafts_stay_inside_and_keep_something(review: Review) -> None:
    first = waves(review)[0]
    start = review.trim(first).suggestion.start
    with pytest.raises(DatasetError, match="Nothing of .* would be left"):
        review.set(first, stop=start)
    review.set(first, stop=10_000)
    assert review.draft(first) is None, "the end is there already"
    review.set(first, start=-5)
    assert review.kept_rows(first) == (0, 250)
    assert review.drop(first)
    assert review.kept_rows(first) == (start, 250)
    review.exclude(VISIT, [first], ME, "odd")
    with pytest.raises(DatasetError, match="Include it again"):
        review.set(first, start=3)


def test_findings_are_accepted_with_a_reason_and_taken_back(review: Review) -> None:
    odd = next(r for r in review.rows.values() if r.open)
    finding = odd.open[0]
    with pytest.raises(ConfigError, match="reason is missing"):
        review.accept_finding(VISIT, finding, ME, "  ")
    assert review.accept_finding(VISIT, finding, ME, "looked at")
    assert finding.check not in [f.check for f in review.rows[odd.id].open]
    assert marks(review.path)[-1] | {"when": ""} == {
        "recording": odd.id,
        "action": "accept",
        "who": ME,
        "why": "looked at",
        "start": 0,
        "stop": -1,
        "when": "",
        "check": finding.check,
        "how": "",
    }
    review.undo(VISIT, ME)
    assert review.rows[odd.id].open == odd.open


def test_a_decision_makes_the_check_old_and_checking_renews_it(review: Review) -> None:
    odd = next(r.id for r in review.rows.values() if any(f.check == "duration" for f in r.open))
    review.exclude(VISIT, [odd], ME, "too long")
    assert review.unchecked == 1
    review.check()
    review.prepared.wait(60.0)
    assert review.unchecked == 0
    assert not review.rows[odd].findings


def test_filters_and_sorting(review: Review) -> None:
    rows = review.rows
    first = waves(review)[0]
    review.accept(VISIT, first, ME)
    rows = review.rows
    every = list(rows)
    assert filter_and_sort(rows.values(), RecordingFilter()) == sorted(every)
    assert filter_and_sort(rows.values(), RecordingFilter(state=DONE)) == [first]
    assert len(filter_and_sort(rows.values(), RecordingFilter(state=TO_DO))) == len(every) - 1
    assert {rows[i].info.subject for i in filter_and_sort(rows.values(), RecordingFilter(person="P1"))} == {"P1"}
    assert filter_and_sort(rows.values(), RecordingFilter(text=first.upper())) == [first]
    longest = max(rows.values(), key=lambda r: r.seconds).id
    assert filter_and_sort(rows.values(), RecordingFilter(), by="seconds", down=True)[0] == longest
    assert longest in filter_and_sort(rows.values(), RecordingFilter(check="duration", severity="warning"))
    assert longest not in filter_and_sort(rows.values(), RecordingFilter(severity=NO_FINDING))
    assert filter_and_sort(rows.values(), RecordingFilter(), only=[first, "no such"]) == [first]
    assert RecordingFilter.of({"state": "nonsense", "person": "P1", "x": "y"}) == RecordingFilter(person="P1")


def test_what_is_drawn_is_what_was_recorded(review: Review) -> None:
    first = waves(review)[0]
    read = review.signals(first)
    shown = read.curves(ALL)
    frames = review.dataset.read(review.infos[first])
    assert np.array_equal(np.array(shown.curves).T[-len(frames) :], frames.values)
    assert shown.unit == "count"
    assert read.row_at(0.123) == 12 and read.row_at(99.0) == 250 and read.row_at(-3.0) == 0
    assert len(read.curves(ACTIVITY).x) == 250
    assert read.seconds[1] == pytest.approx(ROW_S)


def test_long_recordings_are_thinned_to_their_extremes(workspace: Workspace) -> None:
    from plushsense.studio.pages.review.signals import RecordingSignals
    from support.reviewed import recording

    frames = recording(1, 6000, rows=20_000)
    values = frames.values.astype(float)
    values[12_345, 0] = 99_999.0
    values[500:520] = np.nan
    at = np.arange(20_000) * ROW_S
    info = open_dataset(workspace.folder / "datasets" / "waves").recordings[0]
    layout = open_dataset(workspace.folder / "datasets" / "waves").layout
    read = RecordingSignals(
        info, layout, np.append(at, 200.0), at, values, np.zeros(20_000), np.zeros(layout.n_channels)
    )
    shown = read.curves(ALL)
    assert shown.thinned and len(shown.x) <= 3200
    assert max(v for v in shown.curves[0] if v is not None) == 99_999.0
    assert None in shown.curves[0]
    near = read.curves(ALL, 100.0, 110.0)
    assert not near.thinned and sum(100.0 <= x <= 110.0 for x in near.x) >= 1000
    assert (near.x[0], near.x[-1]) == (0.0, at[-1])


def test_an_overlay_names_what_stands_out(review: Review) -> None:
    overlay = review.overlay("Wave")
    odd = {c.recording: c.why for c in overlay.drawn if c.why}
    longest = max(review.rows.values(), key=lambda r: r.seconds).id
    assert "duration" in odd[longest]
    assert len(overlay.drawn) == len(waves(review))
    at = len(overlay.x) // 2
    height = overlay.curves[-1][at]
    if not np.isnan(height):
        assert overlay.nearest(float(overlay.x[at]), float(height)) == overlay.drawn[-1].recording
    review.exclude(VISIT, [longest], ME, "too long")
    assert longest not in [c.recording for c in review.overlay("Wave").drawn]


def test_links_to_few_and_to_many(workspace: Workspace, review: Review) -> None:
    reviews = workspace.part(Selections)
    few = reviews.address(review.path, waves(review)[:2], "confused")
    assert few.count("recordings=") == 2 and "selection" not in few
    many = reviews.address(review.path, [f"P1/x_{i}" for i in range(500)], "Wave taken for Rest")
    key = many.split("selection=")[1]
    assert len(many) < 1500
    assert reviews.read(key) == ("Wave taken for Rest", [f"P1/x_{i}" for i in range(500)])
    for bad in ("../x", "0000"):
        with pytest.raises(ConfigError, match="does not exist"):
            reviews.read(bad)


def test_a_recording_that_came_since_is_there(workspace: Workspace, review: Review) -> None:
    from plushsense.core.recorder_csv import write_recording
    from support.reviewed import ACCEL, recording

    write_recording(review.path / "recordings" / "P1" / "Wave_5_250.csv", recording(900, 6000), ACCEL)
    again = workspace.part(Reviews).open(review.path)
    again.prepared.wait(60.0)
    assert again is review
    assert again.rows["P1/Wave_5_250"].state == "suggested"


def test_a_folder_that_cannot_be_written_loses_nothing(review: Review) -> None:
    first = waves(review)[0]
    (review.path / "marks.jsonl.lock").unlink(missing_ok=True)
    (review.path / "marks.jsonl.lock").mkdir()
    review.set(first, start=20)
    with pytest.raises(DatasetError, match=r"marks.jsonl' cannot be written"):
        review.accept(VISIT, first, ME)
    assert review.draft(first) == (20, 250)
    (review.path / "marks.jsonl.lock").rmdir()
    assert review.accept(VISIT, first, ME)
    assert review.standing(first).start == 20


def test_places_outside_are_refused(workspace: Workspace) -> None:
    with pytest.raises(ConfigError, match="not in the studio's folder"):
        workspace.part(Reviews).open("../elsewhere")


def test_one_undo_for_decisions_about_many(review: Review) -> None:
    first, second, third, *rest = waves(review)
    raw = raw_hash(review.path)
    assert review.exclude(VISIT, [first], ME, "odd") == 1
    assert review.exclude(VISIT, [first, second, third], ME, "odd") == 2
    review.include("elsewhere", [second], "you")
    undone = review.undo(VISIT, ME)
    assert undone is not None and list(undone.before) == [third], "what was changed elsewhere stays"
    assert [review.standing(i).excluded for i in (first, second, third)] == [True, False, False]
    assert review.relabel(VISIT, [second, third], "Rest", ME, "seen") == 2
    row = review.rows[third]
    assert (row.info.gesture, row.info.recorded, review.unchecked) == ("Rest", "Wave", 3)
    with pytest.raises(DatasetError, match="has no gesture"):
        review.relabel(VISIT, [second, third], "Nod", ME)
    assert review.undo(VISIT, ME) is not None and review.rows[third].info.gesture == "Wave"
    assert review.undo(VISIT, ME) is not None and not review.standing(first).excluded
    assert review.undo(VISIT, ME) is None and raw_hash(review.path) == raw
    assert len(rest) > 3


def test_all_sure_suggestions_are_accepted_and_taken_back_at_once(review: Review) -> None:
    ids = list(review.rows)
    sorted_by = sorted(r.confidence for r in review.rows.values() if r.state == "suggested")
    above = sorted_by[len(sorted_by) // 2]
    surer = review.surer_than(above, ids)
    assert 0 < len(surer) < len(sorted_by) and surer == [i for i in ids if review.rows[i].confidence >= above > 0]
    # The library decides alike.
    trims = decide_trims(
        Path(shutil.copytree(review.path, review.path.parent / "copy")), TrimDecisions(above=above, who=ME)
    )
    assert sorted(trims.accepted.marked) == sorted(surer)
    by_hand = surer[0]
    review.set(by_hand, start=3)
    review.accept(VISIT, by_hand, ME)
    assert review.accept_above(VISIT, ids, ME, above) == len(surer) - 1
    assert review.rows[by_hand].state == "adjusted" and review.rows[surer[1]].state == "accepted"
    assert review.undo(VISIT, ME) is not None and review.surer_than(above, ids) == surer[1:]
    assert review.rows[by_hand].state == "adjusted"
