"""The test case of all opponents: one network with its normalisation folded, and what it reads, to check it on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArchError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.deploy.quantize import calibrated, integer_model, refuse_undeployable
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import Network, affine, random_weights
from plushsense.runtime.image import IntegerModel
from plushsense.windows.features import Scaler, network_inputs

Floats = NDArray[np.float64]
CHECKED, CALIBRATED, APART = 200, 200, 8  # windows to check on, windows to calibrate with, decisions between them
FORMS = ("cheapest", "window", "span")


@dataclass(frozen=True, eq=False)
class Case:
    """A network, and the windows to run through it.

    ``frames`` (n, 1 + C) int32 are readings of the toy: ms and raw values. Our C reads them as a stream; ``steps``
    (n / step, C, step) float32 are the same as scaled inputs. ``windows`` (N, C, T) float32 each end at a decision of
    the stream; ``compared`` (N,) are the indices of these decisions, counted from the last one (-1).
    ``stream_logits`` and ``window_logits`` (N, K) are the float answers to each. ``calibration`` has what each input of
    the graph of an algorithm, "window" or "stream", reads in other decisions.
    """

    arch: Arch
    bundle: Bundle
    model: IntegerModel
    form: str
    weights: dict[str, NDArray[np.float32]]
    frames: NDArray[np.int32]
    calibration: dict[str, dict[str, NDArray[np.float32]]]
    windows: NDArray[np.float32]
    steps: NDArray[np.float32]
    compared: NDArray[np.int64]
    stream_logits: Floats
    window_logits: Floats

    @property
    def length(self) -> int:
        """Number of samples of a window."""
        return int(self.windows.shape[2])

    @property
    def macs(self) -> int:
        """Number of multiply-accumulates of one decision from a window."""
        return macs_of(self.arch, self.form)

    def save(self, folder: Path) -> None:
        """Save everything that an opponent needs, so that it can run without PlushSense."""
        facts = {f"dilation{i}": np.int64(layer.dilation) for i, layer in enumerate(self.arch.layers)}
        for algorithm, reads in (("window", self.windows), ("stream", self.steps)):
            given = {f"calibration.{name}": values for name, values in self.calibration[algorithm].items()}
            padded = np.int64(algorithm == "window" and self.form == "window")
            layers = np.int64(len(self.arch.layers))
            np.savez(
                folder / f"{algorithm}.npz", **self.weights, **facts, **given, layers=layers, padded=padded, x=reads
            )
            (folder / f"{algorithm}.bin").write_bytes(reads.tobytes())
        (folder / "frames.bin").write_bytes(self.frames.tobytes())


def macs_of(arch: Arch, form: str) -> int:
    """Return the multiply-accumulates of one decision that recomputes everything, without the dense layer."""
    positions = (arch.window,) * len(arch.layers) if form == "window" else arch.positions
    each = zip(arch.layers, arch.inputs, positions, strict=True)
    return sum(layer.kernel * read * layer.filters * n for layer, read, n in each)


def make_case(
    symbol: str,
    filters: str,
    *,
    layout: str = "plush-15",
    gestures: str = "plush-18",
    window: int = 250,
    form: str = "cheapest",
    bundle: str | None = None,
    seed: int = 1,
) -> Case:
    """Return a network with random weights, or that of a bundle, and random frames for it."""
    laid, named, scaler = load_layout(layout), load_gestures(gestures), None
    if bundle is None:
        arch = Arch.parse(symbol, filters, channels=laid.n_inputs, classes=len(named), window=window)
        weights = random_weights(arch, seed)
    else:
        found = Bundle.load(bundle)
        arch, weights, laid, named, scaler = found.arch, dict(found.weights), found.layout, found.gestures, found.scaler
    refuse_undeployable(arch)
    if arch.padding != "stream":
        raise ArchError(f"{arch.title} has the padding '{arch.padding}': the comparison needs 'stream'.")
    if form == "cheapest":
        form = min(("window", "span"), key=lambda f: macs_of(arch, f))
    return _filled(arch, weights, laid, named, scaler, form, seed)


def _filled(
    arch: Arch,
    weights: dict[str, NDArray[np.float32]],
    layout: Layout,
    gestures: GestureSet,
    scaler: Scaler | None,
    form: str,
    seed: int,
) -> Case:
    length = arch.window if form == "window" else arch.span
    first = -(-max(length - arch.span, 0) // arch.step)  # the first decision with a whole window before it
    decisions = first + APART * (CALIBRATED + CHECKED)
    frames = made_up_frames(layout, scaler, arch.span + arch.step * decisions, seed)
    x = network_inputs(frames[:, 1:].astype(np.int64), layout)
    at = first + APART * np.arange(CALIBRATED + CHECKED)
    ends = arch.span + arch.step * at
    raw = np.stack([x[end - arch.span : end].T for end in ends])
    bundle = Bundle(arch, weights, layout, scaler or Scaler.fit(raw[:CALIBRATED]), gestures)
    bundle = calibrated(bundle, raw[:CALIBRATED])
    spans = bundle.scaler.apply(raw)
    windows = bundle.scaler.apply(np.stack([x[end - length : end].T for end in ends]))
    stream = Network(arch, weights).forward(spans[CALIBRATED:])
    plain = fold(arch, weights)
    apart = np.abs(forward(arch, plain, spans[CALIBRATED:][:4], padded=False) - stream[:4]).max()
    if apart > 1e-3 * np.abs(stream).max():
        raise ArchError(f"Folding the normalisation of {arch.title} changed its answers by {apart:.2g}: a bug here.")
    answers = forward(arch, plain, windows[CALIBRATED:], padded=form == "window")
    # The stream's blocks of `step` samples end where its decisions do.
    steps = bundle.scaler.apply(x[arch.span % arch.step :].T[None])[0]
    steps = np.ascontiguousarray(steps.reshape(len(steps), -1, arch.step).transpose(1, 0, 2))
    given = {"window": {"x": windows[:CALIBRATED]}, "stream": stream_inputs(arch, plain, spans[:CALIBRATED])}
    return Case(
        arch, bundle, integer_model(bundle), form, plain, frames, given, windows[CALIBRATED:], steps,
        at[CALIBRATED:] - decisions - 1, stream, answers,
    )  # fmt: skip


def made_up_frames(layout: Layout, scaler: Scaler | None, n: int, seed: int) -> NDArray[np.int32]:
    """Return frames (n, 1 + C), one every 10 ms, whose levels and variances change every few seconds."""
    rng = np.random.default_rng(seed)
    channels = len(layout.channels)
    level, size = np.empty((n, channels)), np.empty((n, channels))
    at = 0
    while at < n:
        until = at + int(rng.integers(150, 600))
        level[at:until], size[at:until] = rng.uniform(-1.7, 1.7, channels), rng.uniform(0.05, 0.5, channels)
        at = until
    noise = rng.normal(size=(n, channels))
    for t in range(1, n):
        noise[t] += 0.8 * noise[t - 1]
        level[t] = 0.95 * level[t - 1] + 0.05 * level[t]
    offset, spread = np.full(channels, 1000.0), np.full(channels, 300.0)
    if scaler is not None:
        for i, name in enumerate(layout.inputs):
            if all(name != d.name for d in layout.derived):
                offset[layout.index(name)], spread[layout.index(name)] = scaler.offset[i], 1 / scaler.scale[i]
    values = np.rint(offset + spread * (level + size * noise))
    values = np.clip(values, layout.valid_min_int, layout.valid_max_int)
    return np.column_stack([10 * np.arange(n), values]).astype(np.int32)


def fold(arch: Arch, weights: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Return the network without normalisation: ``w0 (F, C, K)``, ``b0`` … ``dense_w``, ``dense_b``."""
    gain, shift, found = np.ones(arch.channels), np.zeros(arch.channels), dict[str, Floats]()
    for i in range(len(arch.layers)):
        w = weights[f"conv{i}.weight"].astype(np.float64)
        found |= {f"w{i}": w * gain[:, None], f"b{i}": weights[f"conv{i}.bias"] + w.sum(axis=2) @ shift}
        gain, shift = affine(arch, i, weights)
    w = weights["dense.weight"].astype(np.float64)
    found |= {"dense_w": w * gain, "dense_b": weights["dense.bias"] + w @ shift}
    return {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in found.items()}


