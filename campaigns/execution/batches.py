"""Batches of items for worker processes, sized by the measured time per item."""

import itertools
import math
from collections.abc import Iterable

#: Minimum target duration of a batch, s: a worker that dies loses at most one batch.
_BATCH_S = 1.0
#: Maximum time of a batch of several items as a multiple of its target duration.
_MAX_OVERRUN = 10.0
#: Time that sending a batch takes, s, and the maximum fraction of its time that the program spends with this.
_SENDING_S, _MAX_SENDING = 0.005, 0.5
#: Maximum number of items in a batch.
MAX_BATCH = 1000
#: Weight of the latest batch in the exponential mean of the time per item.
_LATEST_WEIGHT = 0.3


def batch_duration_s(workers: int) -> float:
    """Return the target duration of a batch: longer for many workers, so that sending batches is not the bottleneck."""
    return max(_BATCH_S, _SENDING_S / _MAX_SENDING * workers)


class Batches:
    """Batches of items, sized by the measured time per item.

    - items: iterator that is advanced only when a batch is requested
    - total: number of items, if known; the last batches are then small, so that all workers end together
    - workers: number of workers that run the batches
    - limit_s: time limit of an item; batches are planned to take at most half of it

    A batch of several items that takes longer than `max_duration_s` contains an unusual item.
    """

    def __init__(self, items: Iterable[int], total: int | None, workers: int, limit_s: float = math.inf) -> None:
        self._source = iter(items)
        self._limit_s = limit_s
        self._remaining = math.inf if total is None else total
        self.workers = workers
        self._size = 1
        self._item_s = math.nan

    @property
    def max_duration_s(self) -> float:
        """Maximum time of a batch of several items, s."""
        return _MAX_OVERRUN * batch_duration_s(self.workers)

    def next(self) -> list[int]:
        """Return the next batch; empty if no items remain."""
        size = max(1, int(min(self._size, self._remaining / (2 * self.workers))))
        batch = list(itertools.islice(self._source, size))
        self._remaining -= len(batch)
        return batch

    def record_time(self, items: int, seconds: float) -> None:
        """Update the time per item from a finished batch; a batch is at most twice as large as the previous one."""
        latest, mean = seconds / items, self._item_s
        self._item_s = latest if math.isnan(mean) else mean + _LATEST_WEIGHT * (latest - mean)
        duration_s = min(batch_duration_s(self.workers), 0.5 * self._limit_s)
        target_size = MAX_BATCH if self._item_s <= 0.0 else int(duration_s / self._item_s)
        self._size = max(1, min(target_size, 2 * self._size, MAX_BATCH))
