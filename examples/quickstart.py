"""Record, import, train, evaluate on people left out, and read a live toy, in Python.

The example uses virtual people and needs no hardware: its scores are of a simulation, not of a real toy. For your own
recordings, leave out `simulate` and give the name of your folder.
"""

import sys
from pathlib import Path

import plushsense as ps
from plushsense.workflow.api import simulate


def main(out: Path, people: int = 6, epochs: int = 15, seconds: float = 20.0) -> None:
    simulate(out / "recordings", people=people, repetitions=2)
    ps.import_recordings(out / "recordings", out / "DS", layout="plush-15")
    dataset = ps.open_dataset(out / "DS")
    print(dataset)
    print(ps.cut_windows(dataset))

    network = ps.Arch.parse("14d1_19d2_19d4", (8, 12, 16))
    print(f"{network.parameters} parameters, {network.macs_per_step} multiply-accumulates every 50 ms")

    result = ps.evaluate(dataset, split="by-subject:2", epochs=epochs, out=out / "evaluation")
    print(result)
    trained = ps.train(dataset, epochs=epochs)
    trained.save(out / "model.plush")
    print("report:", ps.write_report(out / "report.html", dataset, [result], [trained.bundle]))

    bundle = ps.load(out / "model.plush")
    classifier = ps.StreamClassifier(bundle)
    with ps.open_device(f"virtual://?person=101&speed=0&seconds={seconds}", bundle.layout) as toy:
        decisions = [decision for frame in toy for decision in classifier.push(frame)]
    print(f"{len(decisions)} decisions, the last: {decisions[-1].gesture} ({decisions[-1].affect})")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "quickstart-out"))
