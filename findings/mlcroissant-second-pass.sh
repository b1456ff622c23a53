#!/usr/bin/env bash
# mlcroissant: a record set whose field has `references` gives its records once; a second pass gives none, without an error.
#
# Guess:    Dataset.records(NAME) gives the same records each time it is called and iterated, as it does for the
#           record set `people` here, which differs only in that no field of it has `references`.
# Version:  mlcroissant 1.1.1, pandas 3.1.1, Python 3.11.
# Input:    two CSV files, and a croissant.json in which trials/person references people/person. mlcroissant finds
#           neither errors nor warnings in it.
# Seen:     people 2 2, trials 3 0; no record either after a first pass that was left after its first record. The graph
#           of operations with a join is not streamed, and each operation keeps what it returned; that of ReadFields is a
#           generator, which the first pass uses up.
# Matters:  a second epoch, or a count before the work, silently sees an empty data set. Only a new mlcroissant.Dataset
#           has the records again.
# Exits with 1 if it behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip --disable-pip-version-check install --quiet mlcroissant==1.1.1 pandas==3.1.1
printf 'person,age\nA,7\nB,9\n' > people.csv
printf 'trial,person\n1,A\n2,B\n3,A\n' > trials.csv
venv/bin/python - << 'PYTHON'
import hashlib
import json
import sys

import mlcroissant as mlc
from absl import logging

logging.set_verbosity(logging.ERROR)


def file(name):
    sha256 = hashlib.sha256(open(name, "rb").read()).hexdigest()
    return mlc.FileObject(id=name, name=name, content_url=name, encoding_formats=["text/csv"], sha256=sha256)


def field(table, name, kind, **more):
    source = mlc.Source(file_object=f"{table}.csv", extract=mlc.Extract(column=name))
    return mlc.Field(id=f"{table}/{name}", name=name, description=name, data_types=kind, source=source, **more)


number, text = mlc.DataType.INTEGER, mlc.DataType.TEXT
person = field("trials", "person", text, references=mlc.Source(field="people/person"))
metadata = mlc.Metadata(
    name="two-tables",
    description="People and their trials.",
    license=["https://creativecommons.org/publicdomain/zero/1.0/"],
    url="https://example.org/two-tables",
    version="1.0.0",
    cite_as="nobody",
    date_published="2026-01-31",
    creators=[mlc.Person(name="A Person", description="", email="a@example.org")],
    distribution=[file("people.csv"), file("trials.csv")],
    record_sets=[
        mlc.RecordSet(
            id="people",
            name="people",
            description="people",
            key="people/person",
            fields=[field("people", "person", text), field("people", "age", number)],
        ),
        mlc.RecordSet(
            id="trials", name="trials", description="trials", fields=[field("trials", "trial", number), person]
        ),
    ],
)
with open("croissant.json", "w") as out:
    json.dump(metadata.to_json(), out, default=str)
dataset = mlc.Dataset("croissant.json")
issues = dataset.metadata.ctx.issues
assert not issues.errors and not issues.warnings, issues.report()
seen = {name: [len(list(dataset.records(name))) for _ in range(2)] for name in ("people", "trials")}
records = mlc.Dataset("croissant.json").records("trials")
next(iter(records))
seen["after one"] = [record["trials/trial"] for record in records]
print(seen)
expected = {"people": [2, 2], "trials": [3, 0], "after one": []}
sys.exit(seen != expected and f"not as described: {expected}")
PYTHON
