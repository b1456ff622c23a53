#!/usr/bin/env bash
# mlcroissant: the `lines` of a text file are not its lines: what stands before a comma is lost, empty lines are left out.
#
# Guess:    a field with fileProperty `lines` of a text/plain file gives each line as it is, and one with `lineNumbers` the
#           number of that line.
# Version:  mlcroissant 1.1.1, pandas 3.1.1, Python 3.11.
# Input:    six text files of UTF-8 lines, each with a croissant.json in which mlcroissant finds neither errors nor
#           warnings: notes of an observer, notes with an empty line, a log of accelerations, codes of people, grades, and
#           one that comes out right.
# Seen:     the lines go through a CSV reader that is told of one column. As many columns as the first line has more
#           become an index and are thrown away: "stroked, then held" is " then held", "patted" is None. An empty line is
#           none and all numbers after it are one too low; "01" is "1"; "NA" is None. No error, no warning. (Only a line with
#           more commas than the first is an error.)
# Matters:  notes and logs published as text come out of the data set as other text, and a reader that compares the number
#           of records finds nothing. Only fileProperty `content` gives such a file unharmed.
# Exits with 1 if it behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip --disable-pip-version-check install --quiet mlcroissant==1.1.1 pandas==3.1.1
venv/bin/python - << 'PYTHON'
import hashlib
import json
import sys
from pathlib import Path

import mlcroissant as mlc
from absl import logging

logging.set_verbosity(logging.ERROR)


def field(name, kind):
    source = mlc.Source(file_object="text", extract=mlc.Extract(file_property=name))
    return mlc.Field(id=f"all/{name.name}", name=name.name, description="of the file", data_types=kind, source=source)


def records(text):
    Path("text.txt").write_text(text, "utf-8")
    file = mlc.FileObject(
        id="text",
        name="text",
        content_url="text.txt",
        encoding_formats=["text/plain"],
        sha256=hashlib.sha256(text.encode()).hexdigest(),
    )
    fields = [field(mlc.FileProperty.lineNumbers, mlc.DataType.INTEGER), field(mlc.FileProperty.lines, mlc.DataType.TEXT)]
    metadata = mlc.Metadata(
        name="text",
        description="Lines of text.",
        license=["https://creativecommons.org/publicdomain/zero/1.0/"],
        url="https://example.org/text",
        version="1.0.0",
        cite_as="nobody",
        date_published="2026-01-31",
        creators=[mlc.Person(name="A Person", description="", email="a@example.org")],
        distribution=[file],
        record_sets=[mlc.RecordSet(id="all", name="all", description="all lines", fields=fields)],
    )
    Path("croissant.json").write_text(json.dumps(metadata.to_json(), default=str))
    dataset = mlc.Dataset("croissant.json")
    issues = dataset.metadata.ctx.issues
    assert not issues.errors and not issues.warnings, issues.report()
    found = [(int(record["all/lineNumbers"]), record["all/lines"]) for record in dataset.records("all")]
    return [(number, line.decode() if isinstance(line, bytes) else line) for number, line in found]


expected = {
    "stroked, then held\npatted\n": [(0, " then held"), (1, None)],
    "stroked\n\npatted\n": [(0, "stroked"), (1, "patted")],
    "0.00,0.1,9.8\n0.01,0.2,9.7\n": [(0, "9.8"), (1, "9.7")],
    "01\n02\n": [(0, "1"), (1, "2")],
    "NA\nhigh\n": [(0, None), (1, "high")],
    "stroked\npatted\n": [(0, "stroked"), (1, "patted")],
}
seen = {text: records(text) for text in expected}
for text, found in seen.items():
    print(repr(text), found)
sys.exit(seen != expected and f"not as described: {expected}")
PYTHON
