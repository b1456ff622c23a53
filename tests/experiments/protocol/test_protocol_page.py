"""The protocol's page and tables: figures as they are, the paper's beside them, simulation said everywhere."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from plushsense.core.gestures import load_gestures
from plushsense.experiments.protocol import protocol_page
from plushsense.experiments.protocol.protocol_page import PAPER
from plushsense.experiments.protocol.score import (
    SYSTEMS,
    FamilyConfusion,
    ProtocolResult,
    ScoredTrials,
    StrayEvents,
    SummaryRow,
    TrialOutcome,
    TrialSummary,
)
from plushsense.experiments.protocol.sittings import LeftOut

TIMES = {"median": 0.013, "p90": 0.2}
FIGURES = TrialSummary(
    trials=45, activated=44, activation=0.9778, already=0, reaction_s=TIMES, within_200_ms=44, quick=0.9778, named=40,
    gesture_activation=0.8889, gesture_s=TIMES, likelihood=0.834, gentle=45, called_negative=1, negative=0.0222,
    called={"right": 40, "family": 3, "affect": 0, "wrong": 1, "unnamed": 1}, from_gate=0,
)  # fmt: skip


def row(group, system, gesture=None, **more):
    return SummaryRow(group, group.title(), gesture, system, replace(FIGURES, **more))


ROWS = (
    row("energetic", "hybrid", gentle=0, called_negative=0), row("fine", "rules"), row("fine", "cnn"),
    row("taps", "cnn", activated=0, named=0, reaction_s={"median": None, "p90": None}, likelihood=None),
    row("all", "cnn"),
)  # fmt: skip


def result(simulated=True, label="Tail hit 1", rows=ROWS, **more):
    outcome = TrialOutcome(
        "virtual 1", "hybrid", label, "Tail hit", "energetic", "negative", 1, 2.0, 0.1, None, None, None, "unnamed",
        None, False, False, None,
    )  # fmt: skip
    scored = ScoredTrials(
        ("virtual 1",), 2, 1, ("rules", "cnn", "hybrid"), rows, (row("", "hybrid", label),),
        (
            FamilyConfusion("cnn", "Tail scratch", "Tail tap", 2, 0.13),
            FamilyConfusion("cnn", "Tail scratch", None, 13, 0.87),
            FamilyConfusion("rules", "Tail scratch", "never shown", 1, 1.0),
        ),
        (StrayEvents("cnn", 0.5, 3, 9, 1, 0, 8.0, 2.0),),
        (outcome, replace(outcome, reaction_s=None)),
    )  # fmt: skip
    whole = ProtocolResult(
        scored, "The protocol", simulated, (), ("How it is counted.",), ("No gate.",), (("People", "5"),), "float"
    )
    return replace(whole, **more)


def test_shares_bear_their_counts_and_do_not_round_a_miss_away():
    assert protocol_page.percent(44, 45) == "97.8 % (44/45)"
    assert protocol_page.percent(254, 255) == "99.6 % (254/255)"
    assert protocol_page.percent(1, 210) == "0.5 % (1/210)"
    assert protocol_page.percent(45, 45) == "100 % (45/45)"
    assert protocol_page.percent(0, 45) == "0 % (0/45)"
    assert protocol_page.percent(13, 90) == "14 % (13/90)"
    assert protocol_page.percent(0, 0) == "—"
    assert protocol_page.seconds(-0.001) == "0.00"


def test_the_table_stands_beside_the_paper():
    rows = protocol_page.group_table(result()).rows
    by = {(r["title"] or "Fine", r["system"]): r for r in rows}
    assert by["Fine", "Rules"]["paper_answered"] == "≈ 6 %" and by["Fine", "Rules"]["paper_time"] == "—"
    assert by["Fine", "Network"]["paper_time"] == "2.3–2.4 s"
    assert by["Energetic", "Hybrid"]["paper_answered"] == "—"
    assert by["Energetic", "Hybrid"]["quick"] == "97.8 % (44/45)"
    assert by["Energetic", "Hybrid"]["negative"] == "", "a blow is rightly called negative"
    assert by["Fine", "Rules"]["quick"] == ""
    assert by["Fine", "Rules"]["named"] == "—", "rules name no gesture"
    assert (by["Taps", "Network"]["median"], by["Taps", "Network"]["likelihood"]) == ("—", "—")
    assert len(protocol_page.group_table(result()).columns) == 13
    assert "paper: time" in protocol_page.group_table(result()).text()
    elsewhere = result(rows=tuple(replace(one, group="other") for one in ROWS))
    assert len(protocol_page.group_table(elsewhere).columns) == 10, "the paper has no such gestures"


def test_the_csv_holds_numbers_of_groups_and_gestures():
    rows = protocol_page.figure_table(result()).rows
    assert [(r["of"], r["name"], r["system"]) for r in rows[:1] + rows[-1:]] == [
        ("group", "Energetic", "hybrid"), ("gesture", "Tail hit 1", "hybrid"),
    ]  # fmt: skip
    assert (rows[0]["reaction_median_s"], rows[0]["within_200_ms"], rows[0]["said_first_family"]) == (0.013, 44, 3)
    assert next(r for r in rows if r["name"] == "Fine" and r["system"] == "rules")["paper_answered"] == "≈ 6 %"
    assert {r["simulated"] for r in rows} == {"yes"}


def test_the_papers_cells_are_of_systems_and_groups_that_there_are():
    from plushsense.experiments.protocol.score import GROUPS, group_of

    ours = {group_of(g) for g in load_gestures("plush-18").gestures}
    assert {group for group, _ in PAPER} <= ours <= set(GROUPS)
    assert {system for _, system in PAPER} == set(SYSTEMS) - {"hybrid"}


def test_a_page_is_whole_and_says_what_it_is():
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    page = protocol_page.page(result(label="<b>& $x$"))
    assert "This is a simulation." in page
    tables = len(re.findall("<h2", page))
    assert page.count("Simulation:</strong>") == tables
    assert "&lt;b&gt;&amp; $x$" in page
    assert "<b>" not in page
    assert "never shown" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    real = protocol_page.page(result(simulated=False, left=(LeftOut("P09", "has no session stream"),)))
    assert "simulation" not in real.lower().replace("<!--", "")
    assert "P09 has no session stream" in real


def test_where_the_paper_has_nothing_its_columns_are_not_there():
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    other = result(rows=(row("fast", "cnn"), row("other", "cnn")), simulated=False)
    page = protocol_page.page(other)
    assert "beside the paper" not in page
    assert "five new people" not in page


def test_the_figure_draws_every_answer_and_names_who_was_missed():
    pytest.importorskip("matplotlib")
    made = protocol_page.figure(result())
    axes = made.axes[0]
    assert axes.get_title(loc="left") == "SIMULATION"
    texts = [t.get_text() for t in axes.texts]
    assert "44 of 45 not answered" in texts
    assert sum(len(c.get_offsets()) for c in axes.collections) == 1
    names = [t.get_text() for t in axes.get_yticklabels()]
    assert names[0] == "Energetic: hybrid"
    assert len(names) == 4, "all gestures together are no row"
