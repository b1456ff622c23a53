"""The headline figures that `measure.py` measures: what each row runs, on which data, and how long it takes.

A row calls other programs of this folder, or commands of PlushSense, and returns its figures by key: a number, or a
dict with ``value`` and perhaps ``people_sd`` (standard deviation over people), ``ci95`` (95 % interval of the mean over
people) or ``range`` ([lowest, highest]). A row whose figures are from elsewhere also returns ``origin``: what to say of
them in place of this commit and machine.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from measure import Workplace

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = ROOT.parent / "shared" / "data"
PEERS = ROOT / "bench" / "peers.json"
HAR = ROOT / "examples" / "har-phone.toml"
TUNED_ON = {f"P{n:02}" for n in range(1, 15)}  # people of makeability on whom the default network was chosen
CORES = ("xtensa", "cortex-m4", "cortex-m0", "riscv32")
CORE_NAMES = "lx106 / Cortex-M4 / Cortex-M0+ / RV32"
RECALLS = ("0.4", "0.5", "0.6", "0.7")  # at 0.3, not every seed has a setting as strict

NOT_AGAIN = "As documented"  # the note on figures that were not measured again

Figures = Mapping[str, Any]

STRANGERS = "How good is it on people it was not trained on?"
LIVE = "How good is it live?"
TRAINING = "How fast is training?"
CHIPS = "How small and how fast is the C?"
PC = "How fast is it on a computer?"
QUESTIONS = (STRANGERS, LIVE, TRAINING, CHIPS, PC)

# What rows share, made in a folder of its own.
SETS: dict[str, Callable[[Workplace, Path], object]] = {
    "makeability": lambda place, to: place.plushsense(
        "import", RECORDINGS / "makeability-gestures", to, "--layout", "accel-3"
    ),
    "har-phone": lambda place, to: place.plushsense("import", RECORDINGS / "har-phone", to, "--layout", "phone-6"),
    "trimmed": lambda place, to: (
        shutil.copytree(place.made("makeability"), to, ignore=shutil.ignore_patterns("cache", "evaluations")),
        place.plushsense("trim", to, "--accept-above", "0.5", "--who", "bench"),
    ),
    "virtual": lambda place, to: (
        shutil.rmtree(place.folder / "recordings", ignore_errors=True),
        place.plushsense("simulate", place.folder / "recordings", "--people", 6, "--dataset", to),
    ),
    # Weights change the costs by a few instructions, so one epoch is enough.
    "plush.plush": lambda place, to: trained(place, "virtual", to),
    "paper.plush": lambda place, to: trained(place, "virtual", to, "--arch", "14d1_39d2_41d4", "--filters", "8,12,16"),
    "vectors.plush": lambda place, to: trained(place, "makeability", to),
    "plush": lambda place, to: place.plushsense("export", place.made("plush.plush"), to),
    "paper": lambda place, to: place.plushsense("export", place.made("paper.plush"), to),
    "vectors": lambda place, to: place.plushsense("export", place.made("vectors.plush"), to),
}


def git(*words: str) -> str:
    """Return what git prints."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def trained(place: Workplace, dataset: str, to: Path, *options: object) -> None:
    """Train for one epoch."""
    place.plushsense("train", place.made(dataset), "--epochs", 1, *options, "--out", to)


