"""Pixels shared among threads: each is worked out as by one thread, to the bit, whoever does it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from numba import config

from marsyard.sim.render.kernels.strips import STRIP

#: Pixels below which the threads' start costs more than they save.
FEWEST = 20_000


def in_parts(work: Callable[[slice], None], pixels: int, threads: int | None = None) -> None:
    """Does work on all pixels, a part by each thread.

    Parameters
    ----------
    work
        Works on the pixels of a slice, mostly in kernels that let go of Python's lock.
    pixels
        How many there are.
    threads
        How many threads; None for as many as numba has (`NUMBA_NUM_THREADS`; one in a campaign's worker).
    """
    count = config.NUMBA_NUM_THREADS if threads is None else threads
    if count == 1 or pixels < FEWEST:
        work(slice(0, pixels))
        return
    # parts begin where kernels begin a strip of pixels anyway
    size = -(-pixels // count // STRIP) * STRIP
    parts = [slice(first, min(first + size, pixels)) for first in range(0, pixels, size)]
    for _ in _pool(count).map(work, parts):
        pass


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="pixels")
