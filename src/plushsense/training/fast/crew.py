"""Threads that share the chunks of a batch. What comes out does not depend on how many there are."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

# Sums over chunks are made in so many lanes, then added in order: any number of threads adds alike.
LANES = 8

Out = TypeVar("Out")


def _alone() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)


class Crew:
    """Calls a function for each chunk, as (chunk, lane, thread)."""

    def __init__(self, threads: int) -> None:
        self.threads = min(threads, LANES)
        self._pool = ThreadPoolExecutor(self.threads, "plushsense-chunks", _alone) if self.threads > 1 else None

    def each(self, work: Callable[[int, int, int], Out], chunks: int) -> list[Out]:
        """The results in the order of the chunks."""
        if self._pool is None or chunks == 1:
            return [work(i, i % LANES, 0) for i in range(chunks)]

        def share(thread: int) -> list[tuple[int, Out]]:
            return [(i, work(i, i % LANES, thread)) for i in range(chunks) if i % LANES % self.threads == thread]

        found = [pair for part in self._pool.map(share, range(self.threads)) for pair in part]
        return [out for _, out in sorted(found, key=lambda pair: pair[0])]

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
