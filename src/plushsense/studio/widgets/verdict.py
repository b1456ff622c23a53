"""Say in plain words how good a result is: touches of ten, beside guessing, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import ui

from plushsense.scoring.comparison import LEVEL, PairResult
from plushsense.studio.app.shell import address, tag
from plushsense.studio.app.stored_results import (
    HELD_BACK,
    PERSONAL,
    SUBJECTS,
    TRAINING,
    TRIAL,
    ResultRow,
    averaged_over,
    counted,
    figure,
    score_text,
)
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.widgets.elements import table_html

_VERDICTS: Texts = {
    "new": "It reads about {right} of 10 touches of people it never met; guessing gives {chance} of 10.",
    "new_one": "It reads about {right} of 10 touches of one person it never met; guessing gives {chance} of 10.",
    "known": (
        "It reads about {right} of 10 moments, with those at rest, of people it knows; guessing gives {chance} of "
        "10. Expect less with new people."
    ),
    "known_one": (
        "It reads about {right} of 10 moments, with those at rest, of the one person it knows; guessing gives {chance} "
        "of 10. Expect less with new people."
    ),
    "leaky": (
        "Here it reads about {right} of 10 moments, with those at rest, but this test is too easy: parts of the same "
        "touches were trained on. Guessing gives {chance} of 10."
    ),
    "untested": "Nobody has tested this network, so it may be guessing. You can try it; evaluate it on the page Train.",
    "unusable": "Not usable yet, because it may be guessing: record two more people, or each gesture two more times.",
}

_LINKS: Texts = {"live": "Try it live", "export": "Export for the toy"}
_OUTCOMES: Texts = {
    "this": "So this network is better, beyond chance.",
    "other": "So the other network is better, beyond chance.",
    "chance": "So the difference may be chance.",
    "few": "So the difference may be chance: with so few people, this test cannot tell.",
}
FEW_PAIRS = 6
"""With fewer people than this, a paired permutation test never gives a p-value below 0.05."""
FEW_PEOPLE = 10
"""With fewer people than this, a score may be far from that of others."""


def of_ten(w: Words, share: float) -> str:
    """Format a share as a number of ten: whole from 1 on, with one decimal place below."""
    return w.number(10 * share, 0 if 10 * share >= 0.95 else 1)


def headline(w: Words, row: ResultRow) -> str:
    """Return the main sentence on a result."""
    if row.split == PERSONAL:
        return w("It is adapted to one person. How well it reads others is not known.")
    if row.untested:
        return w(_VERDICTS["untested"])
    if row.accuracy is None or not row.classes:
        return w("This result has no score.")
    kind = "leaky" if row.leaky else "new" if row.subject_independent else "known"
    one = (row.units if row.spread in (SUBJECTS, HELD_BACK) else len(row.people)) == 1 and not row.leaky
    return w(_VERDICTS[f"{kind}_one" if one else kind], right=of_ten(w, row.accuracy), chance=of_ten(w, row.chance))


def show_verdict(w: Words, row: ResultRow | None, look: str = "") -> None:
    """Add the main sentence on a network or another result; in red, with what to do, if it may be guessing."""
    if row is None:
        return
    bad = "" if row.usable or row.leaky or row.accuracy is None else " ps-bad"
    tag(ui.label(headline(w, row)).classes(look + bad), "score")
    if bad:
        tag(ui.label(w(_VERDICTS["unusable"])).classes(f"text-bold{bad}"), "not-usable")


def show_result(w: Words, row: ResultRow, look: str) -> None:
    """Add the main sentence on a result, how sure it is, and its exact figures."""
    show_verdict(w, row, look)
    for sentence in limits(w, row):
        ui.label(sentence)
    if row.simulated:
        ui.label(w("Simulation: these data say nothing about a real toy."))
    tag(ui.label(figures(w, row)).classes("ps-dim"), "result")


def show_choice(w: Words, networks: Mapping[Path, ResultRow], chosen: str | None, look: str = "") -> None:
    """Add the verdict on the network that is chosen on a page, or why none is chosen there at first."""
    if chosen:
        show_verdict(w, networks.get(Path(chosen)), look)
    elif networks:
        tag(ui.label(w("None of the networks is surely better than guessing, so none is chosen.")), "none-chosen")


def network_links(w: Words, bundle: str | Path) -> None:
    """Add links from a network to the pages that use it."""
    for to, message in _LINKS.items():
        tag(ui.link(w(message), address(to, model=bundle)).classes("ps-link"), f"to-{to}")


def comparison(w: Words, pair: PairResult, people: int) -> str:
    """Return the sentences on two networks that were tested on the same people; the first is "this network"."""
    assert pair.difference.mean is not None and pair.difference.ci95 is not None
    low, high = pair.difference.ci95
    text = w(
        "Compared on {people}: this network reads {better} of them better than the other one, and {worse} worse. Its "
        "accuracy minus that of the other one is {difference} on average (95 % interval: {low} to {high}; paired "
        "permutation test over people: p = {p}).",
        people=counted(w, "people", people),
        better=pair.better,
        worse=pair.worse,
        p=w.number(pair.p, 3),
        difference=figure(w, pair.difference.mean),
        low=figure(w, low),
        high=figure(w, high),
    )
    better = "this" if pair.difference.mean > 0 else "other"
    outcome = better if pair.p < LEVEL else "few" if people < FEW_PAIRS else "chance"
    return f"{text} {w(_OUTCOMES[outcome])}"


def limits(w: Words, row: ResultRow) -> list[str]:
    """Return the sentences on how sure the main sentence is."""
    found: list[str] = []
    if row.leaky or row.accuracy is None:
        return found
    people = row.units if row.spread in (SUBJECTS, HELD_BACK) else 0
    if row.interval is not None and row.spread == SUBJECTS:
        low, high = (w.number(10 * edge, 1) for edge in row.interval)
        found.append(
            w(
                "Measured on {people}. For other people like them, the average is probably between {low} and {high} "
                "of 10 (95 % interval).",
                people=counted(w, "people", people),
                low=low,
                high=high,
            )
        )
    if 0 < people < FEW_PEOPLE:
        found.append(
            w("This figure is uncertain: it was measured on only {people}.", people=counted(w, "people", people))
        )
    if row.kind == TRIAL:
        found.append(w("It is the best of several networks on the same people, so its score is slightly too good."))
    if row.kind == TRAINING and row.proof is None:
        found.append(
            w("This is the check during training. Report the score of an evaluation, which tests every person.")
        )
    if row.proof is not None and row.subject_independent:
        found.append(_more_people(w, row.learning))
    return found


def _more_people(w: Words, learning: Mapping[str, Any] | None) -> str:
    """Return what more people to train on would add, with its uncertainty, or that it was not measured."""
    if learning is None or learning.get("ci95") is None:
        return w("What more people would add was not measured.")
    low, high = learning["ci95"]
    values = {
        "people": counted(w, "more_people", learning["more"]),
        "low": w.number(10 * low, 1),
        "high": w.number(10 * high, 1),
    }
    if low <= 0:
        return w(
            "Whether training with {people} would help cannot be told yet: the effect is between {low} and {high} of "
            "10 (95 % interval).",
            **values,
        )
    return w(
        "Training with {people} would add about {gain} of 10 (95 % interval: {low} to {high}).",
        gain=w.number(10 * learning["gain"], 1),
        **values,
    )


def figures(w: Words, row: ResultRow) -> str:
    """Return the exact figures of a result, and how they are counted."""
    text = w(
        "Accuracy {accuracy}, macro-F1 {macro_f1}; mean over {over}, counted in windows.",
        accuracy=score_text(w, row.accuracy, row.accuracy_sd),
        macro_f1=score_text(w, row.macro_f1, row.macro_f1_sd),
        over=averaged_over(w, row.spread, row.units),
    )
    if row.rest is not None:
        text += " " + w(
            "Recordings at rest are not included: their accuracy is {accuracy}.", accuracy=figure(w, row.rest)
        )
    return text


def people_table(w: Words, row: ResultRow) -> Markup:
    """Render the accuracy of each person with a bar, and the mean, which is the accuracy of the result."""
    bar = Markup('<span class="ps-share" aria-hidden="true"><i style="width: {:.0f}%"></i></span>')

    def line(name: str, value: float | None) -> tuple[Any, ...]:
        return (name, figure(w, value), bar.format(100 * (value or 0.0)))

    rows = [line(name, value) for name, value in row.people]
    if row.spread == SUBJECTS:
        rows.append(line(w("Mean"), row.accuracy))
    rows.append(line(w("Guessing"), row.chance))
    return table_html([w("Person"), w("Accuracy"), ""], rows, numbers=(1,), row_heads=True)
