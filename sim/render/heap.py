"""How the C library keeps the memory that pictures have freed: glibc's; elsewhere nothing is changed."""

from __future__ import annotations

import ctypes

#: Options of glibc's mallopt (malloc.h): size from which memory is asked of the system by itself, and size of what is
#: free at the end of the heap from which it goes back.
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1
#: Terrains are larger than the first and mapped, pictures smaller.
_MAPPED_FROM_BYTES = 32 << 20
_KEPT_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Keeps what pictures free for the next ones, as the system gives it page by page: 4 % of a descent's case."""
    adjust = getattr(ctypes.CDLL(None), "mallopt", None)
    if adjust is not None:
        adjust(_M_MMAP_THRESHOLD, _MAPPED_FROM_BYTES)
        adjust(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def return_freed_memory() -> None:
    """Gives the memory of the scenes before back to the system.

    A scene's large arrays come and go between small ones; without this the C library keeps some 1 MB a scene.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
