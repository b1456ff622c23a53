"""Compare 8-bit answers with those in floats on recorded windows: ours, and those of other runtimes.

    plushsense train DS --arch 14d1_19d2_19d4 --filters 8,12,16 --out model.plush
    python bench/exactness.py model.plush DS [--python THERE/bin/python] [--json]

`peers.py` explains the environment of the other runtimes. The windows are those of the people who were held out of the
training, one every 0.1 s within each recording. Every runtime gets the same trained weights with the normalisation
folded in, and reads exactly the span of our decision. It is quantized by its own tool on windows of the training people
(at most 1024, evenly spaced, as PlushSense takes). Ours is the network in integers, to which the C is equal in every
bit, with the calibration in the bundle. "as float" is the share of windows with the same best class as in floats;
"error" is the root mean square of the differences of the logits, divided by their spread.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError, PlushSenseError
from plushsense.deploy.quantize import integer_network
from plushsense.models.bundle import Bundle
from plushsense.models.reference import Network
from plushsense.workflow.export import training_windows

sys.path.insert(0, str(Path(__file__).resolve().parent))

from opponents.case import make_case
from opponents.programs import CannotBuild, Workshop
from opponents.running import Died, Running
from peers import PEERS, python_entry, say

STEP_S = 0.1
MOST_CALIBRATED = 1024
INT8 = [name for name in PEERS if name not in ("tflite-micro", "onnxruntime")]


def held_out_windows(bundle: Bundle, dataset: str) -> NDArray[np.int32]:
    """Cut raw windows (N, C, T) of the people who were held out of the training of a bundle.

    Raises:
        BundleError: if nobody was held out, or as for `plushsense.workflow.export.training_windows`.
    """
    people = bundle.provenance.get("validation_subjects")
    if not people:
        raise BundleError("The bundle names nobody who was held out of its training: train it again.")
    origin, windowing = {**bundle.provenance, "subjects": people}, {**bundle.windowing, "step_s": STEP_S}
    return training_windows(replace(bundle, provenance=origin, windowing=windowing), dataset)


def closeness(logits: NDArray[Any], exact: NDArray[Any]) -> dict[str, float]:
    """Return the agreement and the logit error of logits (N, K) with those in floats."""
    error = np.sqrt(np.square(logits - exact).mean()) / exact.std(axis=0).mean()
    return {"agreement": float((logits.argmax(axis=1) == exact.argmax(axis=1)).mean()), "logit_error": float(error)}


def compare(path: str, dataset: str, python: str, peers: list[str]) -> dict[str, Any]:
    """Return what ours and the other runtimes answer to the held-out people's windows."""
    bundle = Bundle.load(path)
    arch = bundle.arch
    if arch.vector is not None and peers:
        raise BundleError(f"{arch.title} has a vector layer, which the others do not get here: give --only none.")
    learnt, x = training_windows(bundle, dataset), held_out_windows(bundle, dataset)
    chosen = np.unique(np.linspace(0, len(learnt) - 1, min(len(learnt), MOST_CALIBRATED)).round().astype(np.int64))
    spans, given = (bundle.scaler.apply(part[:, :, -arch.span :]) for part in (x, learnt[chosen]))
    exact = Network(arch, bundle.weights).forward(spans)
    rows, absent = {"PlushSense, int8": closeness(integer_network(bundle).forward(x) / 256, exact)}, {}
    with tempfile.TemporaryDirectory(prefix="exactness-") as name:
        folder = Path(name)
        if peers:
            case = make_case("", "", form="span", bundle=path)
            calibration = case.calibration | {"window": {"x": given}}
            replace(case, calibration=calibration, windows=spans).save(folder)
        for peer in peers:
            say(f"{PEERS[peer][0]} …")
            try:
                entry = python_entry(peer, "window", python, Workshop(folder))
                with Running(entry.command, folder) as process:
                    rows[entry.name] = closeness(process.check(folder, arch.classes), exact)
            except (CannotBuild, Died) as reason:
                absent[PEERS[peer][0]] = str(reason)
    people = bundle.provenance["validation_subjects"]
    return {"title": arch.title, "windows": len(x), "people": people, "rows": rows, "absent": absent}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle")
    parser.add_argument("dataset", help="the data set that it was trained on")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the other runtimes")
    parser.add_argument("--only", default=",".join(INT8), help=f"of {','.join(INT8)}; 'none': ours alone")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    peers = [] if args.only == "none" else args.only.split(",")
    if unknown := [name for name in peers if name not in INT8]:
        parser.error(f"--only names '{unknown[0]}': known are {', '.join(INT8)} and none")
    # Absolute: the runtimes run in another folder.
    python = str(Path(shutil.which(args.python) or args.python).absolute())
    try:
        report = compare(args.bundle, args.dataset, python, peers)
    except PlushSenseError as refusal:
        say(f"bench/exactness.py: {refusal}")
        return 2
    print(json.dumps(report, indent=None if args.json else 1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
