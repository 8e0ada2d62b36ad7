"""Named random streams: every dispersion and every instrument of every case draws from its own generator.

A stream is a pure function of (root seed, campaign name, case number, stream name). Neither the order in which streams
are asked for, nor the worker that asks, nor the streams that others ask for, changes what it delivers.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np


@lru_cache(maxsize=1024)
def _words(text: str) -> tuple[int, int, int, int]:
    """128 bits of the SHA-256 of a text as four words, the form that `SeedSequence` takes in its spawn key."""
    digest = hashlib.sha256(text.encode()).digest()
    first, second, third, fourth = (int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return first, second, third, fourth


def stream_key(campaign: str, case: int, name: str) -> tuple[int, ...]:
    """The spawn key of a stream: nine words, so that no two keys run together."""
    return (*_words(campaign), case, *_words(name))


@dataclass(frozen=True)
class Streams:
    """The random streams of one case.

    Parameters
    ----------
    seed
        The campaign's root seed, a non-negative integer.
    campaign
        The campaign's name.
    case
        The case's number, counted from zero.
    """

    seed: int
    campaign: str
    case: int

    def generator(self, name: str) -> np.random.Generator:
        """A fresh generator at the start of the stream of this name (a dispersion's or an instrument's)."""
        key = stream_key(self.campaign, self.case, name)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))
