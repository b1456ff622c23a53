#!/usr/bin/env bash
# pyxdf: a pause of 4 s in a stream of 100 Hz is no pause: samples at its edges are moved by 2 s, markers are not.
#
# Guess:    load_xdf evens out jitter, and leaves alone what its option jitter_break_threshold_seconds, 1 by default, calls
#           a break: samples on both sides of a pause of 4 s keep their times to within the jitter.
# Version:  pyxdf 1.17.5, numpy 2.4.6, Python 3.11.
# Input:    one file with a stream of 100 samples a second, without any jitter: 60 s, a pause, 60 s, clock offsets of 0. A
#           stream of markers at an irregular rate has one at the last sample before the pause, one at the first after it.
# Seen:     a break must exceed both thresholds, the second of which (jitter_break_threshold_samples) is 500 samples: 5 s at
#           100 Hz, 20 s at 25 Hz. A pause of 4 s is spread over the whole stream: the two samples at its edges come out 2 s
#           late and 2 s early, and the two markers, which keep their times, stand at samples about 190 away from theirs.
#           There is no warning, as the rate that is found (95 Hz) is off by less than a tenth. After a pause of 6 s,
#           every time is right. So it is after 4 s with jitter_break_threshold_samples=0 or dejitter_timestamps=False.
# Matters:  a recording of a wireless toy has pauses of some seconds. Labels from a stream of markers then name samples that
#           are two seconds away, longer than most touches, and nothing in the result tells.
# Exits with 1 if it behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip --disable-pip-version-check install --quiet pyxdf==1.17.5 numpy==2.4.6
venv/bin/python - << 'PYTHON'
import logging
import struct
import sys

import numpy as np
import pyxdf

RATE = 100
said = []


class Keep(logging.Handler):
    def emit(self, record):
        if record.levelno >= logging.WARNING:
            said.append(record.getMessage())


logging.getLogger().addHandler(Keep())


def chunk(tag, content):
    size = len(content) + 2
    return b"\x04" + struct.pack("<I", size) + struct.pack("<H", tag) + content


def header(number, name, rate, form):
    text = (
        f"<?xml version='1.0'?><info><name>{name}</name><type>{name}</type><channel_count>1</channel_count>"
        f"<nominal_srate>{rate}</nominal_srate><channel_format>{form}</channel_format></info>"
    )
    return chunk(2, struct.pack("<I", number) + text.encode())


def samples(number, times, values):
    rows = b"".join(b"\x08" + struct.pack("<d", t) + value for t, value in zip(times, values))
    return chunk(3, struct.pack("<I", number) + b"\x04" + struct.pack("<I", len(times)) + rows)


def offset(number, time):
    return chunk(4, struct.pack("<Idd", number, time, 0.0))


def footer(number, times):
    text = (
        f"<?xml version='1.0'?><info><first_timestamp>{times[0]}</first_timestamp><last_timestamp>{times[-1]}"
        f"</last_timestamp><sample_count>{len(times)}</sample_count></info>"
    )
    return chunk(6, struct.pack("<I", number) + text.encode())


def session(pause):
    """Return the true times of the samples and of the markers, and write both into session.xdf."""
    half = np.arange(60 * RATE) / RATE
    times = 1000.0 + np.concatenate([half, half[-1] + pause + half])
    marks = times[[len(half) - 1, len(half)]]
    words = [b"\x01" + bytes([len(word)]) + word for word in (b"held", b"hit")]
    with open("session.xdf", "wb") as file:
        file.write(b"XDF:" + chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>"))
        file.write(header(1, "touch", RATE, "float32") + header(2, "markers", 0, "string"))
        for at in range(0, len(times), RATE):
            part = slice(at, at + RATE)
            file.write(samples(1, times[part], [struct.pack("<f", i) for i in range(at, at + RATE)]))
            file.write(offset(1, times[at]) + offset(2, times[at]))
        file.write(samples(2, marks, words) + footer(1, times) + footer(2, marks))
    return times, marks


def read(pause, **options):
    """Return how far times of samples and of markers are off at most, how many samples markers are off, and the rate."""
    times, marks = session(pause)
    said.clear()
    streams, _ = pyxdf.load_xdf("session.xdf", verbose=False, **options)
    found = {stream["info"]["name"][0]: stream for stream in streams}
    touch, markers = found["touch"]["time_stamps"], found["markers"]["time_stamps"]
    true = [int(np.argmin(abs(times - mark))) for mark in marks]
    seen = [int(np.argmin(abs(touch - mark))) for mark in markers]
    return {
        "seconds": round(float(abs(touch - times).max()), 2),
        "markers": round(float(abs(markers - marks).max()), 6),
        "samples": [b - a for a, b in zip(true, seen)],
        "rate": round(float(found["touch"]["info"]["effective_srate"]), 1),
        "warnings": len(said),
    }


cases = {
    "pause of 4 s": read(4.0),
    "pause of 6 s": read(6.0),
    "pause of 4 s, jitter_break_threshold_samples=0": read(4.0, jitter_break_threshold_samples=0),
    "pause of 4 s, dejitter_timestamps=False": read(4.0, dejitter_timestamps=False),
}
for name, seen in cases.items():
    print(f"{name}: {seen}")
first, *others = cases.values()
expected = first["seconds"] > 1.9 and min(map(abs, first["samples"])) >= 150 and first["markers"] == first["warnings"] == 0
expected = expected and all(o["seconds"] == 0.0 and o["samples"] == [0, 0] for o in others)
print("as described" if expected else "NOT as described")
sys.exit(0 if expected else 1)
PYTHON
