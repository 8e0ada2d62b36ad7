"""Threads and heap settings of a process that renders."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from numba import config

from marsyard.sim.render.kernels.strips import STRIP

#: Pixels below which starting threads costs more than they save.
MIN_PIXELS = 20_000
#: Options of glibc's mallopt (malloc.h): size from which memory is mapped separately, and size of the free end of the
#: heap from which it is returned to the system.
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1
#: Terrains are larger than this and mapped, pictures smaller.
_MAPPED_FROM_BYTES = 32 << 20
_KEPT_BYTES = 1 << 30


def in_parts(work: Callable[[slice], None], pixels: int, threads: int | None = None) -> None:
    """Run `work` on slices of all pixels in threads; the result does not depend on their number.

    `threads` is by default numba's (`NUMBA_NUM_THREADS`; one in a campaign's worker). Kernels release Python's lock.
    """
    count = config.NUMBA_NUM_THREADS if threads is None else threads
    if count == 1 or pixels < MIN_PIXELS:
        work(slice(0, pixels))
        return
    # parts begin where kernels begin a strip of pixels anyway
    size = -(-pixels // count // STRIP) * STRIP
    parts = [slice(first, min(first + size, pixels)) for first in range(0, pixels, size)]
    list(_pool(count).map(work, parts))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="pixels")


def keep_freed_memory() -> None:
    """Keep memory that pictures free for the next ones, where the C library is glibc: 4 % of a descent's case."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED_FROM_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def return_freed_memory() -> None:
    """Return freed memory to the system; without this the C library keeps some 1 MB a scene."""
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(0)
