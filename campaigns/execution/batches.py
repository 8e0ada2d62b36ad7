"""Cuts cases into batches of about a second, so that what a batch costs to send is small beside its cases."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

#: How long a batch should run. Sending one costs some 3 ms, and a worker that dies takes no more than this with it.
BATCH_S = 1.0

#: The most cases in a batch.
MAX_CASES = 1000

#: Weight of the latest batch in the running mean of the time that a case takes.
_WEIGHT = 0.3


class Batches:
    """Batches of a sequence of items, sized as the time that items take becomes known.

    Parameters
    ----------
    items
        Taken as batches are asked for, and no sooner.
    total
        How many they are, as far as known: the last batches are then cut small, so that all workers end together.
    workers
        How many work on them.
    """

    def __init__(self, items: Iterable[int], total: int | None, workers: int) -> None:
        self._source = iter(items)
        self._left = total
        self._workers = workers
        self._size = 1
        self._item_s = math.nan

    def next(self) -> list[int]:
        """The next batch; empty where no items are left."""
        size = self._size
        if self._left is not None:
            size = max(1, min(size, self._left // (2 * self._workers)))
        batch = list(itertools.islice(self._source, size))
        if self._left is not None:
            self._left -= len(batch)
        return batch

    def took(self, items: int, seconds: float) -> None:
        """Tells how long a batch ran; a batch is at most twice as large as the one before it."""
        latest = seconds / items
        known = not math.isnan(self._item_s)
        self._item_s = self._item_s + _WEIGHT * (latest - self._item_s) if known else latest
        wanted = MAX_CASES if self._item_s <= 0.0 else int(BATCH_S / self._item_s)
        self._size = max(1, min(wanted, 2 * self._size, MAX_CASES))
