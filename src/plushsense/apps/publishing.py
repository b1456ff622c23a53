"""Publishing a data set: the package, and whether its people can be recognised. Neither room knows of the other."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from plushsense.apps.preparation import opened
from plushsense.core.errors import DatasetError
from plushsense.dataset.publish.checking import Tell, validate_package
from plushsense.dataset.publish.contents import Options, public_codes
from plushsense.dataset.publish.package import (
    Published,
    Reidentification,
    complete_head,
    need_tools,
    publish,
    refuse_place,
    save_head,
)
from plushsense.dataset.store import Dataset
from plushsense.evaluation.reidentification import reidentify
from plushsense.evaluation.reidentification_words import report, short

__all__ = ["publish_dataset", "validate_package"]

_KEY_BYTES = 32


def publish_dataset(
    dataset: Dataset | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    licence: str = "",
    contact: str = "",
    consent: str = "",
    save: bool = False,
    streams: bool = True,
    excluded: bool = False,
    columns: tuple[str, ...] = (),
    key: str | os.PathLike[str] | None = None,
    bids: bool = False,
    reidentification: bool = True,
    seed: int = 1,
    published: str | None = None,
    thorough: bool = False,
    tell: Tell | None = None,
) -> Published:
    """Write a data set as a package that strangers can use, prove it with validators, and pack it as ``out.zip``.

    Args:
        out: a new or empty folder.
        licence, contact, consent: what ``dataset.toml`` does not say yet: an SPDX name, "Name <mail>", a statement.
        save: also write these into the data set's ``dataset.toml``.
        streams: publish whole sessions too, with everything between the gestures.
        excluded: publish excluded recordings too, marked.
        columns: of ``subjects.csv``, besides age group and gender.
        key: a file outside the data set that fixes the shifts of time, made where there is none, so that the next
            version has the same; without, they are drawn anew each time.
        bids: add a Motion-BIDS-like tree.
        reidentification: look whether the people can be recognised, and say it in the package.
        published: the day, ISO (today).
        thorough: let the slow validators read every row of the streams too.
        tell: called with what is being done, how much of it, and of how much.

    Raises:
        DatasetError: without licence, contact or consent statement, or when ``out`` is taken.
        MissingExtraError: without the validators, or (for the re-identification) scikit-learn.
    """
    dataset = opened(dataset)
    place = Path(out)
    need_tools()
    head = complete_head(dataset.head, dataset.path, licence, contact, consent)
    refuse_place(dataset, place)
    secret = secrets.token_bytes(_KEY_BYTES) if key is None else _read_key(Path(key), dataset.path, place)
    options = Options(streams, excluded, columns, secret)
    found = None
    if reidentification:
        steps = (lambda done, total: tell("recognising people", done, total)) if tell else None
        tried = reidentify(dataset, seed=seed, progress=steps).under(public_codes(dataset))
        command = f"plushsense publish DATASET OUT --seed {seed}"
        found = Reidentification(report(tried, command), short(tried), tried.to_dict())
    done = publish(
        dataset,
        place,
        head,
        options=options,
        bids=bids,
        reidentification=found,
        published=published,
        thorough=thorough,
        tell=tell,
    )
    if save:
        try:
            save_head(dataset, head)
        except OSError as cause:
            # The package stands: that is no reason to say that it was refused.
            done.warnings.append(
                f"licence, contact and consent could not be written into '{dataset.path}': {cause.strerror or cause}"
            )
    return done


def _read_key(path: Path, *beside: Path) -> bytes:
    """The secret that shifts are drawn from; made where there is none, readable by its owner only."""
    for folder in beside:
        if folder.resolve() in path.resolve().parents:
            raise DatasetError(f"The key '{path}' lies in '{folder}': keep it elsewhere, or it leaves with the data.")
    try:
        if path.exists():
            found = bytes.fromhex(path.read_text(encoding="ascii"))
            if len(found) < _KEY_BYTES // 2:
                raise ValueError("too short")
            return found
        made = secrets.token_bytes(_KEY_BYTES)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(made.hex() + "\n")
        return made
    except ValueError:
        raise DatasetError(f"'{path}' is no key that publishing made: name a file that does not exist yet.") from None
    except OSError as cause:
        raise DatasetError(f"The key '{path}' cannot be used: {cause.strerror or cause}.") from None
