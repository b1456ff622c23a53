"""``plushsense import SRC DEST [--layout NAME] [--add]``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

SHOWN_WARNINGS = 20
SHAPES = """
SRC is one of
  a folder of sessions   OUT/<subject>/<session>/session.json, as plushsense record leaves them
  a folder a person      P01/<label>_<epoch ms>_<rows>.csv and fulldatastream.csv, as the authors' recorder leaves them
  a folder a label       as the authors' anonymising step leaves them; --subjects map.csv says whose the files are
  CSVs with labels       s01/anything.csv with a label on every row (layout phone-6)
  FILE.zip               of any of these folders
  FILE.xdf               of LabRecorder: markers that name gestures begin recordings (extra lsl); also inside folders
  FILE.csv, .parquet     one table, a row a sample: subject, [session], [recording], label, time and the channels

Each file is imported unchanged, left out or rejected with a reason. More in docs/importing.md.
"""


def add(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = SHAPES
    parser.add_argument("source", metavar="SRC", help="what was recorded: a folder, or a .zip, .xdf, .parquet or .csv")
    parser.add_argument("dest", metavar="DEST", help="the new data set folder; with --add one that is there")
    parser.add_argument(
        "--layout",
        metavar="NAME",
        help="sensor layout: plush-15, plush-14, accel-3, phone-6, or a TOML file; sessions say theirs themselves",
    )
    parser.add_argument(
        "--gestures",
        metavar="NAME",
        help="gesture set: plush-18 or a TOML file (default: plush-18 for plush layouts, else from the labels)",
    )
    parser.add_argument(
        "--subjects",
        default="folder",
        metavar="FILE",
        help="who is recorded: folder (default: the folder's name), or a CSV file with the columns file,subject",
    )
    parser.add_argument(
        "--people", metavar="FILE", help="age group, gender and consent: a CSV file with the column subject"
    )
    parser.add_argument(
        "--add", action="store_true", help="add what is new to the data set DEST; what is there stays as it is"
    )
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="a table's column: subject, session, recording, label, time or a channel; stream=NAME of an XDF file",
    )
    parser.add_argument("--max-gb", type=float, metavar="GB", help="how much a zip may unpack to, in GB (default: 8)")
    parser.add_argument("--name", help="name of the data set (default: the source's)")
    parser.add_argument("--licence", default="", help="licence, as an SPDX name (default: not said)")
    parser.add_argument("--consent", default="", metavar="TEXT", help="consent statement (default: not said)")


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
        layout=args.layout,
        gestures=args.gestures,
        subjects=args.subjects,
        name=args.name,
        licence=args.licence,
        consent=args.consent,
        progress=ProgressReporter("reading"),
        add_to=args.add,
        people=args.people,
        columns=_columns(args.column),
        limits=None if args.max_gb is None else UnpackLimits(total_bytes=_whole_bytes(args.max_gb)),
    )
    result = done.to_dict()
    if not args.json:
        for line in result["warnings"][:SHOWN_WARNINGS]:
            say(f"warning: {line}")
        if len(result["warnings"]) > SHOWN_WARNINGS:
            say(f"... and {len(result['warnings']) - SHOWN_WARNINGS} more warnings; all are in {args.dest}/*.csv")
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
        raise ConfigError(f"--max-gb is {gigabytes:g}; it must be above 0.")
    return int(gigabytes * 1e9)
