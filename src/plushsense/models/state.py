"""What a network remembers of a stream: the past that each layer still reads, and the pooling sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plushsense.models.arch import ConvLayer

Floats = NDArray[np.float64]

CHUNK = 256  # samples that are worked on at once: their taps stay in the cache


class Ring:
    """The past that a layer still reads; rows move to the front only when the room behind them is used up."""

    def __init__(self, layer: ConvLayer, channels: int) -> None:
        self.layer = layer
        self.rows = np.zeros((layer.reach + 2 * CHUNK, channels))
        self.end = 0

    def feed(self, x: Floats) -> Floats:
        """New rows (n, C): the taps (m, kernel · C) of the positions that they complete."""
        reach = self.layer.reach
        if self.end + len(x) > len(self.rows):
            kept = min(reach, self.end)
            self.rows[:kept] = self.rows[self.end - kept : self.end]
            self.end = kept
        first = max(self.end - reach, 0)
        self.rows[self.end : self.end + len(x)] = x
        self.end += len(x)
        n, c = self.end - reach - first, self.rows.shape[1]
        if n <= 0:
            return np.empty((0, self.layer.kernel * c))
        row = 8 * c
        shape, strides = (n, self.layer.kernel, c), (row, self.layer.dilation * row, 8)
        return np.ndarray(shape, np.float64, self.rows, first * row, strides).reshape(n, -1)


class Pool:
    """The running mean of the last ``blocks`` · ``step`` rows, from one sum a step.

    Sums are only ever added up anew, never subtracted, so that nothing drifts.
    """

    def __init__(self, step: int, blocks: int, features: int) -> None:
        self.step = step
        self.blocks = blocks
        self.done = np.empty((0, features))  # sums of whole steps, at most blocks − 1
        self.open = np.zeros(features)  # sum of the step that is filling
        self.held = 0

    def feed(self, z: Floats) -> Floats:
        """New rows (n, F): the mean (m, F) at each step that they complete, once all blocks are there."""
        if self.held + len(z) < self.step:
            self.open = self.open + z.sum(axis=0)
            self.held += len(z)
            return z[:0]
        head = self.step - self.held
        whole = (len(z) - head) // self.step
        rest = z[head + whole * self.step :]
        first = self.open + z[:head].sum(axis=0)
        others = z[head : head + whole * self.step].reshape(whole, self.step, z.shape[1]).sum(axis=1)
        sums = np.concatenate([self.done, first[None], others])
        self.open, self.held = rest.sum(axis=0), len(rest)
        self.done = sums[max(len(sums) - self.blocks + 1, 0) :]
        n = len(sums) - self.blocks + 1
        if n <= 0:
            return z[:0]
        row, item = sums.strides
        runs = np.ndarray((n, self.blocks, sums.shape[1]), np.float64, sums, 0, (row, row, item))
        return np.asarray(runs.sum(axis=1) / (self.blocks * self.step))
