"""``plushsense import SRC DEST [--layout NAME] [--add]``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say
from plushsense.cli.settings import options
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

_MOST_WARNINGS = 20
_SOURCES = """
SRC is one of
  folders of sessions    OUT/<subject>/<session>/session.json, as plushsense record writes them
  a folder per person    P01/<label>_<epoch ms>_<rows>.csv and fulldatastream.csv, as the authors' recorder writes them
  a folder per label     as the authors' anonymising step writes them; --subjects map.csv names the person of each file
  CSVs with labels       s01/anything.csv with a label on every row (layout phone-6)
  FILE.zip               of any of these folders
  FILE.xdf               of LabRecorder: markers that name gestures begin recordings (extra lsl); also inside folders
  FILE.csv, .parquet     one table, one sample a row: subject, [session], [recording], label, time and the channels

Each file is imported unchanged, left out or rejected with a reason. More in docs/importing.md.
"""


def add(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _SOURCES
    add = parser.add_argument
    add("source", metavar="SRC", help="folder or .zip, .xdf, .parquet or .csv file of recordings")
    add("dest", metavar="DEST", help="new data set folder; with --add an existing one")
    add(
        "--layout",
        metavar="NAME",
        help="sensor layout: plush-15, plush-14, accel-3, phone-6, or a TOML file; our sessions contain theirs",
    )
    add(
        "--gestures",
        metavar="NAME",
        help="gesture set: plush-18 or a TOML file (default: plush-18 for plush layouts, else from the labels)",
    )
    add(
        "--subjects",
        default="folder",
        metavar="FILE",
        help="person of each file: folder (default: the folder's name), or a CSV file with the columns file,subject",
    )
    add("--people", metavar="FILE", help="age group, gender and consent: a CSV file with the column subject")
    add("--add", action="store_true", help="add new recordings to the data set DEST; existing ones are not changed")
    add(
        "--column",
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="column of a table: subject, session, recording, label, time or a channel; stream=NAME in an XDF file",
    )
    add("--max-gb", type=float, metavar="GB", help="largest unpacked size of a zip file (default: 8)")
    add("--name", help="name of the data set (default: the source's)")
    add("--licence", default="", help="licence, as an SPDX name (default: none)")
    add("--consent", default="", metavar="TEXT", help="consent statement (default: none)")


def _columns(texts: list[str]) -> dict[str, str]:
    columns = dict(text.partition("=")[::2] for text in texts)
    for text in texts:
        if not all(text.partition("=")):
            raise ConfigError(f"--column {text}: write ROLE=NAME, for example  --column label=activity")
    return columns


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.importing.archives import UnpackLimits
    from plushsense.dataset.importing.importers import import_recordings

    done = import_recordings(
        args.source,
        args.dest,
        **options(args, "layout", "gestures", "subjects", "name", "licence", "consent", "people"),
        progress=ProgressReporter("reading"),
        add_to=args.add,
        columns=_columns(args.column),
        limits=None if args.max_gb is None else UnpackLimits(total_bytes=_whole_bytes(args.max_gb)),
    )
    result = done.to_dict()
    if not args.json:
        for line in result["warnings"][:_MOST_WARNINGS]:
            say(f"warning: {line}")
        if len(result["warnings"]) > _MOST_WARNINGS:
            say(f"... and {len(result['warnings']) - _MOST_WARNINGS} more warnings; all are in {args.dest}/*.csv")
        for what, entries in (("left out", done.left_out), ("rejected", done.rejected)):
            for entry in entries:
                say(f"{what}: {entry['file']}: {entry['reason']}")
    new = f", {done.added['recordings']} of them new, {done.already_there} files already there" if args.add else ""
    emit(
        args,
        result,
        f"{args.dest}: {done.recordings} recordings of {done.subjects} people{new}, {len(done.gestures)} gestures, "
        f"{done.streams} streams; {len(result['warnings'])} warnings, {len(done.rejected)} files rejected; "
        f"{done.seconds:.1f} s",
    )
    return 0


def _whole_bytes(gigabytes: float) -> int:
    if not 0 < gigabytes < 1e6:
        raise ConfigError(f"--max-gb is {gigabytes:g}: give a number above 0.")
    return int(gigabytes * 1e9)
