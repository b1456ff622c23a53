"""Thread pool for the chunks of a batch; the result does not depend on the number of threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

# Sums over chunks are formed in this many lanes and then added in order: equal for any number of threads.
LANES = 8

Out = TypeVar("Out")


def _alone() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)


class ThreadPool:
    """Threads that call a function for each chunk as (chunk, lane, thread)."""

    def __init__(self, threads: int) -> None:
        self.threads = min(threads, LANES)
        self._pool = ThreadPoolExecutor(self.threads, "plushsense-chunks", _alone) if self.threads > 1 else None

    def each(self, work: Callable[[int, int, int], Out], chunks: int) -> list[Out]:
        """Call ``work`` for each chunk and return the results in their order."""
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