def by_person(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return mean, standard deviation and 95 % interval of a score over the people."""
    return {"value": summary["mean"], "people_sd": summary["sd"], "ci95": summary["ci95"]}


def strangers(place: Workplace, seed: int | None) -> Figures:
    found = place.plushsense("evaluate", place.made("makeability"), "--int8", "--seed", seed)
    kept = [person for person in found["subjects"] if person["subject"] not in TUNED_ON]
    of_kept = {key: [person[key] for person in kept] for key in ("accuracy", "macro_f1")}
    return {
        "accuracy": by_person(found["accuracy"]),
        "macro_f1": by_person(found["macro_f1"]),
        "by_recording": found["by_recording"]["accuracy"],
        **{f"kept_{key}": {"value": fmean(of), "people_sd": stdev(of)} for key, of in of_kept.items()},
        "int8_loss": found["int8"]["loss"]["accuracy"]["mean"],
    }


def phones(place: Workplace, seed: int | None) -> Figures:
    network = ("--arch", "v9_9d2_5d4", "--filters", "6,24,32")
    found = place.plushsense("evaluate", place.made("har-phone"), "--config", HAR, *network, "--seed", seed)
    return {key: by_person(found[key]) for key in ("accuracy", "macro_f1")}


METHODS = ("network", "forest", "extra-trees", "boosting", "rbf-svm")


def classical(place: Workplace, seed: int | None) -> Figures:
    found = place.plushsense(
        "baselines", place.made("makeability"), "--split", "by-subject:5", "--models", ",".join(METHODS),
        "--features", "statistics", "--pca", "no", "--seed", seed,
    )  # fmt: skip
    return {model["name"]: by_person(model["accuracy"]) for model in found["models"]}


def personal(place: Workplace, seed: int | None) -> Figures:
    found = place.plushsense(
        "adapt", "--evaluate", place.made("makeability"), "--split", "by-subject:5", "--seed", seed
    )
    return {
        f"float_{score}_{when}": by_person(found[score][when])
        for score in ("accuracy", "macro_f1")
        for when in ("before", "after")
    }


def choice(of: Mapping[str, Any], name: str) -> Figures:
    """Return the figures of one choice of decision settings."""
    return {
        f"{name}_recall": of["recall"],
        f"{name}_f1": of["f1"],
        f"{name}_false": of["false_events_per_hour"],
        f"{name}_median_s": of["latency_s"]["median"],
        f"{name}_p90_s": of["latency_s"]["p90"],
    }


def streams(place: Workplace, seed: int | None) -> Figures:
    systems = ("--systems", "smoothed,anywhere")
    found = place.plushsense("stream-eval", place.made("trimmed"), "--split", "by-subject:5", *systems, "--seed", seed)
    false = {f"{row['recall']:g}": row["systems"]["anywhere"]["false_events_per_hour"] for row in found["at_recall"]}
    return {
        **{f"false_at_{recall}": false[recall] for recall in RECALLS},
        **choice(found["systems"]["anywhere"]["balanced"], "best"),
        **choice(found["systems"]["anywhere"]["prompt"], "quick"),
    }


def phone_streams(place: Workplace, seed: int | None) -> Figures:
    found = place.plushsense(
        "stream-eval", place.made("har-phone"), "--split", "by-subject:5", "--config", HAR, "--late", "0.5",
        "--arch", "v9_9d2_5d4", "--filters", "6,24,32", "--systems", "hysteresis", "--seed", seed,
    )  # fmt: skip
    return choice(found["systems"]["hysteresis"]["balanced"], "best")


def training(*options: object) -> Callable[[Workplace, int | None], Figures]:
    def measure(place: Workplace, seed: int | None) -> Figures:
        found = place.bench("training.py", *options)
        ratios = [row["plain_s"] / row["ours_s"] for row in found["rows"]]
        return {
            "step": {"value": found["step_ratio"], "range": [min(ratios), max(ratios)]},
            "grid": found["hours"]["plain"] / found["hours"]["ours"],
            "plain_h": found["hours"]["plain"],
            "ours_h": found["hours"]["ours"],
        }

    return measure


def chip(export: str) -> Callable[[Workplace, int | None], Figures]:
    def measure(place: Workplace, seed: int | None) -> Figures:
        found = place.plushsense("profile", place.made(export))
        kinds = {
            "step": "instructions_per_step", "network": "network_instructions_per_step", "flash": "flash_bytes",
            "ram": "ram_bytes",
        }  # fmt: skip
        counts = {f"{name}.{core}": found[key][core] for name, key in kinds.items() for core in CORES}
        return {**counts, "macs": found["macs_per_step"]}

    return measure


def peers(place: Workplace, seed: int | None) -> Figures:
    """Return ratios of `peers.json`, which `peers.py --save` measures with other runtimes installed."""
    commit, date = git("log", "-1", "--format=%h %as", "--abbrev=8", "--", str(PEERS)).split()
    found = json.loads(PEERS.read_text("utf-8"))["default"]["machine"]
    machine, load = f"{found['cpu']}, {found['cores']} cores", round(found["load"][0], 1)
    origin = {"commit": commit, "date": date, "machine": machine, "load": [load, load], "note": NOT_AGAIN}
    return {"origin": origin, **peer_ratios()}


def peer_ratios() -> dict[str, float]:
    """Return how many times as many instructions other runtimes take for our streaming algorithm."""
    found = json.loads(PEERS.read_text("utf-8"))["default"]
    ratios = {}
    for where, key, name in (
        ("chip", "cmsis-nn", "CMSIS-NN int8 -O3"),
        ("rows", "tflm", "TensorFlow Lite Micro, int8, reference kernels"),
        ("rows", "litert", "LiteRT, int8, XNNPACK"),
    ):
        ours = next(r for r in found[where] if r["name"] == "PlushSense C -O2, network only")
        theirs = next(r for r in found[where] if r["name"] == name and r["reads"] == "stream")
        ratios[key] = theirs["instructions"] / ours["instructions"]
    return ratios


def importing(place: Workplace, seed: int | None) -> Figures:
    found = {row["way"]: row for row in place.bench("reading.py")}
    reader, whole = found["read_recording"], found["whole import"]
    least, middle, most = whole["processor_seconds"]
    return {
        "reader": reader["speed_of_loadtxt"],
        "processor_s": {"value": middle, "range": [least, most]},
        "rows_per_s": whole["files"] * 700 / middle,
    }


def streaming(place: Workplace, seed: int | None) -> Figures:
    ours = next(row for row in place.bench("streaming.py") if row["network"] == "default, stream")
    least, middle, most = ours["times_faster"]
    return {"macs": ours["macs_ratio"], "time": {"value": middle, "range": [least, most]}}


def live(place: Workplace, seed: int | None) -> Figures:
    found = place.bench("live.py")
    steps = {f"{engine}_{q}": of["ms"][q] for engine, of in found["bytes_to_event"].items() for q in ("p50", "p99")}
    many = found["many"]
    return {**steps, "toys": many["toys"], "late": many["late"] / many["decisions"], "busy": many["busy"]}


def live_cost(place: Workplace, seed: int | None) -> Figures:
    figures = {}
    for engine, of in place.bench("live.py", "--toys", 0)["bytes_to_event"].items():
        figures |= {f"{engine}_step": of["processor_ms"]["p50"], f"{engine}_frames": 1e6 / of["us_a_frame"]}
    return figures


def studio(place: Workplace, seed: int | None) -> Figures:
    found = place.bench("studio.py", "--model", place.made("plush.plush"), "--minutes", 0)["real_time"]
    return {
        "updates": found["updates_per_s"],
        "drawn": found["drawn_per_s"],
        "core": found["server_core_percent"] / 100,
        "page_p50": found["bytes_to_page_ms"]["p50"],
        "page_p95": found["bytes_to_page_ms"]["p95"],
        "drawn_p95": found["bytes_to_drawn_ms"]["p95"],
    }


@dataclass(frozen=True)
class Line:
    """A line of the table: a title, the keys of its figures, and how each is written (a format specification)."""

    title: str
    keys: tuple[str, ...]
    form: str
    unit: str = ""


def line(title: str, keys: str, form: str, unit: str = "") -> Line:
    return Line(title, tuple(keys.split()), form, unit)


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        data: data, split and settings, in words.
        measure: returns the figures, by key.
        minutes: how long it takes with all seeds on two idle cores, roughly.
        seeds: of folds and trainings; () where nothing is random.
        spread: in words, where the figures have none.
    """

    question: str
    data: str
    measure: Callable[[Workplace, int | None], Figures]
    lines: tuple[Line, ...]
    minutes: float
    seeds: tuple[int, ...] = ()
    spread: str = "–"


def of_chip(name: str, data: str) -> Row:
    lines = (
        line(f"{name}: multiply-accumulates of a step of 50 ms", "macs", ",.0f"),
        line(f"instructions of the network in a step: {CORE_NAMES}", " ".join(f"network.{c}" for c in CORES), ",.0f"),
        line(f"instructions of a whole step: {CORE_NAMES}", " ".join(f"step.{c}" for c in CORES), ",.0f"),
        line(f"flash, code and model: {CORE_NAMES}", " ".join(f"flash.{c}" for c in CORES), ",.0f", "bytes"),
        line(f"RAM of a toy: {CORE_NAMES}", " ".join(f"ram.{c}" for c in CORES), ",.0f", "bytes"),
    )
    export = {"default": "plush", "default, vectors": "vectors", "paper's": "paper"}[name]
    return Row(
        CHIPS, data, chip(export), lines, 2, spread="exact: counted on emulators (QEMU); instructions are not cycles"
    )


ROWS: dict[str, Row] = {
    "strangers": Row(
        STRANGERS,
        "makeability-gestures, 27 people, ten shared gestures, real context; leave-one-subject-out, default network "
        "`v14_17d2_19d4`; P15 to P27 were used for no choice of settings",
        strangers,
        (
            line("accuracy", "accuracy", ".3f"),
            line("macro-F1", "macro_f1", ".3f"),
            line("accuracy, vote by recording", "by_recording", ".3f"),
            line("accuracy of P15 to P27", "kept_accuracy", ".3f"),
            line("macro-F1 of P15 to P27", "kept_macro_f1", ".3f"),
            line("loss of accuracy in 8 bits", "int8_loss", ".4f"),
        ),
        45,
        (0, 1, 2),
    ),
    "strangers-phone": Row(
        STRANGERS,
        "har-phone, 23 people, five activities, windows of 0.5 s, real context; leave-one-subject-out, `v9_9d2_5d4`, "
        "`examples/har-phone.toml`",
        phones,
        (line("accuracy", "accuracy", ".3f"), line("macro-F1", "macro_f1", ".3f")),
        10,
        (0,),
    ),
    "classical": Row(
        STRANGERS,
        "makeability-gestures as above, but by-subject:5; the classical methods read `statistics`, without PCA",
        classical,
        (
            line("accuracy of our default network", "network", ".3f"),
            line("random forest / extra trees", "forest extra-trees", ".3f"),
            line("gradient boosting / RBF SVM", "boosting rbf-svm", ".3f"),
        ),
        5,
        (0,),
    ),
    "personal": Row(
        STRANGERS,
        "makeability-gestures as above, by-subject:5; two recordings of each gesture adapt the network, three test it, "
        "ten pairs a person",
        personal,
        (
            line("accuracy before / after adapting", "float_accuracy_before float_accuracy_after", ".3f"),
            line("macro-F1 before / after", "float_macro_f1_before float_macro_f1_after", ".3f"),
        ),
        8,
        (0,),
    ),
    "streams": Row(
        LIVE,
        "makeability-gestures, trimmed, whole streams of 24 people, 1079 gestures; by-subject:5, default network "
        "trained anywhere, hysteresis, settings chosen on validation people. False events are an upper bound, "
        "as people also practised",
        streams,
        (
            line(
                f"false events per hour at recall {' / '.join(RECALLS)}",
                " ".join(f"false_at_{r}" for r in RECALLS),
                ".0f",
            ),
            line("highest F1: F1 / recall", "best_f1 best_recall", ".2f"),
            line("highest F1: false events per hour", "best_false", ".0f"),
            line("highest F1: latency, median / 90 %", "best_median_s best_p90_s", ".2f", "s"),
            line("quick (F1 on validation people at most 0.05 lower): F1 / recall", "quick_f1 quick_recall", ".2f"),
            line("quick: false events per hour", "quick_false", ".0f"),
            line("quick: latency, median / 90 %", "quick_median_s quick_p90_s", ".2f", "s"),
        ),
        14,
        (0, 1, 2),
    ),
    "streams-phone": Row(
        LIVE,
        "har-phone, whole streams of 23 people, 1735 label runs; by-subject:5, `v9_9d2_5d4`, hysteresis, settings of "
        "the highest F1 on validation people",
        phone_streams,
        (
            line("F1", "best_f1", ".3f"),
            line("recall", "best_recall", ".2f"),
            line("false events per hour", "best_false", ".0f"),
            line("latency, median / 90 %", "best_median_s best_p90_s", ".2f", "s"),
        ),
        10,
        (0,),
    ),
    "training": Row(
        TRAINING,
        "steps on random windows of 11 × 250 of all 52 networks of the paper, batches of 64, 256 and 3936, weighted by "
        "the epochs of its grid of 468 trials; plain PyTorch and ours in turn, two cores; spread over the networks",
        training("--cores", 2),
        (
            line("speed-up of a step", "step", ".2f", "×"),
            line("speed-up of the grid, with nested epochs", "grid", ".1f", "×"),
            line("hours of the grid: plain / ours, by measured steps", "plain_h ours_h", ".0f", "h"),
        ),
        150,
    ),
    "training-small": Row(
        TRAINING,
        "the same, of the 13 networks with 8/12/16/16 filters and batches of 64 alone, one core, processor time",
        training("--filters", 1, "--batches", 64),
        (line("speed-up of a step", "step", ".2f", "×"),),
        2,
    ),
    "chip-default": of_chip(
        "default",
        "`14d1_19d2_19d4` 8/12/16, plush-15, 18 gestures, with limits and a gate (one epoch on 6 virtual people); -O2",
    ),
    "chip-vectors": of_chip(
        "default, vectors",
        "`v14_17d2_19d4` 6/16/16, accel-3, ten gestures, trained for one epoch on makeability-gestures; -O2",
    ),
    "chip-paper": of_chip("paper's", "`14d1_39d2_41d4` 8/12/16 as a streaming network, otherwise as `chip-default`"),
    "peers": Row(
        CHIPS,
        "`14d1_19d2_19d4` 8/12/16, the same streaming algorithm in each runtime, network only; `bench/peers.json`",
        peers,
        (
            line("instructions of CMSIS-NN on the Cortex-M4 ÷ ours", "cmsis-nn", ".2f"),
            line("of TensorFlow Lite Micro on a computer ÷ ours", "tflm", ".2f"),
            line("of LiteRT with XNNPACK on a computer ÷ ours (it is better)", "litert", ".2f"),
        ),
        0,
        spread="callgrind and QEMU: within 2 %",
    ),
    "import": Row(
        PC,
        "1326 generated recordings of 700 rows × 15 columns; ranges over 7 rounds in one run",
        importing,
        (
            line("speed of our reader ÷ that of `np.loadtxt`, processor time", "reader", ".2f"),
            line("the whole import (copies, checksums, checks, index), processor time", "processor_s", ".2f", "s"),
            line("rows imported in a second of processor time", "rows_per_s", ",.0f"),
        ),
        1,
    ),
    "streaming": Row(
        PC,
        "a decision of the default network (`14d1_19d2_19d4`) and of the paper's mirrored window in NumPy, in turn, "
        "one thread; range over 15 rounds",
        streaming,
        (
            line("fewer multiply-accumulates than the paper's window (counted)", "macs", ".0f", "×"),
            line("less processor time than the paper's window", "time", ".1f", "×"),
        ),
        1,
    ),
    "live": Row(
        PC,
        "`14d1_19d2_19d4` with random weights, virtual toys, from the bytes of a frame to the decision, one thread",
        live,
        (
            line("float: wall clock, median / 99 %", "float_p50 float_p99", ".2f", "ms"),
            line("8 bits: wall clock, median / 99 %", "int8_p50 int8_p99", ".2f", "ms"),
            line("toys at 100 Hz in real time, at once", "toys", ".0f"),
            line("their decisions later than a step / share of a core", "late busy", ".1%"),
        ),
        2,
    ),
    "live-cost": Row(
        PC,
        "as `live`, processor time",
        live_cost,
        (
            line("processor time of a step, median: float / 8 bits", "float_step int8_step", ".2f", "ms"),
            line("frames read in a second of processor time: float / 8 bits", "float_frames int8_frames", ",.0f"),
        ),
        1,
    ),
    "studio": Row(
        PC,
        "live page of the studio in Chromium, a virtual toy over TCP, 13 channels, 30 s",
        studio,
        (
            line("updates / drawn frames a second", "updates drawn", ".0f"),
            line("processor time of the server", "core", ".1%", "of a core"),
            line("from the bytes to the page, median / 95 %", "page_p50 page_p95", ".1f", "ms"),
            line("from the bytes to the drawn update, 95 %", "drawn_p95", ".0f", "ms"),
        ),
        1,
    ),
}
