"""The paper's real-time protocol (section 4.6): who answers which gesture, how soon, and what for.

Three systems hear the same streams: the old threshold rules, the network alone, and both together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import mean, median
from typing import Any

import numpy as np

from plushsense.evaluation.sittings import Progress, Sitting
from plushsense.evaluation.trials import (
    GROUPS,
    JUDGED,
    QUICK_S,
    SYSTEMS,
    Between,
    Heuristic,
    Outcome,
    hear,
    score,
)
from plushsense.models.bundle import Bundle
from plushsense.models.image import IntegerModel


def run(
    sittings: Iterable[Sitting],
    model: Bundle | IntegerModel,
    heuristic: Heuristic | None = None,
    progress: Progress | None = None,
    of: int = 0,
) -> dict[str, Any]:
    """Let every system hear every sitting, and add up.

    Args:
        of: how many sittings there are, for the progress.

    Returns:
        ``people``, ``trials``, ``systems``, ``rows`` (a group each, and all of them: `summary`), ``by_gesture``,
        ``confusions`` (a system, what was done, what it was called, how often), ``between`` and ``outcomes``.
    """
    gestures = model.gestures
    outcomes: list[Outcome] = []
    between: dict[str, list[Between]] = {}
    people: list[str] = []
    for done, sitting in enumerate(sittings, 1):
        people.append(sitting.who)
        for system, heard in hear(sitting.frames, model, heuristic).items():
            made, stray = score(sitting, system, heard, gestures)
            outcomes += made
            between.setdefault(system, []).append(stray)
        if progress is not None:
            progress(done, of or done)
    systems = [key for key in SYSTEMS if key in between]
    kept = {key: [o for o in outcomes if o.system == key] for key in systems}
    groups = [g for g in GROUPS if any(o.group == g for o in outcomes)]
    labels = [g for g in gestures.labels if any(o.gesture == g for o in outcomes)]
    return {
        "people": people,
        "trials": len(kept[systems[0]]),
        "gestures": len(labels),
        "systems": [{"system": key, "title": SYSTEMS[key]} for key in systems],
        "rows": [
            {"group": group, "title": GROUPS[group], "system": key}
            | summary([o for o in kept[key] if o.group == group])
            for group in groups
            for key in systems
        ]
        + [{"group": "all", "title": "All gestures", "system": key} | summary(kept[key]) for key in systems],
        "by_gesture": [
            {"gesture": label, "system": key} | summary([o for o in kept[key] if o.gesture == label])
            for label in labels
            for key in systems
        ],
        "confusions": [c for key in systems for c in confusions(kept[key])],
        "between": [{"system": key} | _strays(between[key]) for key in systems],
        "outcomes": [o.to_dict() for o in outcomes],
    }


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Some trials of one system in figures; shares are of all ``trials``, times of those that were answered, and
    ``called_negative`` is of those that were not negative (``gentle``).

    ``called`` counts what was said first, by the words of ``Outcome.judged``.
    """
    n = len(outcomes)
    reactions = sorted(o.reaction_s for o in outcomes if o.reaction_s is not None)
    named = sorted(o.gesture_s for o in outcomes if o.gesture_s is not None)
    likely = [o.likelihood for o in outcomes if o.likelihood is not None]
    quick = sum(r <= QUICK_S for r in reactions)
    gentle = [o for o in outcomes if o.affect != "negative"]
    return {
        "trials": n,
        "activated": len(reactions),
        "activation": _share(len(reactions), n),
        "already": sum(o.already and o.reaction_s is None for o in outcomes),
        "reaction_s": _times(reactions),
        "within_200_ms": quick,
        "quick": _share(quick, n),
        "named": len(named),
        "gesture_activation": _share(len(named), n),
        "gesture_s": _times(named),
        "likelihood": round(mean(likely), 4) if likely else None,
        "gentle": len(gentle),
        "called_negative": sum(o.negative for o in gentle),
        "negative": _share(sum(o.negative for o in gentle), len(gentle)),
        "called": {word: sum(o.judged == word for o in outcomes) for word in JUDGED},
        "from_gate": sum(o.source == "gate" for o in outcomes),
    }


def _share(part: int, of: int) -> float | None:
    return round(part / of, 4) if of else None


def _times(values: Sequence[float]) -> dict[str, float | None]:
    if not values:
        return {"median": None, "p90": None}
    return {"median": round(median(values), 3), "p90": round(float(np.percentile(values, 90)), 3)}


def confusions(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """What each family was called, most often first: the family itself, another one, or nothing (None)."""
    counts: dict[tuple[str, str | None], int] = {}
    for o in outcomes:
        counts[o.family, o.called_family] = counts.get((o.family, o.called_family), 0) + 1
    order = list(dict.fromkeys(o.family for o in outcomes))
    totals = {family: sum(n for (did, _), n in counts.items() if did == family) for family in order}
    return [
        {"system": outcomes[0].system, "did": did, "called": called, "trials": n, "share": _share(n, totals[did])}
        for (did, called), n in sorted(counts.items(), key=lambda item: (order.index(item[0][0]), -item[1]))
    ]


def _strays(between: Sequence[Between]) -> dict[str, Any]:
    """What was said between the trials, a sum over all streams; reactions are all but neutral events."""
    hours = sum(b.hours for b in between)
    counts = {name: sum(getattr(b, name) for b in between) for name in ("positive", "neutral", "negative", "none")}
    reactions = counts["positive"] + counts["negative"] + counts["none"]
    return {
        "hours": round(hours, 4),
        **counts,
        "reactions_per_hour": round(reactions / hours, 2) if hours else None,
        "negative_per_hour": round(counts["negative"] / hours, 2) if hours else None,
    }


def aims(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What this project wants of the protocol, beside what came out; an aim of a system that is not there is open.

    Each has ``aim``, ``measured`` (a share, or seconds), ``part`` and ``of`` where it is a share, ``met`` (or None).
    """
    outcomes = result["outcomes"]

    def of(system: str, **wanted: Any) -> list[dict[str, Any]]:
        return [o for o in outcomes if o["system"] == system and all(o[k] in v for k, v in wanted.items())]

    blows = of("hybrid", group=("energetic",))
    kind = of("hybrid", affect=("positive", "neutral"))
    answered = [o["reaction_s"] for o in kind if o["reaction_s"] is not None]
    fine = of("rules", group=("fine",))
    quick = sum(o["reaction_s"] is not None and o["reaction_s"] <= QUICK_S for o in blows)
    time_s = round(median(answered), 3) if answered else None
    return [
        _aim("Hybrid: blows and pulls answered within 0.2 s in at least 98 % of the trials", quick, len(blows), 0.98),
        _aim(
            "Hybrid: gentle gestures called negative in at most 1 % of the trials",
            sum(o["negative"] for o in kind),
            len(kind),
            0.01,
            most=True,
        ),
        {
            "aim": "Hybrid: median reaction to gentle gestures under 1.5 s",
            "measured": time_s,
            "unit": "s",
            "part": None,
            "of": len(answered),
            "met": None if time_s is None else time_s < 1.5,
        },
        _aim(
            "Rules only: fine scratches answered in at most 20 % of the trials (the paper: about 6 %)",
            sum(o["reaction_s"] is not None for o in fine),
            len(fine),
            0.2,
            most=True,
        ),
    ]


def _aim(words: str, part: int, of: int, line: float, most: bool = False) -> dict[str, Any]:
    share = part / of if of else None
    met = None if share is None else share <= line if most else share >= line
    return {"aim": words, "measured": _share(part, of), "unit": "share", "part": part, "of": of, "met": met}
