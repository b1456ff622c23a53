"""What a test scenario of an export reaches: kinds of answers, events and faults."""

from __future__ import annotations

import numpy as np

from plushsense.deploy.golden import ANSWER, COLUMNS, EVENT, HEALTH, TRACKING, Vectors, column
from plushsense.runtime.events import ANSWERS, BEGUN, ENDED, GATE, KINDS, NO_GESTURE, SOURCES


def all_outcomes() -> set[str]:
    """Return the outcomes that scenarios should cover; with few classes some cannot occur."""
    events = {f"{kind} by {source}" for kind in KINDS.values() for source in SOURCES}
    ends = {"lost in silence", "lost in a gap", "lost in a fault", "replaced", "replaced by the gate"}
    health = {"fault", "recovery", "suspect only"}
    return events | ends | health | set(ANSWERS) | {"gate while warming", "unnamed", "without affect", "resting"}


def outcomes_of(scenario: Vectors) -> set[str]:
    """Return the subset of `all_outcomes` that a scenario reaches."""
    rows, outcomes = scenario.answers.astype(np.int64), set()
    answered = column(rows, "answer")[column(rows, "state") == TRACKING]
    outcomes |= {ANSWERS[k] for k in set(answered.tolist())}
    at = {name: n for n, name in enumerate(COLUMNS[EVENT])}
    state, warm, ended = COLUMNS[ANSWER].index("state"), False, None
    frame = COLUMNS[ANSWER].index("frame")
    silent = {call.frame for call in scenario.calls if call.action in ("silence", "prime")}
    for n, row in enumerate(rows.tolist()):
        after = rows[n + 1].tolist() if n + 1 < len(rows) else None
        if row[0] == ANSWER:
            warm = row[state] == TRACKING
        elif row[0] == HEALTH:
            fault, suspect = row[state] == 2, row[5]
            outcomes.add("fault" if fault else "suspect only" if suspect else "recovery")
        else:
            kind, source = row[at["what"]], row[at["source"]]
            outcomes.add(f"{KINDS[kind]} by {SOURCES[source]}")
            if kind == BEGUN:
                if source == GATE and not warm:
                    outcomes.add("gate while warming")
                if row[at["gesture"]] == NO_GESTURE:
                    outcomes.add("unnamed")
                if row[at["affect"]] == 0:
                    outcomes.add("without affect")
                if ended is not None and row[at["ms"]] - ended > 0:
                    outcomes.add("resting")
            if kind == ENDED:
                ended = row[at["ms"]]
                if (
                    after is not None
                    and after[0] == EVENT
                    and after[at["what"]] == BEGUN
                    and after[frame] == row[frame]
                ):
                    outcomes.add("replaced by the gate" if after[at["source"]] == GATE else "replaced")
                elif after is not None and after[0] == HEALTH and after[frame] == row[frame] and after[state] == 2:
                    outcomes.add("lost in a fault")
                elif row[frame] in silent and row[at["since"]] == row[at["ms"]]:
                    outcomes.add("lost in silence")
                elif after is not None and after[at["restarts"]] > row[at["restarts"]]:
                    outcomes.add("lost in a gap")
    return outcomes
