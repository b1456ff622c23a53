"""Run a day of toy time through the recorder, the live classification and the emitted C, and watch their memory.

    python bench/soak.py [--hours 24] [--parts record,live,chip,studio] [--model BUNDLE] [--work DIR] [--json]

A virtual toy (100 Hz, no lost lines) is played as fast as it is read. Each part is a process of its own:

- ``frames`` writes the toy's frames to a file, which the other parts are compared with.
- ``record`` records them as one session with automatic recordings of five seconds, and reads the session's stream
  again: every frame must be in it, once and in order, and every recording must be a part of it.
- ``live`` classifies them with the float network. Its decisions of the last quarter of an hour, and one of every minute
  before, are compared with the network's answers to whole windows of the resampled stream.
- ``chip`` computes the deployed model twice: in Python (``runtime``), for the first `--python-hours`, and with the
  emitted C, compiled by ``gcc`` for this machine, for all. All rows (answers, events, sensor health) must be equal. The
  clock begins so that it passes 2^32 ms, as that of a toy that runs for 49.7 days, in the middle of what is compared.
- ``studio`` plays a toy to the page Live in real time for `--studio-hours`, see `studio.py`; Chromium is required.

The resident memory is sampled every ten minutes of toy time; its slope is that of a straight line from the second hour
on (from the first third on, in shorter runs). Without `--model` a small network is trained on four virtual people. The
data are a simulation: only the equality and the memory matter here, not the scores. Linux (/proc) is required.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames
from plushsense.deploy.golden import ToyRows
from plushsense.deploy.quantize import integer_model
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.models.bundle import Bundle
from plushsense.recording.plan import save_protocol
from plushsense.recording.recorder import AutoRecording, Recorder
from plushsense.recording.session import SessionRequest, session_head
from plushsense.runtime.classifier import StreamClassifier
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ONE
from plushsense.runtime.fixed import integer_logits, softmax
from plushsense.windows.clock import resample
from plushsense.windows.features import network_inputs

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from studio import measure, resident_bytes
from support.c_toy import C_FOLDER, TOY_C, library_of, seat

TOY = "virtual://?person=31&seed=1&speed=0&lost=0&garbled=0"
RATE_HZ = 100
EVERY_S = 600.0
BLOCK = 6000
WRAP = 1 << 32
SHORTEST_H = 0.02
AT_END_US = 900_000_000
LONG_H, MOST_KB = 8.0, 1000.0


class MemoryLog:
    """Resident memory of this process by toy time, sampled at most once in ``every_s`` seconds of toy time."""

    def __init__(self, hours: float) -> None:
        self._every_s = min(EVERY_S, hours * 3600.0 / 40)
        self._next_s = 0.0
        self.points: list[tuple[float, float]] = []

    def at(self, toy_s: float) -> None:
        """Sample, if it is due at this toy time."""
        if toy_s >= self._next_s:
            self.points.append((toy_s, float(resident_bytes(os.getpid()))))
            self._next_s = toy_s + self._every_s

    def summary(self) -> dict[str, float]:
        """Return the memory after the beginning, at the end and at most, in MB, and the slope in kB an hour."""
        end_s = self.points[-1][0]
        late = np.array([p for p in self.points if p[0] >= min(3600.0, end_s / 3)])
        slope = float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 2 else 0.0
        return {
            "early_mb": round(late[0, 1] / 1e6, 1),
            "last_mb": round(late[-1, 1] / 1e6, 1),
            "most_mb": round(max(b for _, b in self.points) / 1e6, 1),
            "kb_an_hour": round(slope * 3600.0 / 1e3, 1),
        }


def toy_url(hours: float) -> str:
    """Return the URL of the toy that plays for so long."""
    return f"{TOY}&seconds={hours * 3600:g}"


def write_frames(work: Path, hours: float) -> dict[str, Any]:
    """Write the frames of the toy as rows (device time, values) of 32-bit integers."""
    count = 0
    with open_device(toy_url(hours)) as toy, (work / "frames.bin").open("wb") as file:
        while (frames := toy.read()) is not None:
            file.write(np.array([(f.device_ms, *f.values) for f in frames], dtype="<i4").tobytes())
            count += len(frames)
    return {"frames": count, "lost": toy.counters.lost}


def read_frames(work: Path) -> NDArray[np.int32]:
    """Return the frames (T, 1 + C) of `write_frames`, mapped from the file."""
    channels = load_layout("plush-15").n_channels
    return np.memmap(work / "frames.bin", dtype="<i4", mode="r").reshape(-1, 1 + channels)


def record(work: Path, hours: float, model: Path) -> dict[str, Any]:
    """Record the toy as one session; compare its stream with the frames, and its recordings with the stream."""
    layout, folder, memory = load_layout("plush-15"), work / "recorded" / "S01" / "1", MemoryLog(hours)
    gestures = ("Back stroke 1", "Hold strong", "Tail hit 1")
    save_protocol(work / "day.toml", gestures, 1000, "round")
    with open_device(toy_url(hours)) as toy:
        request = SessionRequest(toy.url, subject="S01", protocol=str(work / "day.toml"), speed=0.0)
        head = session_head(request, folder, True, layout, "soak")
        with Recorder.open(folder, toy, head, speed=0.0, auto=AutoRecording(5.0, 20.0)) as recorder:
            ended = False
            while not ended:  # sampled at least once: a short day may end within the first wait
                ended = recorder.wait(timeout_s=0.2)
                memory.at(recorder.toy_s)
            status = recorder.status()
    return {
        "rows": status.rows,
        "lost": status.lost,
        "malformed": status.malformed,
        "gaps": status.gaps,
        "recordings": status.done,
        "rows_that_differ": differing_rows(folder, read_frames(work)),
        "recordings_that_differ": differing_recordings(folder),
        "memory": memory.summary(),
    }


def differing_rows(folder: Path, frames: NDArray[np.int32]) -> int:
    """Return the number of rows of a recorded stream that are not those of the toy, or that are missing or doubled."""
    columns = load_layout("plush-15").csv.columns
    order = [columns.index(name) for name in ("device_ms", *load_layout("plush-15").names)]
    differ = at = 0
    with (folder / STREAM_NAME).open("rb") as file:
        while lines := file.readlines(1 << 22):
            table = np.array([line.replace(b";", b" ").split() for line in lines], dtype="S").astype(np.int64)[:, order]
            wanted = frames[at : at + len(table)]
            differ += int((table[: len(wanted)] != wanted).any(axis=1).sum()) + len(table) - len(wanted)
            at += len(table)
    return differ + max(0, len(frames) - at)


def differing_recordings(folder: Path) -> int:
    """Return how many recordings are not the rows of the stream that their sidecars name."""
    takes = []
    for path in folder.glob("* *_*.json"):
        beside = json.loads(path.read_text())
        takes.append((beside["stream_row"], path.with_suffix(".csv").read_bytes().splitlines()[1:]))
    takes.sort(key=lambda take: take[0])
    differ, at = 0, 0
    with (folder / STREAM_NAME).open("rb") as stream:
        for first, lines in takes:
            for _ in range(first - at):
                stream.readline()
            differ += [stream.readline().rstrip() for _ in lines] != [line.rstrip() for line in lines]
            at = first + len(lines)
    return differ


def live(work: Path, hours: float, model: Path) -> dict[str, Any]:
    """Classify the toy live, without smoothing; write the probabilities of every step."""
    bundle, memory, events = Bundle.load(model), MemoryLog(hours), 0
    decide = DecideSpec.from_dict({**bundle.decision, "smoothing_s": 0.0})
    with open_device(toy_url(hours)) as toy, (work / "decisions.bin").open("wb") as file:
        run = run_live(toy, StreamClassifier(bundle, decide))
        for decision in run:
            memory.at(decision.t_s)
            if decision.probabilities is not None:
                row = np.array([decision.t_s * 1000.0, *(p * ONE for p in decision.probabilities)])
                file.write(np.rint(row).astype("<i4").tobytes())
            events += len(decision.events)
        summary = run.summary()
    names = ("decisions", "warming", "invalid", "faults")
    return {
        "frames": summary.counters["frames"],
        "lost": summary.counters["lost"],
        "gaps": summary.restarts,
        **{name: getattr(summary, name) for name in names},
        "changes_of_events": events,
        "memory": memory.summary(),
    }


def compare_with_batch(work: Path, hours: float, model: Path) -> dict[str, Any]:
    """Compare the decisions of `live` with the network's answers to whole windows: the end, and each minute."""
    bundle, table = Bundle.load(model), read_frames(work)
    arch, network, layout = bundle.arch, bundle.network(), bundle.layout
    found = np.memmap(work / "decisions.bin", dtype="<i4", mode="r").reshape(-1, 1 + arch.classes)
    times = table[:, 0].astype(np.int64)
    compared = differ = 0
    for segment in resample(Frames(table[:, 1:].astype(np.int64), times, times), layout):
        inputs = network_inputs(segment.data, layout)
        n = np.arange(arch.span, len(inputs) + 1, arch.step)
        at_us = segment.start_us + (n - 1) * segment.period_us
        at_end = at_us > int(times[-1]) * 1000 - AT_END_US
        chosen = n[at_end | (np.arange(len(n)) % (60 * RATE_HZ // arch.step) == 0)]
        rows = np.searchsorted(found[:, 0], (segment.start_us + (chosen - 1) * segment.period_us) // 1000 - times[0])
        for at in range(0, len(chosen), 256):
            ends = chosen[at : at + 256]
            windows = np.stack([inputs[end - arch.span : end].T for end in ends])
            logits = integer_logits(network.forward(bundle.scaler.apply(windows)))
            wanted = np.array([softmax(row) for row in logits])
            differ += int((found[rows[at : at + 256], 1:] != wanted).any(axis=1).sum())
            compared += len(ends)
    return {"compared": compared, "differ": differ}


def chip(work: Path, hours: float, model: Path, python_hours: float = float("inf")) -> dict[str, Any]:
    """Compute the deployed model in Python and with the emitted C on the same frames, and compare all rows."""
    deployed, memory, table = integer_model(Bundle.load(model)), MemoryLog(hours), read_frames(work)
    subprocess.run(
        ["gcc", "-std=c99", "-O2", "-shared", "-fPIC", f"-I{C_FOLDER}", str(TOY_C), "-o", str(work / "toy.so")],
        check=True,
    )
    toy = seat(library_of(work / "toy.so"), deployed)
    path, (count, columns) = work / "frames.bin", table.shape
    compared = round(min(count, python_hours * 3600.0 * RATE_HZ))
    shift = WRAP - int(table[compared // 2, 0])
    del table
    python_s = c_s = 0.0
    rows = rows_compared = differ = restarts = 0

    def blocks(stop: int) -> Iterator[NDArray[np.int64]]:
        for at in range(0, stop, BLOCK):
            # Read, not mapped: pages of a mapped file would count as memory.
            part = np.fromfile(path, "<i4", (min(stop, at + BLOCK) - at) * columns, offset=4 * at * columns)
            part = part.reshape(-1, columns).astype(np.int64)
            part[:, 0] = (part[:, 0] + shift) % WRAP
            yield part

    python = ToyRows(deployed)
    wanted = map(python.read, blocks(compared // BLOCK * BLOCK))
    for number, frames in enumerate(blocks(count)):
        began = time.process_time()
        expected = next(wanted, None)
        between = time.process_time()
        answered = toy.push(frames)
        python_s, c_s = python_s + between - began, c_s + time.process_time() - between
        rows += len(answered)
        restarts = int(answered[-1, 10])
        memory.at(number * BLOCK / RATE_HZ)
        if expected is None:
            continue
        rows_compared += len(expected)
        same = expected.shape == answered.shape
        differ += int((expected != answered).any(axis=1).sum()) if same else max(len(expected), len(answered))
    return {
        "frames": count,
        "frames_compared": compared // BLOCK * BLOCK,
        "rows": rows,
        "rows_compared": rows_compared,
        "rows_that_differ": differ,
        "restarts": restarts,
        "python_s": round(python_s, 1),
        "c_s": round(c_s, 2),
        "memory": memory.summary(),
    }


def studio(work: Path, hours: float, model: Path) -> dict[str, Any]:
    """Show a toy in the studio for so many hours of real time; measure the memory of server and page."""
    return measure(model, 1.0, hours * 3600.0, "memory")


PARTS: dict[str, Callable[..., dict[str, Any]]] = {
    "record": record,
    "live": live,
    "batch": compare_with_batch,
    "chip": chip,
    "studio": studio,
    "frames": lambda work, hours, model: write_frames(work, hours),
}


def small_model(work: Path) -> Path:
    """Train a small network on four virtual people."""
    import plushsense as ps
    from plushsense.workflow.api import simulate

    simulate(work / "made", people=4, repetitions=1, dataset=work / "set")
    return Path(ps.train(work / "set", preset="people", epochs=10).save(work / "soak.plush"))


def faults_of(found: dict[str, Any]) -> list[str]:
    """Return what is not as promised in the results of the parts, or was not compared at all; empty if all is well."""
    frames, wrong = found["frames"]["frames"], []
    for part, compared in (("record", "recordings"), ("live", "decisions"), ("chip", "rows_compared")):
        if part not in found:
            continue
        result = found[part]
        wrong += [f"{part}: {compared} is 0, so that nothing is compared"] if not result[compared] else []
        count = result["rows" if part == "record" else "frames"]
        wrong += [f"{part}: {count} of {frames} frames"] if count != frames else []
        wrong += [f"{part}: {key} is {n}" for key, n in result.items() if key in _ZERO and n]
        slope = result["memory"]["kb_an_hour"]
        wrong += [f"{part}: memory grows by {slope} kB an hour"] if found["hours"] >= LONG_H and slope > MOST_KB else []
    if "batch" in found and (found["batch"]["differ"] or not found["batch"]["compared"]):
        wrong.append(f"stream and batch differ in {found['batch']['differ']} of {found['batch']['compared']} decisions")
    return wrong


_ZERO = ("lost", "malformed", "gaps", "faults", "rows_that_differ", "recordings_that_differ")


def run_part(part: str, work: Path, hours: float, model: Path, python_hours: float) -> dict[str, Any]:
    """Run a part in a process of its own; return its result with the seconds that it took."""
    words = ["--part", part, "--work", str(work), "--hours", str(hours), "--model", str(model)]
    words += ["--python-hours", str(python_hours)]
    began = time.perf_counter()
    done = subprocess.run([sys.executable, __file__, *words], stdout=subprocess.PIPE, check=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found | {"wall_s": round(time.perf_counter() - began, 1), "load_average": round(os.getloadavg()[0], 2)}


def main() -> int:
    parser = argparse.ArgumentParser(description="A day of toy time through recorder, live classification and C.")
    parser.add_argument("--hours", type=float, default=24.0, help="toy time in hours (24)")
    parser.add_argument("--python-hours", type=float, default=24.0, help="of which Python computes the chip's (24)")
    parser.add_argument("--studio-hours", type=float, default=1.0, help="real time of the studio in hours (1)")
    parser.add_argument("--parts", default="record,live,chip,studio", help="what to run (record,live,chip,studio)")
    parser.add_argument("--model", type=Path, metavar="BUNDLE", help="bundle to run (default: a small one is trained)")
    parser.add_argument("--work", type=Path, metavar="DIR", help="folder for its files, about 1.7 GB for a day")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help="one JSON object, nothing else")
    args = parser.parse_args()
    if unknown := set(args.parts.split(",")) - {"record", "live", "chip", "studio"}:
        parser.error(f"there is no part {', '.join(sorted(unknown))}; accepted are record, live, chip and studio")
    if args.hours < SHORTEST_H:
        parser.error(f"--hours is {args.hours:g}; at least {SHORTEST_H:g} is accepted")
    if args.part:
        more = [args.python_hours] if args.part == "chip" else []
        print(json.dumps(PARTS[args.part](args.work, args.hours, args.model, *more)))
        return 0
    work = Path(tempfile.mkdtemp(prefix="soak-", dir=args.work))
    try:
        model = args.model or small_model(work)
        found: dict[str, Any] = {"hours": args.hours, "cores": os.cpu_count()}
        for part in ("frames", *args.parts.split(",")):
            for name in ("live", "batch") if part == "live" else (part,):
                hours = args.studio_hours if name == "studio" else args.hours
                found[name] = run_part(name, work, hours, model, args.python_hours)
                if not args.json:
                    print(f"{name}: {json.dumps(found[name])}", flush=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    wrong = faults_of(found)
    if args.json:
        print(json.dumps(found | {"wrong": wrong}))
    else:
        print("\n".join(wrong) or "all as promised")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
