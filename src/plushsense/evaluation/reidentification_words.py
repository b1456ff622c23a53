"""The re-identification report in words for a data officer: first what it means, then the figures."""

from __future__ import annotations

from plushsense.evaluation.reidentification import DESIGNS, FOLDS, SEES, Reidentified, Trial

LIMITS = """\
- The program is simple, and one made for the purpose may do better: this is a lower bound of the risk.
- Whoever wants to recognise somebody needs at least one other recording of that person on the same kind of toy; the
  recordings hold no name, voice or picture.
- Repetitions of a gesture, made one right after the other, are much alike. Asked about gestures that it knows, the
  program has mostly learned from the neighbours of the very recording; of a gesture that it never saw, it has not.
- It read the recordings, trimmed: neither the streams nor for how long the toy had been on. Both may tell more.
- Recordings of one session share how the toy was set up, worn and switched on. What is recognised within a session is
  partly that, not the person; across sessions it is the person, or what stayed the same about the device.
- A low figure is no proof of anonymity. Ask your data protection officer."""
SIMULATED = "These are virtual people: the figures say nothing about real ones."


def short(found: Reidentified) -> str:
    """The verdict in a paragraph, Markdown."""
    head = found.find("recordings", "everything")
    if head is None:
        return "Nothing could be tried."
    said = [SIMULATED] if found.simulated else []
    said.append(
        f"Given one more recording of a session and of gestures that it knows, a simple program names the right one of "
        f"{head.people} people in {_hundred(head.top1['mean'])} of 100 cases{_range(head)}; guessing would be right in "
        f"{_hundred(head.chance)}."
    )
    said += [
        _gestures(found),
        _verdict(head, found.simulated),
        _sessions(found),
        _clock(found),
        _movement(found),
        _labels(found),
    ]
    return " ".join(s for s in said if s)


def report(found: Reidentified, command: str) -> str:
    """The whole report, Markdown; ``command`` is how it was made."""
    parts = [
        "# Can the people be recognised by their touch?",
        short(found),
        "## What was tried",
        f"{found.recordings} recordings of {found.people} people ({found.sessions} sessions), {found.trees} extremely "
        f"randomised trees, seed {found.seed}. A program learns from recordings whose people it is told, and is then "
        "asked whose each of the others is. Every person counts alike; the interval is the 95 % bootstrap over people.",
        _table(found),
        "\n".join(f"- **{name}**: {what}" for name, what in SEES.items()),
        _designs(found),
        "## Person by person",
        _people(found),
        "## What this does and does not say",
        LIMITS,
        f"Made with `{command}`.",
    ]
    return "\n\n".join(parts) + "\n"


def _verdict(trial: Trial, simulated: bool) -> str:
    if simulated:
        return ""
    low = (trial.top1["ci95"] or [trial.top1["mean"]])[0]
    if low <= trial.chance:
        return "That is no better than guessing, which is no proof of anonymity: treat the recordings with care."
    many = trial.top1["mean"] >= 3 * trial.chance or trial.top1["mean"] >= 0.5
    return (
        "**So these recordings must be treated as personal data**: whoever holds another recording of somebody, made "
        f"that day, can {'often' if many else 'sometimes'} find that person here, though no name is in the package."
    )


def _gestures(found: Reidentified) -> str:
    trial = found.find("gestures", "everything")
    return f"Of a gesture that it never saw, it is {_hundred(trial.top1['mean'])} of 100." if trial else ""


def _sessions(found: Reidentified) -> str:
    trial = found.find("sessions", "everything")
    if trial is None:
        return (
            f"Across sessions nothing is known: {found.skipped.get('sessions', 'it was not tried')}. Part of what is "
            "recognised may be the session (how the toy was set up and held), not the person."
        )
    return (
        f"In a session that the program never saw it is right in {_hundred(trial.top1['mean'])} of 100 cases"
        f"{_range(trial)}, tried on those who came more than once: {len(trial.by_person)} of {trial.people} people."
    )


def _clock(found: Reidentified) -> str:
    trial = found.find("recordings", "clock")
    if trial is None:
        return ""
    clear = trial.clear
    told = f"; {len(clear)} of them almost surely ({', '.join(clear)})" if clear else ""
    return (
        f"The sampling clock alone, nothing of the touch, tells {_hundred(trial.top1['mean'])} of 100: people were "
        f"recorded at different rates{told}."
        if trial.top1["mean"] > 2 * trial.chance
        else f"The sampling clock alone tells {_hundred(trial.top1['mean'])} of 100: little or nothing."
    )


def _movement(found: Reidentified) -> str:
    trial = found.find("recordings", "movement")
    if trial is None:
        return ""
    return (
        f"Without the clock, the device's noise and how the toy is held, from the movement alone, it is "
        f"{_hundred(trial.top1['mean'])} of 100."
    )


def _labels(found: Reidentified) -> str:
    alone = found.of_one_person
    if not alone:
        return ""
    many = len(alone) > 1
    return (
        f"Only one person made the gesture{'s' if many else ''} {', '.join(alone)}: "
        f"{'each of these labels' if many else 'that label'} alone names a person."
    )


def _table(found: Reidentified) -> str:
    lines = [
        "| asked about | the program sees | top-1 | 95 % | top-5 | chance | people: worst to best |",
        "|---|---|---|---|---|---|---|",
    ]
    for t in found.trials:
        shares = sorted(t.by_person.values())
        interval = "–".join(f"{v:.3f}" for v in t.top1["ci95"]) if t.top1["ci95"] else ""
        lines.append(
            f"| {DESIGNS[t.design]} | {t.sees} | {t.top1['mean']:.3f} | {interval} | {t.top5['mean']:.3f} | "
            f"{t.chance:.3f} / {t.chance5:.3f} | {shares[0]:.2f} to {shares[-1]:.2f} |"
        )
    return "\n".join(lines)


def _designs(found: Reidentified) -> str:
    lines = [
        f"- recordings: {FOLDS} folds over each person's recordings",
        f"- gestures: at most {FOLDS} groups of gestures, each left out once",
        "- sessions: of people of several sessions, each session left out once",
    ]
    lines += [f"- not possible here: {DESIGNS[name]} ({why})" for name, why in found.skipped.items()]
    return "\n".join(lines)


def _people(found: Reidentified) -> str:
    trial = found.find("recordings", "everything")
    if trial is None:
        return ""
    ordered = sorted(trial.by_person.items(), key=lambda item: (-item[1], item[0]))
    half = sum(share > 0.5 for _, share in ordered)
    said = f"{half} of {len(ordered)} people are named rightly in more than half of their recordings: "
    return said + ", ".join(f"{name} {share:.2f}" for name, share in ordered) + "."


def _hundred(share: float | None) -> str:
    if share is None:
        return "an unknown number"
    return f"{100 * share:.0f}" if share >= 0.095 or share == 0 else f"{100 * share:.1f}"


def _range(trial: Trial) -> str:
    ci = trial.top1["ci95"]
    return f" (95 % interval {_hundred(ci[0])} to {_hundred(ci[1])})" if ci else ""
