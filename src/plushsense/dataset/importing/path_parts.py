"""Guess which parts of the paths of files are the person, the session, the label and the take of a recording."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.dataset.importing.pattern import PARTS

MOST_LABELS = 60
_PERSON = re.compile(r"(s|p|subj|subject|sub|participant|person|user|u|id|child|kid)[-_ ]?\d+", re.IGNORECASE)
_SESSION = re.compile(r"(session|ses|day|visit|run)[-_ ]?\d*", re.IGNORECASE)
_TAKE = re.compile(
    r"(rep|repetition|take|trial|rec|recording|sample|example|attempt|try|nr|no|n|t|r)[-_ ]?\d+", re.IGNORECASE
)
# Words in paths that are neither persons nor labels: parts of a data set, devices, sensors and sides.
_SPLITS = re.compile("train|training|test|testing|val|valid|validation|dev|eval|evaluation|holdout", re.IGNORECASE)
_DEVICES = re.compile(
    "(smart)?phone|(smart)?watch|acc|accel|accelerometer|gyro|gyroscope|mag|magnetometer|gravity|orientation|imu|"
    "linear(acceleration)?|barometer|left|right|raw|data|csv|wrist|ankle",
    re.IGNORECASE,
)
# A piece with one of these words is rather the label than the person.
_GESTURES = re.compile(
    "tap|pat|stroke|hit|squeeze|hug|scratch|shake|rub|poke|pull|push|pinch|tickle|press|hold|slap|grab|touch|swipe|wave|"
    "circle|rest|idle|none|still|walk(ing)?|run(ning)?|sit(ting)?|stand(ing)?|jump|clap|flick|punch|knock",
    re.IGNORECASE,
)


_NUMBERED = re.compile(r"(.*[^\W\d_])(\d+)", re.DOTALL)


@dataclass
class PathParts:
    """Guessed parts of paths: their ``patterns``, the ``labels``, the parts that were ``found``, and ``doubts``."""

    patterns: list[str]
    labels: Counter[str] = field(default_factory=Counter)
    found: set[str] = field(default_factory=set)
    doubts: list[str] = field(default_factory=list)


def guess_paths(
    files: Sequence[Path], ending: str, taken: Iterable[str], labels: Iterable[str] = (), *, dotted: bool = False
) -> PathParts:
    """Find out which parts of the paths are person, session, label and take.

    Args:
        files: paths below the source.
        taken: parts that have a column.
        labels: labels in columns; they may stand in paths, too.
        dotted: whether the label ends at the first full stop of a name, as in files of Edge Impulse.
    """
    taken = set(taken)
    doubts: list[str] = []
    depth = _usual_least([len(f.parts) for f in files])
    before = "**/" if any(len(f.parts) > depth for f in files) else ""
    rows, used = _pieces(files, ending, depth, dotted, doubts)
    limits = {"label": ":[^.]+"} if dotted else {}
    numbered = None if dotted or "label" in taken else _numbered(rows, depth, taken, set(labels), doubts)
    if numbered is not None:
        rows, roles = numbered
        limits["label"] = r":.*\D"
    else:
        roles = _roles(rows, depth, taken, set(labels), dotted, doubts)
    doubts += _to_check(rows, used, roles, depth)
    if "subject" not in taken | set(roles):
        doubts.append(
            "the person of a recording was not found: put {subject} into paths, give its column, or import with "
            "--subjects map.csv (file,subject)"
        )
    # What is the same in all paths stands there as it is, but for the characters of patterns; a name of all files tells
    # nothing apart, and the next recording may have another.
    texts = [
        f"{{{role}{limits.get(role, '')}}}" if role in PARTS else role or re.sub("[{}*?]", "?", rows[0][k])
        for k, role in enumerate(roles)
    ]
    folders = before + "".join(f"{text}/" for text in texts[: depth - 1])
    name = "*" if len({path.name for path in used}) == 1 else "".join(texts[depth - 1 :])
    found = Counter(row[roles.index("label")] for row in rows) if "label" in roles else Counter[str]()
    pattern = (folders + name if len(rows) > 1 else "*") + ending
    return PathParts([pattern], found, set(roles) & set(PARTS), doubts)


def _roles(
    rows: list[list[str]], depth: int, taken: set[str], labels: set[str], dotted: bool, doubts: list[str]
) -> list[str]:
    """Return the part that each piece of the paths is; "" for text that is the same everywhere, * for anything else."""
    roles: list[str] = []
    for k in range(len(rows[0])):
        roles.append(_role([row[k] for row in rows], len(rows) > 1, taken | set(roles), k))
    label_at = depth - 1 if dotted and "label" not in taken else _label_at(rows, roles, taken)
    if label_at is not None:
        roles[label_at] = "label"
    if dotted and len(rows[0]) > depth and "recording" not in taken:
        roles = ["*" if role == "recording" else role for role in roles]
        roles[depth + 1] = "recording"
    _different(rows, roles, taken, doubts)
    if "recording" in roles and "label" not in roles:
        # The files hold several recordings each, so that their number is rather that of a session.
        roles[roles.index("recording")] = "session" if "session" not in taken | set(roles) else "*"
    if "subject" not in taken | set(roles):
        _person(rows, roles, labels)
    return roles


def _to_check(rows: list[list[str]], files: Sequence[Path], roles: list[str], depth: int) -> Iterator[str]:
    """Yield what to check in the parts of the paths."""
    for part, what in (("label", "the label"), ("subject", "the person")):
        if part in roles:
            yield _examples(what, [row[roles.index(part)] for row in rows], files)
    for k, role in enumerate(roles):
        texts = {row[k] for row in rows}
        if role != "*" or (k >= depth - 1 and (len(texts) == 1 or not _known(texts, _SPLITS, _DEVICES))):
            continue
        listed = f"{'folders' if k < depth - 1 else 'files with'} {', '.join(sorted(texts)[:5])}"
        if _known(texts, _SPLITS):
            yield f"the {listed} are parts of a data set, neither labels nor people"
        else:
            yield (
                f"all of the {listed} are imported: if they hold other sensors, or the same recordings twice, name one "
                "in paths"
            )


def _pieces(
    files: Sequence[Path], ending: str, depth: int, dotted: bool, doubts: list[str]
) -> tuple[list[list[str]], list[Path]]:
    """Split paths into folders, and names at separators; return the same number of pieces of each, and the paths."""
    deep = [f for f in files if len(f.parts) >= depth]
    stems = [f.name[: len(f.name) - len(ending)] for f in deep]
    names = [re.split(r"(\.)", stem, maxsplit=1) if dotted else re.split(r"([_\-. ]+)", stem) for stem in stems]
    least = _usual_least([len(name) for name in names])
    rows, used = [], []
    for file, name in zip(deep, names, strict=True):
        if len(name) >= least:
            # Extra separators belong to the first piece, since labels may hold them.
            joined = ["".join(name[: len(name) - least + 1]), *name[len(name) - least + 1 :]]
            rows.append([*file.parts[-depth:-1], *joined])
            used.append(file)
    if others := len(files) - len(rows):
        doubts.append(f"files whose paths are not like the others do not fit paths: {others}")
    return rows, used


def _numbered(
    rows: list[list[str]], depth: int, taken: set[str], labels: set[str], doubts: list[str]
) -> tuple[list[list[str]], list[str]] | None:
    """Split labels with a number behind them, such as ``tap1``; return pieces and roles, None without such labels.

    Two words at least are needed, each with several numbers; words of people, takes, parts of a data set and devices
    are no labels.
    """
    for k in range(depth - 1, len(rows[0])):
        pairs = [match.groups() for row in rows if (match := _NUMBERED.fullmatch(row[k]))]
        numbers = Counter(word for word, _ in set(pairs))
        few = 2 <= len(numbers) <= MOST_LABELS and min(numbers.values()) > 1
        known = all(any(p.fullmatch(row[k]) for p in (_PERSON, _TAKE, _SESSION)) for row in rows)
        if len(pairs) < len(rows) or not few or known or _known(numbers, _SPLITS, _DEVICES):
            continue
        notes: list[str] = []
        words = [[*row[:k], word, *row[k + 1 :]] for row, (word, _) in zip(rows, pairs, strict=True)]
        roles = _roles(words, depth, taken, labels, False, notes)
        if roles[k] == "label":
            other = next(n for word, n in pairs if word == pairs[0][0] and n != pairs[0][1])
            doubts += notes
            doubts.append(
                f"'{rows[0][k]}' and '{pairs[0][0]}{other}' in the path are taken for one label with a number behind "
                "it: if they are two gestures, write {label} for both"
            )
            split = [[*row[:k], *pair, *row[k + 1 :]] for row, pair in zip(rows, pairs, strict=True)]
            return split, [*roles[: k + 1], "*" if "recording" in taken | set(roles) else "recording", *roles[k + 1 :]]
    return None


def _usual_least(numbers: Sequence[int]) -> int:
    """Return the largest number that nine of ten ``numbers`` reach."""
    return sorted(numbers)[len(numbers) // 10]


def _known(texts: Iterable[str], *words: re.Pattern[str]) -> bool:
    """Return whether all ``texts`` are among some words, apart from a number at the end."""
    plain = [re.sub(r"[\W_]*\d*$", "", text) for text in texts]
    return all(any(known.fullmatch(text) for known in words) for text in plain)


def _role(texts: list[str], several: bool, taken: set[str], at: int) -> str:
    """Return the part that a piece of all paths is, as `_roles`, unless it is the label."""
    distinct = set(texts)
    if not any(c.isalnum() for c in texts[0]):
        return "" if len(distinct) == 1 else "*"
    if all(_PERSON.fullmatch(t) for t in texts) and "subject" not in taken:
        return "subject"
    if len(distinct) == 1:
        return "" if several else "*"
    if _known(distinct, _SPLITS, _DEVICES):
        return "*"
    if all(_SESSION.fullmatch(t) for t in texts) and "session" not in taken:
        return "session"
    if all(t.isdecimal() or _TAKE.fullmatch(t) for t in texts):
        return "recording" if "recording" not in taken and at else "*"
    return "*"


def _label_at(rows: list[list[str]], roles: list[str], taken: set[str]) -> int | None:
    """Return the piece that is the label; None if there is none.

    The first one with words of gestures is taken, else the first one whose texts are those of several people, else the
    first.
    """
    person = roles.index("subject") if "subject" in roles else None
    found: dict[int, tuple[bool, bool]] = {}
    for k in [k for k, role in enumerate(roles) if role == "*"]:
        texts = {row[k] for row in rows}
        words = {w for text in texts for w in re.split(r"[\W\d_]+|(?<=[a-z])(?=[A-Z])", text) if w}
        of_gesture = any(map(_GESTURES.fullmatch, words))
        few = 1 < len(texts) <= (MOST_LABELS if of_gesture else min(MOST_LABELS, max(2, len(rows) // 2)))
        other = _known(texts, _SPLITS, _DEVICES) or all(t.isdecimal() or _TAKE.fullmatch(t) for t in texts)
        if few and not other and re.search(r"[^\W_]", rows[0][k]):
            of_one = person is not None and len({(row[k], row[person]) for row in rows}) == len(texts)
            found[k] = (of_gesture, not of_one)
    return max(found, key=lambda k: found[k], default=None) if "label" not in taken else None


def _different(rows: list[list[str]], roles: list[str], taken: set[str], doubts: list[str]) -> None:
    """Make a piece that differs in every path the take; in files of one recording each it is no person either."""
    for k, role in enumerate(roles):
        texts = {row[k] for row in rows}
        of_one = role == "subject" and "label" in roles
        if len(rows) < 2 or len(texts) < len(rows) or (role != "*" and not of_one):
            continue
        # Names of people who have one file each look the same.
        roles[k] = "recording" if "recording" not in taken | set(roles) else "*"
        doubts.append(
            f"'{rows[0][k]}' in the path differs in every file, so that it is taken for the take, not for a person"
        )


def _person(rows: list[list[str]], roles: list[str], labels: set[str]) -> None:
    """Make the piece with the most texts the person, if there is one that stands in several files."""
    several = {}
    label = roles.index("label") if "label" in roles else None
    for k, role in enumerate(roles):
        texts = {row[k] for row in rows}
        other = all(_TAKE.fullmatch(text) for text in texts) or _known(texts, _SPLITS, _DEVICES)
        # A person has several gestures; a text with one gesture each is another word for it.
        of_label = label is not None and len({(row[k], row[label]) for row in rows}) == len(texts)
        other = other or texts <= labels or of_label
        if role in ("*", "session") and 1 < len(texts) < len(rows) and not other and re.search(r"[^\W_]", rows[0][k]):
            several[k] = texts
    if several:
        roles[max(several, key=lambda k: (len(several[k]), rows[0][k][:1].isalpha()))] = "subject"


def _examples(what: str, texts: list[str], files: Sequence[Path]) -> str:
    """Return that a part comes from paths, with two examples."""
    first = 0
    second = next((k for k, text in enumerate(texts) if text != texts[first]), None)
    listed = [f"'{texts[k]}' of {files[k].as_posix()}" for k in (first, second) if k is not None]
    return f"{what} is taken from the path: {' and '.join(listed)}"
