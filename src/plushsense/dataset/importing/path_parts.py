"""Guess which parts of the paths of files are the person, the session, the label and the take of a recording."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.sentences import Message
from plushsense.dataset.importing.pattern import PARTS

MOST_LABELS = 60
_PERSON = re.compile(r"(s|p|subj|subject|sub|participant|person|user|u|id|child|kid)[-_ ]?\d+", re.IGNORECASE)
_SESSION = re.compile(r"(session|ses|day|visit|run)[-_ ]?\d*", re.IGNORECASE)
_RUN = re.compile(r"run[-_ ]?\d+", re.IGNORECASE)
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


PATH, COLUMN = "path", "column"
_EXAMPLES = 4


@dataclass(frozen=True)
class Candidate:
    """A piece of the paths or a column, and what it is taken for.

    Attributes:
        key: ``path:1`` for the second piece of the paths, ``path:1.word`` and ``path:1.number`` for its parts, or
            ``column:NAME``.
        role: one of `pattern.PARTS`, ``time``, ``channel``, or "" for nothing.
        examples: some of its texts.
        numeric: whether it may be a channel.
        in_folder: whether it is the name of a folder.
    """

    key: str
    role: str
    examples: tuple[str, ...]
    numeric: bool = False
    in_folder: bool = False

    @staticmethod
    def of(key: str, role: str, texts: Iterable[str], *, numeric: bool = False, in_folder: bool = False) -> Candidate:
        """Return the candidate with the first distinct ``texts`` as examples."""
        return Candidate(key, role, tuple(dict.fromkeys(texts))[:_EXAMPLES], numeric, in_folder)


@dataclass
class PathParts:
    """Guessed parts of paths: their ``patterns``, the ``labels``, the parts that were ``found``, and ``doubts``."""

    patterns: list[str]
    labels: Counter[str] = field(default_factory=Counter)
    found: set[str] = field(default_factory=set)
    doubts: list[Message] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)


@dataclass(frozen=True)
class _Stated:
    """The pieces of paths whose part is stated: by their place, and the part of a number behind a word."""

    parts: dict[int, str]
    whole: set[int]
    number: str

    @staticmethod
    def of(keys: Mapping[str, str]) -> _Stated:
        """Return the places of ``keys`` (by part)."""
        places = {part: key.removeprefix(f"{PATH}:") for part, key in keys.items() if key.startswith(f"{PATH}:")}
        at = [(part, place.partition(".")) for part, place in places.items()]
        words = {int(place): part for part, (place, _, rest) in at if rest != "number"}
        whole = {int(place) for _, (place, _, rest) in at if not rest}
        return _Stated(words, whole, next((part for part, (_, _, rest) in at if rest == "number"), ""))


def guess_paths(
    files: Sequence[Path],
    ending: str,
    taken: Iterable[str],
    labels: Iterable[str] = (),
    *,
    dotted: bool = False,
    stated: Mapping[str, str] | None = None,
) -> PathParts:
    """Find out which parts of the paths are person, session, label and take.

    Args:
        files: paths below the source.
        taken: parts that have a column.
        labels: labels in columns; they may stand in paths, too.
        dotted: whether the label ends at the first full stop of a name, as in files of Edge Impulse.
        stated: key of the candidate of each part that is not to be guessed; "" for a part that is nowhere.
    """
    stated = stated or {}
    fixed = _Stated.of(stated)
    taken = set(taken) | set(stated) - set(fixed.parts.values())
    doubts: list[Message] = []
    depth = _usual_least([len(f.parts) for f in files])
    before = "**/" if any(len(f.parts) > depth for f in files) else ""
    rows, used = _pieces(files, ending, depth, dotted, doubts)
    limits = {"label": ":[^.]+"} if dotted else {}
    task = _PathTask(depth, frozenset(taken), frozenset(labels), dotted, fixed)
    numbered = None if dotted or "label" in taken else _numbered(rows, task, doubts)
    keys = [str(k) for k in range(len(rows[0]))]
    whole = [] if numbered is None else [(str(numbered[2]), [row[numbered[2]] for row in rows])]
    if numbered is not None:
        rows, roles, at = numbered
        keys[at : at + 1] = [f"{at}.word", f"{at}.number"]
        limits["label"] = r":.*\D"
    else:
        roles = _roles(rows, task, doubts)
    doubts += _to_check(rows, used, roles, depth, set(stated))
    if "subject" not in taken | set(roles):
        doubts.append(
            Message(
                "the person of a recording was not found: put {{subject}} into paths, give its column, or import with "
                "--subjects map.csv (file,subject)",
                about="subject",
            )
        )
    # What is the same in all paths stands there as it is, but for the characters of patterns; a name of all files tells
    # nothing apart, and the next recording may have another.
    texts = [
        f"{{{role}{limits.get(role, '')}}}" if role in PARTS else role or re.sub("[{}*?]", "?", rows[0][k])
        for k, role in enumerate(roles)
    ]
    folders = before + "".join(f"{text}/" for text in texts[: depth - 1])
    same = len({path.name for path in used}) == 1 and not set(roles[depth - 1 :]) & set(PARTS)
    name = "*" if same else "".join(texts[depth - 1 :])
    found = Counter(row[roles.index("label")] for row in rows) if "label" in roles else Counter[str]()
    pattern = (folders + name if len(rows) > 1 or fixed.parts else "*") + ending
    pieces = [(key, role, [row[k] for row in rows]) for k, (key, role) in enumerate(zip(keys, roles, strict=True))]
    candidates = _candidates([*pieces, *((key, "", texts) for key, texts in whole)], depth)
    return PathParts([pattern], found, set(roles) & set(PARTS), doubts, candidates)


def _candidates(pieces: Iterable[tuple[str, str, list[str]]], depth: int) -> list[Candidate]:
    """Return what may be chosen of the pieces of paths: key, role and the texts of all paths."""
    return [
        Candidate.of(
            f"{PATH}:{key}", role if role in PARTS else "", texts, in_folder=int(key.split(".")[0]) < depth - 1
        )
        for key, role, texts in pieces
        if re.search(r"[^\W_]", "".join(texts))
    ]


@dataclass(frozen=True)
class _PathTask:
    """What is known of pieces of paths before their parts are guessed; see `guess_paths`."""

    depth: int
    taken: frozenset[str]
    labels: frozenset[str]
    dotted: bool
    fixed: _Stated


def _roles(rows: list[list[str]], task: _PathTask, doubts: list[Message]) -> list[str]:
    """Return the part that each piece of the paths is; "" for text that is the same everywhere, * for anything else."""
    depth, fixed = task.depth, task.fixed.parts
    taken = set(task.taken) | set(fixed.values()) | {task.fixed.number}
    roles: list[str] = []
    for k in range(len(rows[0])):
        guessed = fixed.get(k) or _role([row[k] for row in rows], len(rows) > 1, taken | set(roles), k)
        roles.append(guessed)
    label_at = depth - 1 if task.dotted and "label" not in taken else _label_at(rows, roles, taken)
    if label_at is not None and label_at not in fixed:
        roles[label_at] = "label"
    # In the folder of a gesture, the runs are its repetitions; elsewhere a run may be a session.
    of_gesture = range(label_at + 1, len(roles)) if label_at is not None and label_at < depth - 1 else range(0)
    runs = [k for k in of_gesture if roles[k] == "session" and all(_RUN.fullmatch(row[k]) for row in rows)]
    _make_take(runs, roles, taken, fixed)
    if task.dotted and len(rows[0]) > depth and "recording" not in taken:
        roles = ["*" if role == "recording" else role for role in roles]
        roles[depth + 1] = "recording"
    _different(rows, roles, taken, fixed, doubts)
    if "recording" in roles and "label" not in roles and "recording" not in taken:
        # The files hold several recordings each, so that their number is rather that of a session.
        roles[roles.index("recording")] = "session" if "session" not in taken | set(roles) else "*"
    if "subject" not in taken | set(roles):
        _person(rows, roles, set(task.labels))
    numbered = [k for k in of_gesture if roles[k] == "*" and _one_word_numbered(row[k] for row in rows)]
    _make_take(numbered, roles, taken, fixed)
    return roles


def _make_take(pieces: list[int], roles: list[str], taken: set[str], fixed: Mapping[int, str]) -> None:
    """Make the first of ``pieces`` the take, unless there is one."""
    for k in [k for k in pieces if k not in fixed][:1]:
        if "recording" not in taken | set(roles):
            roles[k] = "recording"


def _one_word_numbered(texts: Iterable[str]) -> bool:
    """Return whether texts are one word with different numbers behind it, as ``file1``, ``file2``."""
    found = [_NUMBERED.fullmatch(text) for text in set(texts)]
    return len(found) > 1 and all(found) and len({m[1] for m in found if m is not None}) == 1


def _to_check(
    rows: list[list[str]], files: Sequence[Path], roles: list[str], depth: int, stated: set[str]
) -> Iterator[Message]:
    """Yield what to check in the parts of the paths."""
    for part, template in _TAKEN_FROM.items():
        if part in roles and part not in stated:
            listed = _examples([row[roles.index(part)] for row in rows], files)
            yield Message(template, listed=listed, about=part)
    for k, role in enumerate(roles):
        texts = {row[k] for row in rows}
        if role != "*" or (k >= depth - 1 and (len(texts) == 1 or not _known(texts, _SPLITS, _DEVICES))):
            continue
        listed = f"{'folders' if k < depth - 1 else 'files with'} {', '.join(sorted(texts)[:5])}"
        names = sorted(texts)[:5]
        if _known(texts, _SPLITS):
            yield Message(
                "the {listed} are parts of a data set, neither labels nor people",
                listed=listed,
                names=names,
                about="files",
            )
        else:
            yield Message(
                "all of the {listed} are imported: if they hold other sensors, or the same recordings twice, name one "
                "in paths",
                listed=listed,
                names=names,
                about="files",
            )


def _pieces(
    files: Sequence[Path], ending: str, depth: int, dotted: bool, doubts: list[Message]
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
        doubts.append(
            Message("files whose paths are not like the others do not fit paths: {n}", n=others, about="files")
        )
    return rows, used


def _numbered(
    rows: list[list[str]], task: _PathTask, doubts: list[Message]
) -> tuple[list[list[str]], list[str], int] | None:
    """Split labels with a number behind them, such as ``tap1``; return pieces, roles and the place of the label.

    Return None without such labels.

    Two words at least are needed, each with several numbers; words of people, takes, parts of a data set and devices
    are no labels.
    """
    for k in [k for k in range(task.depth - 1, len(rows[0])) if k not in task.fixed.whole]:
        pairs = [match.groups() for row in rows if (match := _NUMBERED.fullmatch(row[k]))]
        numbers = Counter(word for word, _ in set(pairs))
        few = 2 <= len(numbers) <= MOST_LABELS and min(numbers.values()) > 1
        known = all(any(p.fullmatch(row[k]) for p in (_PERSON, _TAKE, _SESSION)) for row in rows)
        if len(pairs) < len(rows) or not few or known or _known(numbers, _SPLITS, _DEVICES):
            continue
        notes: list[Message] = []
        words = [[*row[:k], word, *row[k + 1 :]] for row, (word, _) in zip(rows, pairs, strict=True)]
        roles = _roles(words, task, notes)
        if roles[k] == "label":
            other = next(n for word, n in pairs if word == pairs[0][0] and n != pairs[0][1])
            doubts += notes
            if k not in task.fixed.parts:
                doubts.append(
                    Message(
                        "'{first}' and '{second}' in the path are taken for one label with a number behind it: if they "
                        "are two gestures, write {{label}} for both",
                        first=rows[0][k],
                        second=pairs[0][0] + other,
                        about="label",
                    )
                )
            split = [[*row[:k], *pair, *row[k + 1 :]] for row, pair in zip(rows, pairs, strict=True)]
            number = task.fixed.number or ("*" if "recording" in task.taken | set(roles) else "recording")
            return split, [*roles[: k + 1], number, *roles[k + 1 :]], k
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


def _different(
    rows: list[list[str]], roles: list[str], taken: set[str], fixed: Mapping[int, str], doubts: list[Message]
) -> None:
    """Make a piece that differs in every path the take; in files of one recording each it is no person either."""
    for k, role in enumerate(roles):
        texts = {row[k] for row in rows}
        of_one = role == "subject" and "label" in roles
        if len(rows) < 2 or len(texts) < len(rows) or (role != "*" and not of_one) or k in fixed:
            continue
        # Names of people who have one file each look the same.
        roles[k] = "recording" if "recording" not in taken | set(roles) else "*"
        doubts.append(
            Message(
                "'{text}' in the path differs in every file, so that it is taken for the take, not for a person",
                text=rows[0][k],
                about="recording",
            )
        )


def _person(rows: list[list[str]], roles: list[str], labels: set[str]) -> None:
    """Make the piece with the most texts the person, if there is one that stands in several files.

    A piece that reads like a session, or is one word with numbers, is the person only if no other can be.
    """
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
        named = {k: roles[k] == "*" and not _one_word_numbered(texts) for k, texts in several.items()}
        best = max(several, key=lambda k: (named[k], len(several[k]), rows[0][k][:1].isalpha()))
        roles[best] = "subject"


_TAKEN_FROM = {
    "label": "the label is taken from the path: {listed}",
    "subject": "the person is taken from the path: {listed}",
}


def _examples(texts: list[str], files: Sequence[Path]) -> str:
    """Return two examples of a part that comes from paths."""
    second = next((k for k, text in enumerate(texts) if text != texts[0]), None)
    return " and ".join(f"'{texts[k]}' of {files[k].as_posix()}" for k in (0, second) if k is not None)
