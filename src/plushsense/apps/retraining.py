"""Which models were trained on a person: what `forget` cannot reach, and somebody has to train again."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import BundleError, DatasetError
from plushsense.dataset.forget import Leaving, leaving
from plushsense.dataset.forget import forget as take_out
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import DatasetHead
from plushsense.models.bundle import Bundle

SUFFIX = ".plush"


@dataclass(frozen=True)
class TrainedOn:
    """A bundle that names the person's code, or may be of them; ``certain`` where its data set had the content that
    this one has."""

    bundle: str
    certain: bool
    message: str


@dataclass(frozen=True)
class Forgotten:
    """What left a data set (or would leave, without ``done``), and the bundles that were trained on it."""

    leaving: Leaving
    bundles: list[TrainedOn]
    done: bool
    dataset: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "dataset": self.dataset,
            "done": self.done,
            **self.leaving.to_dict(),
            "bundles": [vars(b) for b in self.bundles],
        }


def forget(
    dataset: str | os.PathLike[str],
    subject: str,
    *,
    confirm: bool = False,
    bundles: Iterable[str | os.PathLike[str]] = (),
) -> Forgotten:
    """Take a person out of a data set for good; without ``confirm``, only say what would go.

    Args:
        bundles: folders (or files) to search for models that were trained on the person; the data set's own folder is
            searched always. Models are named, not changed: train them again, and remove the old ones.

    Raises:
        DatasetError: when the data set does not know the person.
    """
    folder = Path(dataset)
    plan = leaving(folder, subject)
    found = trained_on(folder, subject, [folder, *map(Path, bundles)])
    if confirm:
        plan = take_out(folder, subject)
    return Forgotten(plan, found, confirm, str(folder))


def trained_on(folder: Path, subject: str, places: Iterable[Path]) -> list[TrainedOn]:
    """Bundles below ``places`` that name the person among those they were trained or validated on.

    A bundle that cannot be read is named too, and so is one of this data set that was exported: nobody knows.
    """
    name = DatasetHead.read(folder).name
    try:
        content = open_dataset(folder).hash
    except DatasetError:
        # A run that was stopped half-way: the name has to do.
        content = ""
    out = []
    for path in _bundles(places):
        try:
            bundle = Bundle.load(path)
            provenance = bundle.provenance
        except BundleError as cause:
            out.append(TrainedOn(str(path), False, f"cannot be read, so nobody knows: {cause}"))
            continue
        theirs = provenance.get("dataset_hash"), provenance.get("dataset")
        people = [provenance.get(key, ()) for key in ("subjects", "validation_subjects")]
        if any(isinstance(each, int) for each in people):
            # An export tells strangers how many, not who.
            if theirs[0] == content or theirs[1] == name:
                said = "belongs to an export of this data set and does not say who: the bundle that it was made of does"
                out.append(TrainedOn(str(path), False, said))
            continue
        if subject not in {who for each in people for who in each}:
            if bundle.adapted_to == subject:
                said = "adapted to this code: remove it, or take that back with  plushsense adapt BUNDLE --undo"
                out.append(TrainedOn(str(path), False, said))
            continue
        if certain := theirs[0] == content:
            said = "trained on this person: train it again without them, and remove it"
        elif theirs[1] == name:
            said = "trained on this code in an earlier state of this data set: train it again, and remove it"
        else:
            said = f"trained on this code in the data set '{theirs[1]}': look whether it is the same person"
        out.append(TrainedOn(str(path), certain, said))
    return out


def _bundles(places: Iterable[Path]) -> list[Path]:
    found: dict[Path, Path] = {}
    for place in places:
        if not place.exists():
            raise DatasetError(f"There is no folder '{place}' to search for bundles: check the path.")
        files = (
            [place]
            if place.is_file()
            else [Path(at) / name for at, _, names in os.walk(place) for name in names if name.lower().endswith(SUFFIX)]
        )
        for path in sorted(files):
            found.setdefault(path.resolve(), path)
    return list(found.values())
