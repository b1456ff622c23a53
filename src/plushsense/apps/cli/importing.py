"""``plushsense import SRC DEST --layout NAME``"""

from __future__ import annotations

import argparse

from plushsense.apps.cli.output import bar, emit, say

SHOWN_WARNINGS = 20


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="SRC", help="folder as the recorder left it: a folder a person, or a label")
    parser.add_argument("dest", metavar="DEST", help="the new data set folder")
    parser.add_argument(
        "--layout",
        required=True,
        metavar="NAME",
        help="sensor layout: plush-15, plush-14, accel-3, phone-6, or a TOML file",
    )
    parser.add_argument(
        "--gestures",
        metavar="NAME",
        help="gesture set: plush-18 or a TOML file (default: plush-18 for plush layouts, else from the file names)",
    )
    parser.add_argument(
        "--subjects",
        default="folder",
        metavar="FILE",
        help="who is recorded: folder (default: the folder's name), or a CSV file with the columns file,subject",
    )
    parser.add_argument("--name", help="name of the data set (default: the source folder's)")
    parser.add_argument("--licence", default="", help="licence, as an SPDX name (default: not said)")
    parser.add_argument("--consent", default="", metavar="TEXT", help="consent statement (default: not said)")


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.importers import import_recordings

    done = import_recordings(
        args.source,
        args.dest,
        layout=args.layout,
        gestures=args.gestures,
        subjects=args.subjects,
        name=args.name,
        licence=args.licence,
        consent=args.consent,
        progress=bar("reading"),
    )
    result = done.to_dict()
    if not args.json:
        for line in result["warnings"][:SHOWN_WARNINGS]:
            say(f"warning: {line}")
        if len(result["warnings"]) > SHOWN_WARNINGS:
            say(f"... and {len(result['warnings']) - SHOWN_WARNINGS} more warnings; all are in {args.dest}/*.csv")
        for entry in result["rejected"]:
            say(f"rejected: {entry['file']}: {entry['reason']}")
    emit(
        args,
        result,
        f"{args.dest}: {done.recordings} recordings of {done.subjects} people, {len(done.gestures)} gestures, "
        f"{done.streams} streams; {len(result['warnings'])} warnings, {len(done.rejected)} files rejected; "
        f"{done.seconds:.1f} s",
    )
    return 0
