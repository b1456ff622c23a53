"""Train one network, as ``plushsense train`` does; or only say what it would take (``dry``).

dataset      path
settings     as `plushsense.apps.config.from_settings` takes them: what the command's options say
quantize_aware, fit_decisions
out          the bundle to write; one that is there is never replaced
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plushsense.apps.config import from_settings
from plushsense.apps.places import check_folder
from plushsense.apps.studio.tasks.telling import Clock
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """``bundle``, ``scores``, ``history``, ``seconds``, ``name``; of a dry run what `estimating` says."""
    config = from_settings(**spec.get("settings", {}))
    if spec.get("dry"):
        from plushsense.apps.estimating import preview_training

        return preview_training(spec["dataset"], config, warn=tell.warn)
    out = Path(spec["out"])
    check_folder(out.parent, "A bundle")
    tell.progress(stage="reading", share=0.0)

    from plushsense.apps.api import train
    from plushsense.apps.resuming import unfinished

    clock, tuning = Clock(), int(spec.get("quantize_aware", 0))
    whole = config.training.epochs + tuning

    def epoch(at: int, of: int, row: dict[str, Any]) -> None:
        fine = "what" in row
        done = config.training.epochs + at if fine else at
        stage = "fine-tuning" if fine else "training"
        shown = {k: row.get(k) for k in ("train_loss", "train_accuracy", "validation_loss", "validation_accuracy")}
        tell.progress(stage=stage, epoch=at, epochs=of, **shown, **clock.at(done / whole))
        if at == of and not fine and not tuning:
            tell.progress(stage="deciding", epoch=at, epochs=of, share=1.0)

    done = train(
        spec["dataset"],
        config,
        quantize_aware=tuning,
        fit_decisions=bool(spec.get("fit_decisions", True)),
        journal=unfinished(spec["dataset"]),
        progress=epoch,
        warn=tell.warn,
    )
    bundle = done.save(_free(out, done.bundle.to_bytes()))
    return {
        "bundle": str(bundle),
        "scores": done.scores,
        "seconds": round(done.seconds, 1),
        "parameters": done.bundle.arch.parameters,
        "title": done.bundle.arch.title,
        "epochs": len(done.history),
        "fitted": done.bundle.decision.get("fitted") is not None,
    }


def _free(path: Path, content: bytes) -> Path:
    """The path, or one beside it where meanwhile something else has taken it."""
    number, free = 2, path
    while free.exists() and not (free.is_file() and free.read_bytes() == content):
        free = path.with_stem(f"{path.stem} {number}")
        number += 1
    return free
