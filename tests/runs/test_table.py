"""The table: what it says at every width, what it expects, and that no terminal can stop a run."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from plushsense.runs.jobs import Job
from plushsense.runs.table import At, Best, Row, Standing, Table, duration, line, lines

ROWS = {f"j{n}": Row(f"{name} {filters}", cost) for n, (name, filters, cost) in enumerate([
    ("14d1_39d2_41d4", "8/12/16", 10.0),
    ("19d1_19d2_19d4_17d8", "32/48/64/64", 100.0),
    ("250", "8", 1.0),
    ("70_90_91", "8/12/16", 89.0),
])}  # fmt: skip


def standing() -> Standing:
    s = Standing(ROWS, began=1000.0)
    s.finish("j2", Best(0.412, "250 8"), resumed=True)
    s.start("j0", 1000.0)
    s.start("j1", 1000.0)
    s.finish("j0", Best(0.587, "14d1_39d2_41d4 8/12/16, 250 epochs"))
    s.start("j3", 1060.0)
    s.report("j1", At(20, 100, 1.25), 1060.0)
    return s


def test_the_time_left_comes_from_costs_of_this_run_alone() -> None:
    s = Standing(ROWS, began=0.0)
    s.finish("j3", resumed=True)
    s.start("j0", 0.0)
    # 89 of 200 were there before: no measure of this run's speed.
    assert s.left_s(50.0) is None and s.share == pytest.approx(89 / 200)
    s.finish("j0")
    # 10 in 50 s, 101 ahead; the longest that is left needs 100 of them.
    assert s.left_s(50.0) == pytest.approx(505.0)
    s.start("j1", 50.0)
    s.report("j1", At(1, 2), 300.0)
    # 60 in 300 s, 51 ahead.
    assert s.left_s(300.0) == pytest.approx(255.0)
    s.fail("j1", "diverged")
    assert s.left_s(300.0) == pytest.approx(1.0 / (10 / 300))
    s.finish("j2")
    assert s.left_s(301.0) == 0.0 and s.share == 1.0


def test_a_long_job_at_the_end_is_not_sped_up_by_the_others() -> None:
    s = Standing({"a": Row("a", 10.0), "b": Row("b", 10.0), "c": Row("c", 100.0)}, began=0.0)
    s.start("a", 0.0)
    s.start("b", 0.0)
    s.finish("a")
    s.finish("b")
    s.start("c", 10.0)
    # Two together did 2 a second, so one does 1: not 50 s but 100.
    assert s.left_s(10.0) == pytest.approx(100.0)


@pytest.mark.parametrize("width", [20, 60, 80, 120])
def test_the_lines_fit(width: int) -> None:
    s = standing()
    s.fail("j3", "The training of 70_90_91 went to\x1b[2J not-a-number in epoch 3:\ngive a smaller rate.")
    shown = lines(s, "sweep paper", 1060.0, width, score="macro-F1")
    assert all(len(text) <= width and text.isprintable() for text in shown)
    assert len(shown) == 5
    if width >= 60:
        assert shown[0] == "sweep paper: 2 of 4 done (1 from before), 1 failed"
        assert shown[1].endswith(" 60%  1 min 00 s, about 5 min 20 s left")
        assert shown[2] == "best macro-F1 0.587  14d1_39d2_41d4 8/12/16, 250 epochs"
        assert shown[3].startswith("1 failed, last 70_90_91 8/12/16: The training of 70_90_91")
        wanted = "  19d1_19d2_19d4_17d8 32/48/64/64  epoch  20 of 100  loss 1.250"
        assert shown[4] == (wanted if width > 60 else wanted[:59] + "…")


def test_a_low_screen_drops_what_runs_and_says_how_many() -> None:
    rows = {str(n): Row(f"network {n}", 1.0) for n in range(30)}
    s = Standing(rows, began=0.0)
    for n in range(20):
        s.start(str(n), float(n))
    shown = lines(s, "t", 20.0, 80, 8)
    assert len(shown) == 8 and shown[-1] == "  and 15 more" and shown[2].startswith("  network 0  begun 20 s ago")
    assert [len(lines(s, "t", 20.0, 80, height)) for height in (1, 2, 3)] == [1, 2, 3]


def test_one_line_for_a_log() -> None:
    assert line(standing(), "sweep", 1060.0, "macro-F1") == (
        "sweep: 2 of 4 done (1 from before), 16%, 1 min 00 s, about 5 min 56 s left, "
        "best macro-F1 0.587 14d1_39d2_41d4 8/12/16, 250 epochs"
    )


def test_durations_in_words() -> None:
    assert [duration(s) for s in (0.2, 59.4, 59.6, 3599.0, 7500.0, 300000.0)] == [
        "0 s", "59 s", "1 min 00 s", "59 min 59 s", "2 h 05 min", "3 d 11 h",
    ]  # fmt: skip


def use(table: Table, pause: float = 0.0) -> None:
    with table:
        table.on_done(Job("j2", None), {"score": 0.4}, True)
        table.on_start(Job("j0", None))
        for epoch in range(1, 4):
            table.on_report(Job("j0", None), (epoch, 3))
            time.sleep(pause)
        table.on_done(Job("j0", None), {"score": 0.6}, False)
        table.on_failed(Job("j1", None), ValueError("no number"))
        table.say("by the way")


def make(stream: io.TextIOBase) -> Table:
    return Table(
        "sweep",
        ROWS,
        read=lambda said: At(*said),
        score=lambda job, result: Best(result["score"], ROWS[job.id].name),
        stream=stream,  # type: ignore[arg-type]
    )


def test_without_a_terminal_lines_without_escapes() -> None:
    out = io.StringIO()
    use(make(out))
    told = out.getvalue().splitlines()
    assert told[:2] == ["19d1_19d2_19d4_17d8 32/48/64/64 failed: no number", "by the way"]
    assert told[2].startswith("sweep: 2 of 4 done (1 from before), 1 failed, ") and "best score 0.600" in told[2]
    assert len(told) == 3 and "\x1b" not in out.getvalue()


def listen(end: int, heard: bytearray) -> None:
    """All that is written: a pseudo-terminal holds 4 kB, and one reading gives no more."""
    while not heard.endswith(b"over"):
        heard += os.read(end, 65536)


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
        heard = bytearray()
        listener = threading.Thread(target=listen, args=(ours, heard), daemon=True)
        listener.start()
        use(make(stream), pause=0.25)
        stream.write("over")
        listener.join(10)
        seen = heard.decode()
        assert "\x1b[" in seen and "epoch 1 of 3" in seen and seen.count("sweep: ") <= 8
        last = seen.removesuffix("over").rpartition("\x1b[J")[2].replace("\r", "").splitlines()
        assert all(len(text) < 70 for text in last)
        assert "19d1_19d2_19d4_17d8 32/48/64/64 failed: no number" in seen
        assert any(text.startswith("best score 0.600") for text in last)
        os.close(ours)
        table = make(stream)
        use(table, pause=0.25)
        assert table.standing.done == {"j0", "j2"}


def test_a_full_disk_stops_nothing() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    stream = open("/dev/full", "w", encoding="utf-8")
    use(make(stream))
    with contextlib.suppress(OSError):
        stream.close()
