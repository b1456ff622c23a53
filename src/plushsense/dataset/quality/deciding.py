"""Decisions about findings as marks: accept and exclude, and taking both back."""

from __future__ import annotations

import getpass
from collections.abc import Sequence

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset.marks import Mark, matching, read_marks
from plushsense.dataset.quality.checking import Checked, known_checks
from plushsense.dataset.store import Dataset


def signed(who: str | None) -> str:
    """Who decides: the name given, else the login name.

    Raises:
        ConfigError: where nobody is logged in by name.
    """
    if who:
        return who
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        raise ConfigError("Nobody is logged in by name here: say who decides with --who NAME.") from None


def exclusions(
    dataset: Dataset, exclude: Sequence[str] = (), include: Sequence[str] = (), *, who: str, why: str
) -> list[Mark]:
    """Marks that take recordings out of use, or back in; patterns name recordings."""
    marks = []
    used, out = {r.id for r in dataset.used}, {r.id for r in dataset.recordings if r.excluded}
    for pattern in exclude:
        ids = matching(pattern, used | out, "recording")
        marks += [Mark(i, "exclude", who, why) for i in ids if i in used]
    for pattern in include:
        ids = matching(pattern, used | out, "recording")
        marks += [Mark(i, "include", who, why) for i in ids if i in out]
    return marks


def parted(said: str) -> tuple[str, str]:
    """``CHECK:PATTERN`` in its parts; without a pattern, the data set as a whole is meant.

    Raises:
        ConfigError: for a check that is not known.
    """
    check, _, pattern = said.partition(":")
    known_checks([check])
    return check, pattern


def acceptances(checked: Checked, accept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Marks that accept findings: ``CHECK:PATTERN``, where the pattern names recordings, streams or people.

    Only what was found can be accepted, so that a later fault does not pass unseen.

    Raises:
        DatasetError: when the check found nothing there.
    """
    marks = []
    for said in accept:
        check, pattern = parted(said)
        found = {f.about: f for f in checked.of(check)}
        if not found:
            raise DatasetError(f"The check '{check}' found nothing, so there is nothing to accept.")
        ids = [""] if not pattern and "" in found else matching(pattern, found, f"finding of '{check}' about")
        marks += [Mark(i, "accept", who, why, check=check) for i in ids if not found[i].accepted]
    return marks


def withdrawals(dataset: Dataset, unaccept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Marks that take acceptances back.

    Raises:
        DatasetError: when none of the kind stands.
    """
    marks = []
    standing = read_marks(dataset.path)
    for said in unaccept:
        check, pattern = parted(said)
        accepted = [i for i, mark in standing.items() if check in mark.accepted]
        if not accepted:
            raise DatasetError(f"Nothing that '{check}' found was accepted, so there is nothing to take back.")
        ids = (
            [""] if not pattern and "" in accepted else matching(pattern, accepted, f"accepted finding of '{check}' on")
        )
        marks += [Mark(i, "unaccept", who, why, check=check) for i in ids]
    return marks
