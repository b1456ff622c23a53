"""Check a data set, mark decisions, and publish it."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.sentences import Message, plural
from plushsense.dataset.files import change_head
from plushsense.dataset.index import as_dataset
from plushsense.dataset.publishing.checking import StageProgress
from plushsense.dataset.publishing.contents import ContentsSpec, person_codes, public_codes, public_labels
from plushsense.dataset.publishing.keys import open_key
from plushsense.dataset.publishing.package import (
    CopyResult,
    PackageSpec,
    PublishResult,
    Reidentification,
    check_output_folder,
    complete_head,
    copy_dataset,
    publish,
    require_validators,
)
from plushsense.dataset.quality import checking
from plushsense.dataset.quality.checking import CheckReport, check
from plushsense.dataset.quality.findings import CheckLimits
from plushsense.dataset.store import Dataset, Progress
from plushsense.evaluation.reidentification import reidentify, report, verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Largest number of findings that a notebook displays.
_MOST_FINDINGS = 50


@dataclass(frozen=True)
class CheckResult(CheckReport):
    """The findings of the checks, with figures, a report and a display for notebooks."""

    def figure(self, gesture: str) -> Figure:
        """Draw all recordings of a gesture in one plot, with conspicuous ones named, and their durations."""
        from plushsense.reports.quality import gesture_figure

        return gesture_figure(self, self.dataset.gestures.get(gesture).label)

    def report(self, path: str | os.PathLike[str], progress: Progress | None = None) -> Path:
        """Write one self-contained HTML page with plots; of existing files only an earlier report is replaced."""
        from plushsense.reports.quality import write_report

        return write_report(Path(path), self, progress=progress)

    def __repr__(self) -> str:
        n = self.counts()["by_severity"]
        return (
            f"CheckResult({self.dataset.head.name!r}: {plural(self.recordings, 'recording')}, "
            f"{plural(n['error'], 'error')}, {plural(n['warning'], 'warning')}, {plural(n['info'], 'note')})"
        )

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{f.severity}</td><td>{html.escape(f.check)}</td><td>{html.escape(f.about or 'data set')}</td>"
            f"<td>{html.escape(f.message)}{' (accepted)' if f.accepted else ''}</td></tr>"
            for f in self.findings[:_MOST_FINDINGS]
        )
        more = f"<p>… and {len(self.findings) - _MOST_FINDINGS} more</p>" if len(self.findings) > _MOST_FINDINGS else ""
        head = "".join(f"<th>{h}</th>" for h in ("severity", "check", "about", "finding"))
        return f"<p>{html.escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>{more}"


def check_dataset(
    dataset: Dataset | str | os.PathLike[str],
    *,
    only: Iterable[str] = (),
    limits: CheckLimits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> CheckResult:
    """Check every recording and stream of a data set.

    Args:
        only: names of checks (`plushsense.dataset.quality.checking.CHECKS`); default: all.
        limits: limits that differ from the defaults, e.g. ``{"duration": 0.5}``.
        progress: called with (files done, total).

    Raises:
        ConfigError: for an unknown check or limit.
        DatasetError: for a folder that is not a data set.
    """
    if not isinstance(limits, CheckLimits):
        limits = CheckLimits().changed(limits or {})
    checked = check(as_dataset(dataset), only=only, limits=limits, progress=progress)
    return CheckResult(**{f.name: getattr(checked, f.name) for f in fields(CheckReport)})


@dataclass(frozen=True)
class DecisionSpec:
    """Decisions about findings and recordings.

    Attributes:
        accept, unaccept: ``CHECK:PATTERN``, e.g. ``gaps:P26/*``; ``CHECK`` alone means the data set as a whole.
        exclude, include: patterns of recordings, e.g. ``P19/*``; to exclude, also ``CHECK:PATTERN``.
        why: the reason, required to accept or exclude.
        who: the person who decides; default: the login name.
    """

    accept: Sequence[str] = ()
    unaccept: Sequence[str] = ()
    exclude: Sequence[str] = ()
    include: Sequence[str] = ()
    why: str = ""
    who: str | None = None

    def __bool__(self) -> bool:
        return bool(self.accept or self.unaccept or self.exclude or self.include)


def decide(
    dataset: Dataset | str | os.PathLike[str],
    spec: DecisionSpec,
    *,
    only: Iterable[str] = (),
    limits: CheckLimits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> tuple[CheckResult, int]:
    """Mark decisions, then check the data set as `check_dataset` does; return the result and the number of new marks.

    Raises:
        ConfigError: without a reason, or for an unknown check.
        DatasetError: for a pattern that matches nothing.
    """
    if (spec.accept or spec.exclude) and not spec.why.strip():
        raise ConfigError('Accepting and excluding need a reason: give it with --why "…".')
    dataset = as_dataset(dataset)
    by = {"who": checking.author_name(spec.who) if spec else "", "why": spec.why}
    # Resolve all patterns before marking anything, so that a wrong one does not leave a partial decision.
    by_check = [*spec.accept, *(entry for entry in spec.exclude if ":" in entry)]
    for entry in by_check:
        checking.parse_acceptance(entry)
    checked = check_dataset(dataset, limits=limits) if by_check else None
    marks = checking.exclusions(dataset, spec.exclude, spec.include, checked.findings if checked else (), **by)
    marks += checking.withdrawals(dataset, spec.unaccept, **by)
    if checked:
        marks += checking.acceptances(checked, spec.accept, **by)
    marked = dataset.append_marks(marks)
    if marked:
        dataset = as_dataset(dataset.path)
    return check_dataset(dataset, only=only, limits=limits, progress=progress), len(marked)


@dataclass(frozen=True)
class PublishSpec:
    """Settings of `publish_dataset`.

    Attributes:
        licence, contact, consent: an SPDX name, "Name <mail>", a statement; required if ``dataset.toml`` lacks them.
        save: also write these into the data set's ``dataset.toml``.
        streams: also publish the streams of whole sessions, with everything between the gestures.
        excluded: also publish excluded recordings, marked as such.
        key: a file outside the data set, created if absent. Packages made with the same key have the same time shifts;
            without a key they are random.
        pseudonyms: give people new random codes, which are stored in the key.
        reidentification: test whether people can be recognised, and report it in the package.
        published: ISO date of the publication (default: today).
    """

    licence: str = ""
    contact: str = ""
    consent: str = ""
    save: bool = False
    streams: bool = True
    excluded: bool = False
    key: str | os.PathLike[str] | None = None
    pseudonyms: bool = False
    reidentification: bool = True
    published: str = ""


def publish_dataset(
    dataset: Dataset | str | os.PathLike[str],
    out: str | os.PathLike[str],
    spec: PublishSpec | None = None,
    progress: StageProgress | None = None,
) -> PublishResult:
    """Write a data set as a package with standard metadata, validate it, and compress it to ``out.zip``.

    Args:
        out: a new or empty folder.
        progress: called with (name of the stage, done, total).

    Raises:
        ConfigError: for pseudonyms without a key.
        DatasetError: without licence, contact or consent statement, or when ``out`` is not empty or its zip exists.
        MissingExtraError: without the validators, or (for the re-identification) scikit-learn.
    """
    spec = spec or PublishSpec()
    dataset = as_dataset(dataset)
    folder = Path(out)
    require_validators()
    head = complete_head(dataset.head, dataset.path, spec.licence, spec.contact, spec.consent)
    check_output_folder(dataset, folder, repeatable=spec.key is not None)
    with _contents_of(dataset, folder, spec) as contents:
        tested = None
        if spec.reidentification:
            steps = (lambda done, total: progress("recognising people", done, total)) if progress else None
            found = reidentify(dataset, progress=steps)
            found = found.under(public_codes(dataset, contents), public_labels(dataset))
            tested = Reidentification(report(found), verdict(found), found.to_dict())
        package = PackageSpec(contents, tested, spec.published)
        done = publish(dataset, folder, head, package, progress)
    if spec.save:
        try:
            change_head(
                dataset.path, lambda now: replace(now, licence=head.licence, consent=head.consent, about=head.about)
            )
        except DatasetError as cause:
            # The package is complete: this is only a warning.
            why = cause.message.values.get("why", str(cause))
            done.warnings.append(
                Message(
                    "licence, contact and consent could not be written into '{path}': {why}", path=dataset.path, why=why
                )
            )
    return done


def share_copy(
    dataset: Dataset | str | os.PathLike[str],
    out: str | os.PathLike[str],
    spec: PublishSpec | None = None,
    progress: StageProgress | None = None,
) -> CopyResult:
    """Write only the data set that `publish_dataset` would put into a package, for people who use PlushSense.

    Of ``spec``, what belongs to metadata and validation has no effect: no licence, contact or consent is needed.

    Raises:
        ConfigError: for pseudonyms without a key.
        DatasetError: when ``out`` is not empty, or a file cannot be written.
    """
    spec = spec or PublishSpec()
    dataset = as_dataset(dataset)
    with _contents_of(dataset, Path(out), spec) as contents:
        return copy_dataset(dataset, Path(out), contents, progress)


@contextmanager
def _contents_of(dataset: Dataset, out: Path, spec: PublishSpec) -> Iterator[ContentsSpec]:
    """Yield what to publish; with pseudonyms, hold the lock of the key, which has a code for each person then."""
    contents = ContentsSpec(spec.streams, spec.excluded, pseudonyms=spec.pseudonyms)
    if spec.key is None:
        if spec.pseudonyms:
            raise ConfigError("Pseudonyms need a key, which stores who has which code: give it with --key FILE.")
        yield contents
        return
    path = Path(spec.key)
    if not spec.pseudonyms:
        yield replace(contents, key=open_key(path, dataset.path, out))
        return
    # Refuse a place in the data set before the lock is made there.
    open_key(path, dataset.path, out)
    with FileLock(path.with_name(f"{path.name}.lock")):
        before = open_key(path, dataset.path, out)
        key = before.with_people(person_codes(dataset))
        if key != before:
            with dataset.generation.writing():
                key.write(path)
        yield replace(contents, key=key)
