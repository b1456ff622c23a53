"""A data set full of what must not leave: dates, names, notes, addresses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_header, format_rows, recording_filename
from plushsense.dataset.about import About, Contact, Creator
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.publishing.contents import ContentsSpec
from plushsense.dataset.publishing.keys import PublicationKey
from plushsense.dataset.publishing.package import PackageSpec, PublishResult, complete_head, publish
from plushsense.dataset.store import Dataset, DatasetHead, PersonInfo, write_people

ACCEL = load_layout("accel-3")
# 14 November 2023, 22:13:20 UTC.
BEGAN_MS = 1_700_000_000_000
DAY_MS = 86_400_000
KEY = PublicationKey(b"a key for tests, 32 bytes long..")
SECRETS = ("hthompson", "Anna", "CONSENT-77", "Oakfield", "2023-11", "AA:BB:CC", "school", "too loud")
GESTURES = GestureSet(
    "test", (Gesture("Ear_tug", "positive"), Gesture("Pat", "neutral"), Gesture("Lie", nobody=True), Gesture("Odd"))
)


def record(folder: Path, seed: int, labels: tuple[str, ...], began_ms: int) -> None:
    """One session: the stream, and recordings cut from it; with sidecars as a recorder leaves them."""
    rng = np.random.default_rng(seed)
    clock = np.cumsum(rng.integers(9, 12, 600)).astype(np.int64) + 5000 * seed
    stream = Frames(rng.integers(-7000, 7000, (600, 3)), clock, clock + began_ms)
    streams = Path(str(folder).replace("/recordings/", "/streams/").replace("\\recordings\\", "\\streams\\"))
    for place in (folder, streams):
        place.mkdir(parents=True, exist_ok=True)
    (streams / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    for number, label in enumerate(labels):
        part = stream.slice(40 + 90 * number, 100 + 90 * number)
        assert part.host_ms is not None
        name = recording_filename(label, int(part.host_ms[-1]) + 25, len(part))
        text = format_header(ACCEL) + format_rows(part, ACCEL)
        if number == 1:
            text += "Anna said it was too loud\n"
        (folder / name).write_text(text)
        (folder / name.replace(".csv", ".json")).write_text('{"device": "AA:BB:CC", "note": "Anna"}')


def make(folder: Path, *, simulated: bool = False) -> Dataset:
    """Two people in two sessions each whose names are dates, nobody once."""
    labels = ("Ear_tug", "Pat", "Ear_tug", "Pat", "Ear_tug")
    for person in range(2):
        for session in range(2):
            day = f"2023-11-{14 + session * 3 + person}"
            began = BEGAN_MS + (session * 3 + person) * DAY_MS
            record(folder / "recordings" / f"P{person + 1}" / day, 10 * person + session, labels, began)
    record(folder / "recordings" / "none" / "2023-11-20", 50, ("Lie", "Lie"), BEGAN_MS + 6 * DAY_MS)
    (folder / "notes.txt").write_text("Anna, hthompson")
    head = DatasetHead(
        "Test toys",
        ACCEL,
        GESTURES,
        source="/home/hthompson/Anna",
        licence="cc-by-4.0",
        consent="The parents agreed to publication.",
        simulated=simulated,
        about=About(
            title="Touch of two people",
            description="A set for tests.",
            keywords=("touch", "toy"),
            creators=(Creator("Curie, Marie", "0000-0002-1825-0097", "University of Paris"), Creator("A Lab")),
            contact=Contact("Data Desk", "data@example.org"),
            doi="10.5281/zenodo.1234",
            paper="10.1000/paper",
        ),
    )
    (folder / "dataset.toml").write_text(head.to_toml(), encoding="utf-8")
    write_people(
        folder,
        [
            PersonInfo("P1", "child", "f", "CONSENT-77", {"school": "Oakfield", "hand": "left"}),
            PersonInfo("P2", "adult", "m", "CONSENT-77", {"school": "Oakfield", "hand": "right"}),
        ],
    )
    dataset = open_dataset(folder)
    first, second, third = (r.id for r in dataset.recordings[:3])
    append_marks(
        folder,
        [
            Mark(first, "trim", "hthompson", "Anna moved", start=5, stop=50),
            Mark(second, "exclude", "hthompson", "too loud"),
            Mark(third, "accept", "hthompson", "Anna", check="rate"),
        ],
    )
    return open_dataset(folder)


def made_of(dataset: Dataset, out: Path, contents: ContentsSpec | None = None) -> PublishResult:
    head = complete_head(dataset.head, dataset.path)
    return publish(dataset, out, head, PackageSpec(contents or ContentsSpec(key=KEY), published="2026-01-31"))
