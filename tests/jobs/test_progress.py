"""Progress: what it displays at every width, how it estimates the time left, and that no terminal can stop a run."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from plushsense.jobs.journal import Job
from plushsense.jobs.progress import (
    BestScore,
    JobInfo,
    JobsReporter,
    JobsState,
    JobStep,
    ProgressReporter,
    ProgressStatus,
    close_active,
    duration,
)

JOBS = {f"j{n}": JobInfo(f"{name} {filters}", cost) for n, (name, filters, cost) in enumerate([
    ("14d1_39d2_41d4", "8/12/16", 10.0),
    ("19d1_19d2_19d4_17d8", "32/48/64/64", 100.0),
    ("250", "8", 1.0),
    ("70_90_91", "8/12/16", 89.0),
])}  # fmt: skip


def example() -> JobsState:
    s = JobsState(JOBS, began=1000.0)
    s.finish("j2", BestScore(0.412, "250 8"), resumed=True)
    s.start("j0", 1000.0)
    s.start("j1", 1000.0)
    s.finish("j0", BestScore(0.587, "14d1_39d2_41d4 8/12/16, 250 epochs"))
    s.start("j3", 1060.0)
    s.step("j1", JobStep(20, 100, 1.25), 1060.0)
    return s


def lines(status: ProgressStatus, width: int, height: int = 1000) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=width, color_system=None).print(status.render(height))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_the_time_left_comes_from_costs_of_this_run_alone() -> None:
    s = JobsState(JOBS, began=0.0)
    s.finish("j3", resumed=True)
    s.start("j0", 0.0)
    # 89 of 200 were there before: no measure of this run's speed.
    assert s.left_s(50.0) is None and s.share == pytest.approx(89 / 200)
    s.finish("j0")
    # 10 in 50 s, 101 ahead; the longest that is left needs 100 of them.
    assert s.left_s(50.0) == pytest.approx(505.0)
    s.start("j1", 50.0)
    s.step("j1", JobStep(1, 2), 300.0)
    # 60 in 300 s, 51 ahead.
    assert s.left_s(300.0) == pytest.approx(255.0)
    s.fail("j1", "diverged")
    assert s.left_s(300.0) == pytest.approx(1.0 / (10 / 300))
    s.finish("j2")
    assert s.left_s(301.0) == 0.0 and s.share == 1.0


def test_a_long_job_at_the_end_is_not_sped_up_by_the_others() -> None:
    s = JobsState({"a": JobInfo("a", 10.0), "b": JobInfo("b", 10.0), "c": JobInfo("c", 100.0)}, began=0.0)
    s.start("a", 0.0)
    s.start("b", 0.0)
    s.finish("a")
    s.finish("b")
    s.start("c", 10.0)
    # Two together did 2 a second, so one does 1: not 50 s but 100.
    assert s.left_s(10.0) == pytest.approx(100.0)


@pytest.mark.parametrize("width", [20, 60, 80, 120])
def test_the_lines_fit(width: int) -> None:
    s = example()
    s.fail("j3", "The training of 70_90_91 went to\x1b[2J not-a-number in epoch 3:\ngive a smaller rate.")
    shown = lines(s.status("sweep paper", "trainings", "macro-F1", 1060.0), width)
    assert all(len(text) <= width and text.isprintable() for text in shown)
    assert len(shown) == 5
    if width >= 60:
        assert shown[0] == "sweep paper: 2 of 4 trainings (1 from before), 1 failed"
        assert shown[1].endswith("60% 1 min 00 s, about 5 min 20 s left")
        assert shown[2] == "best macro-F1 0.587 14d1_39d2_41d4 8/12/16, 250 epochs"
        assert shown[3].startswith("last failed: 70_90_91 8/12/16: The training of 70_90_91")
        running = "  19d1_19d2_19d4_17d8 32/48/64/64  epoch  20 of 100  loss 1.250"
        assert shown[4] == (running if width > 60 else running[:59] + "…")


def test_a_low_screen_drops_running_jobs_and_counts_them() -> None:
    s = JobsState({str(n): JobInfo(f"network {n}", 1.0) for n in range(30)}, began=0.0)
    for n in range(20):
        s.start(str(n), float(n))
    status = s.status("t", "jobs", "score", 20.0)
    shown = lines(status, 80, 8)
    assert len(shown) == 8 and shown[-1] == "  and 15 more" and shown[2].startswith("  network 0  started 20 s ago")
    assert [len(lines(status, 80, height)) for height in (1, 2, 3)] == [1, 2, 3]


def test_one_line_for_a_log() -> None:
    assert example().status("sweep", "trainings", "macro-F1", 1060.0).line == (
        "sweep: 2 of 4 trainings (1 from before), 16%, 1 min 00 s, about 5 min 56 s left, "
        "best macro-F1 0.587 14d1_39d2_41d4 8/12/16, 250 epochs"
    )


def test_durations() -> None:
    assert [duration(s) for s in (0.2, 59.4, 59.6, 3599.0, 7500.0, 300000.0)] == [
        "0 s", "59 s", "1 min 00 s", "59 min 59 s", "2 h 05 min", "3 d 11 h",
    ]  # fmt: skip


def use(reporter: JobsReporter, pause: float = 0.0) -> None:
    with reporter:
        reporter.on_done(Job("j2", None), {"score": 0.4}, True)
        reporter.on_start(Job("j0", None))
        for epoch in range(1, 4):
            reporter.on_report(Job("j0", None), (epoch, 3))
            time.sleep(pause)
        reporter.on_done(Job("j0", None), {"score": 0.6}, False)
        reporter.on_failed(Job("j1", None), ValueError("no number"))
        reporter.write("by the way")


def make(stream: io.TextIOBase) -> JobsReporter:
    return JobsReporter(
        JOBS,
        title="sweep",
        score=lambda job, result: BestScore(result["score"], JOBS[job.id].name),
        stream=stream,  # type: ignore[arg-type]
    )


def test_without_a_terminal_lines_without_escapes() -> None:
    out = io.StringIO()
    use(make(out))
    written = out.getvalue().splitlines()
    assert written[:2] == ["19d1_19d2_19d4_17d8 32/48/64/64 failed: no number", "by the way"]
    assert written[2].startswith("sweep: 2 of 4 jobs (1 from before), 1 failed, ")
    assert "best score 0.600" in written[2]
    assert len(written) == 3 and "\x1b" not in out.getvalue()


def test_a_short_count_is_logged_only_if_it_is_kept() -> None:
    out = io.StringIO()
    for keep in (False, True):
        reporter = ProgressReporter("reading", "files", keep=keep, stream=out)
        for done in range(4):
            reporter(done, 3, detail="name", resumed=1)
    assert out.getvalue().splitlines() == ["reading: 3 of 3 files (1 from before), 100%, 0 s, name"]


def test_a_second_reporter_ends_the_first() -> None:
    out = io.StringIO()
    first = ProgressReporter("first", keep=True, stream=out)
    second = ProgressReporter("second", keep=True, stream=out)
    first(1, 3)
    second(2, 3)
    close_active()
    close_active()
    assert [line.partition(",")[0] for line in out.getvalue().splitlines()] == ["first: 1 of 3", "second: 2 of 3"]


def listen(end: int, read: bytearray) -> None:
    """All that is written: a pseudo-terminal holds 4 kB, and one reading gives no more."""
    while not read.endswith(b"over"):
        read += os.read(end, 65536)


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminal there")
def test_on_a_terminal_it_is_drawn_in_place_and_a_closed_one_stops_nothing(pty_possible: None) -> None:
    import fcntl
    import struct
    import termios

    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 70, 0, 0))
    # As Python opens standard error.
    stream = io.TextIOWrapper(os.fdopen(theirs, "wb", buffering=0), encoding="utf-8", write_through=True)
    with contextlib.suppress(OSError), stream:
        read = bytearray()
        listener = threading.Thread(target=listen, args=(ours, read), daemon=True)
        listener.start()
        use(make(stream), pause=0.25)
        stream.write("over")
        listener.join(10)
        text = read.decode()
        assert "\x1b[" in text and "epoch 1 of 3" in text and text.count("sweep: ") <= 8
        assert "19d1_19d2_19d4_17d8 32/48/64/64 failed: no number" in text
        assert "best score 0.600" in text
        assert text.removesuffix("over").endswith("\x1b[?25h")  # the cursor is back
        os.close(ours)
        reporter = make(stream)
        use(reporter, pause=0.25)
        assert reporter.state.done == {"j0", "j2"}


def test_a_full_disk_stops_nothing() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    stream = open("/dev/full", "w", encoding="utf-8")
    use(make(stream))
    with contextlib.suppress(OSError):
        stream.close()