def layer_inputs(
    arch: Arch, plain: dict[str, NDArray[np.float32]], x: NDArray[np.float32], *, padded: bool
) -> list[Floats]:
    """Return what each layer reads (N, C, T) from windows (N, C, T), and last what the pooling reads.

    ``padded`` puts zeros before each layer's first sample.
    """
    read, z = [], x.astype(np.float64)
    for i, layer in enumerate(arch.layers):
        if padded:
            z = np.pad(z, ((0, 0), (0, 0), (layer.reach, 0)))
        read.append(z)
        length = z.shape[2] - layer.reach
        taps = [z[:, :, k * layer.dilation : k * layer.dilation + length] for k in range(layer.kernel)]
        z = sum(plain[f"w{i}"][:, :, k].astype(np.float64) @ tap for k, tap in enumerate(taps))
        z = np.maximum(z + plain[f"b{i}"][:, None], 0.0)
    return [*read, z]


def forward(arch: Arch, plain: dict[str, NDArray[np.float32]], x: NDArray[np.float32], *, padded: bool) -> Floats:
    """Return the float logits (N, K) of windows (N, C, T)."""
    z = layer_inputs(arch, plain, x, padded=padded)[-1]
    return z.mean(axis=2) @ plain["dense_w"].T + plain["dense_b"]


def stream_inputs(
    arch: Arch, plain: dict[str, NDArray[np.float32]], spans: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """Return what the graph of a step reads at the end of each span (N, C, span).

    ``x`` are the new samples, ``history`` the inputs that a layer still needs, ``blocks`` the means of the last layer
    over each earlier step of the pooling.
    """
    *read, last = layer_inputs(arch, plain, spans, padded=False)
    given = {"x": read[0][:, :, -arch.step :]}
    for i, (layer, z) in enumerate(zip(arch.layers, read, strict=True)):
        if layer.reach:
            given[f"history{i}"] = z[:, :, -arch.step - layer.reach : -arch.step]
    given["blocks"] = last.reshape(*last.shape[:2], -1, arch.step).mean(axis=3)[:, :, :-1]
    return {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in given.items()}
