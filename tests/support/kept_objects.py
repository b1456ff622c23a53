"""What all tests and workers share of exported C: object files, and the answers that a model is to give."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from numpy.typing import NDArray

from plushsense.deploy.golden import Vectors, answers_of
from plushsense.deploy.proof.scenarios import scenarios_of
from plushsense.deploy.targets import Program, build
from plushsense.runtime.image import IntegerModel
from plushsense.windows.features import Scaler
from support.sharing import built_once


@contextmanager
def keeping_objects(factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compile once what is the same, flags included: object files are named by a hash of it."""
    objects = built_once(factory, "objects", lambda draft: None)

    def keeping(*args: Any, **options: Any) -> Program:
        return build(*args, **{**options, "object_folder": objects})

    with pytest.MonkeyPatch.context() as patch:
        for module in ("profile", "proof.verify"):
            patch.setattr(f"plushsense.deploy.{module}.build", keeping)
        patch.setattr("support.virtual_boards.OBJECTS", objects)
        yield


@contextmanager
def keeping_answers(factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make the scenarios of a model, and its answers to frames, once: they follow from these alone."""
    folder = built_once(factory, "answers", lambda draft: None)

    def once(make: Callable[[], Any], *inputs: object) -> Any:
        file = folder / sha256(pickle.dumps(inputs)).hexdigest()
        with FileLock(f"{file}.lock"):
            if not file.exists():
                draft = file.with_suffix(".draft")
                draft.write_bytes(pickle.dumps(make()))
                draft.replace(file)
        return pickle.loads(file.read_bytes())

    def answers_once(model: IntegerModel, frames: NDArray[np.int64]) -> NDArray[np.int32]:
        inputs = model.to_bytes(), repr(model.gestures), frames.tobytes()
        answers: NDArray[np.int32] = once(lambda: answers_of(model, frames), *inputs)
        return answers

    def scenarios_once(model: IntegerModel, scaler: Scaler, repeat: int = 0) -> list[Vectors]:
        inputs = model.to_bytes(), repr(model.gestures), scaler.offset.tobytes(), scaler.scale.tobytes(), repeat
        scenarios: list[Vectors] = once(lambda: scenarios_of(model, scaler, repeat), *inputs)
        return scenarios

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("plushsense.deploy.proof.vectors.scenarios_of", scenarios_once)
        for module in ("golden", "proof.vectors"):
            patch.setattr(f"plushsense.deploy.{module}.answers_of", answers_once)
        yield
