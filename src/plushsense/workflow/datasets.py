"""Checking a data set from Python: findings, figures, a page, decisions."""

from __future__ import annotations

import html
import os
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.core.errors import BundleError, ConfigError, DatasetError
from plushsense.dataset.index import as_dataset, open_dataset
from plushsense.dataset.marks import append_marks
from plushsense.dataset.privacy.forget import RemovalPlan, plan_removal
from plushsense.dataset.privacy.forget import forget as take_out
from plushsense.dataset.publishing.checking import StageProgress, validate_package
from plushsense.dataset.publishing.contents import PublishOptions, public_codes
from plushsense.dataset.publishing.package import (
    PublishResult,
    Reidentification,
    check_output_folder,
    complete_head,
    publish,
    require_validators,
    save_head,
)
from plushsense.dataset.quality import checking
from plushsense.dataset.quality.checking import CheckReport, Progress, check
from plushsense.dataset.quality.findings import CheckLimits
from plushsense.dataset.store import Dataset, DatasetHead
from plushsense.evaluation.reidentification import reidentify, report, verdict
from plushsense.models.bundle import Bundle

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_SHOWN = 50


@dataclass(frozen=True)
class CheckResult(CheckReport):
    """Findings of the checks: ``findings``, ``counts()``, ``undecided``; displays itself in a notebook."""

    def figure(self, gesture: str) -> Figure:
        """Draw all recordings of a gesture over each other, with outliers named, and their durations.

        Raises:
            GestureError: for a gesture that the data set has not.
        """
        from plushsense.reports.quality import gesture_figure

        return gesture_figure(self, self.dataset.gestures.get(gesture).label)

    def report(self, path: str | os.PathLike[str], progress: Progress | None = None) -> Path:
        """Write one self-contained HTML page with plots; only an older page of PlushSense is replaced."""
        from plushsense.reports.quality import write_report

        return write_report(Path(path), self, progress=progress)

    def __repr__(self) -> str:
        n = self.counts()["by_severity"]
        return (
            f"CheckResult({self.dataset.head.name!r}: {self.recordings} recordings, "
            f"{n['error']} errors, {n['warning']} warnings, {n['info']} notes)"
        )

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{f.severity}</td><td>{html.escape(f.check)}</td><td>{html.escape(f.about or 'data set')}</td>"
            f"<td>{html.escape(f.message)}{' (accepted)' if f.accepted else ''}</td></tr>"
            for f in self.findings[:_SHOWN]
        )
        more = f"<p>… and {len(self.findings) - _SHOWN} more</p>" if len(self.findings) > _SHOWN else ""
        head = "".join(f"<th>{h}</th>" for h in ("severity", "check", "about", "finding"))
        return f"<p>{html.escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>{more}"


def check_dataset(
    dataset: Dataset | str | os.PathLike[str],
    *,
    only: Iterable[str] = (),
    limits: CheckLimits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> CheckResult:
    """Look at every recording and stream of a data set.

    Args:
        only: names of checks (`plushsense.dataset.quality.CHECKS`); all by default.
        limits: from where on something is worth saying, e.g. ``{"duration": 0.5}``.
        progress: called with (files done, files in all).

    Raises:
        ConfigError: for a check or limit that is not known.
        DatasetError: for a folder that is no data set.
    """
    if not isinstance(limits, CheckLimits):
        limits = CheckLimits().changed(limits or {})
    return _result(check(as_dataset(dataset), only=only, limits=limits, progress=progress))


def decide(
    dataset: Dataset | str | os.PathLike[str],
    *,
    accept: Sequence[str] = (),
    unaccept: Sequence[str] = (),
    exclude: Sequence[str] = (),
    include: Sequence[str] = (),
    why: str = "",
    who: str | None = None,
    only: Iterable[str] = (),
    limits: CheckLimits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> tuple[CheckResult, int]:
    """Mark decisions, then check: the result, and how many marks were added.

    Args:
        accept, unaccept: ``CHECK:PATTERN``, e.g. ``gaps:P26/*``; without a pattern, the data set as a whole.
        exclude, include: patterns of recordings, e.g. ``P19/*``.
        why: the reason; accepting and excluding need one. ``who``: by default the login name.

    Raises:
        ConfigError: without a reason, or for a check that is not known.
        DatasetError: for a pattern that names nothing.
    """
    if (accept or exclude) and not why.strip():
        raise ConfigError('Accepting and excluding need a reason: say it with --why "…".')
    dataset = as_dataset(dataset)
    name = checking.author_name(who) if accept or unaccept or exclude or include else ""
    # Everything is looked up before anything is marked: a wrong pattern leaves no half of a decision behind.
    marks = checking.exclusions(dataset, exclude, include, who=name, why=why)
    marks += checking.withdrawals(dataset, unaccept, who=name, why=why)
    for said in accept:
        checking.parse_acceptance(said)
    if accept:
        marks += checking.acceptances(check_dataset(dataset, limits=limits), accept, who=name, why=why)
    if marks:
        append_marks(dataset.path, marks)
        dataset = as_dataset(dataset.path)
    return check_dataset(dataset, only=only, limits=limits, progress=progress), len(marks)


def _result(checked: CheckReport) -> CheckResult:
    return CheckResult(**{f.name: getattr(checked, f.name) for f in fields(CheckReport)})


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
    progress: StageProgress | None = None,
) -> PublishResult:
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
        progress: called with the name of the stage, the work done and its total.

    Raises:
        DatasetError: without licence, contact or consent statement, or when ``out`` is taken.
        MissingExtraError: without the validators, or (for the re-identification) scikit-learn.
    """
    dataset = as_dataset(dataset)
    place = Path(out)
    require_validators()
    head = complete_head(dataset.head, dataset.path, licence, contact, consent)
    check_output_folder(dataset, place)
    secret = secrets.token_bytes(_KEY_BYTES) if key is None else _read_key(Path(key), dataset.path, place)
    options = PublishOptions(streams, excluded, columns, secret)
    found = None
    if reidentification:
        steps = (lambda done, total: progress("recognising people", done, total)) if progress else None
        tried = reidentify(dataset, seed=seed, progress=steps).under(public_codes(dataset))
        command = f"plushsense publish DATASET OUT --seed {seed}"
        found = Reidentification(report(tried, command), verdict(tried), tried.to_dict())
    done = publish(
        dataset,
        place,
        head,
        options=options,
        bids=bids,
        reidentification=found,
        published=published,
        thorough=thorough,
        progress=progress,
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
    """Read the secret that time shifts are drawn from; create it, readable by its owner only, where there is none."""
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


SUFFIX = ".plush"


@dataclass(frozen=True)
class TrainedOn:
    """A bundle that names the person's code, or may be of them; ``certain`` where its data set had the content that
    this one has.
    """

    bundle: str
    certain: bool
    message: str


@dataclass(frozen=True)
class Forgotten:
    """Files that left a data set (or would leave it, without ``done``), and the bundles trained on the person."""

    plan: RemovalPlan
    bundles: list[TrainedOn]
    done: bool
    dataset: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "dataset": self.dataset,
            "done": self.done,
            **self.plan.to_dict(),
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
    plan = plan_removal(folder, subject)
    found = trained_on(folder, subject, [folder, *map(Path, bundles)])
    if confirm:
        plan = take_out(folder, subject)
    return Forgotten(plan, found, confirm, str(folder))


def trained_on(folder: Path, subject: str, places: Iterable[Path]) -> list[TrainedOn]:
    """Find the bundles below ``places`` that name the person among their training or validation people.

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
