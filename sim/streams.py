"""Named random streams: every dispersion and every instrument of every case has its own generator.

A stream is a pure function of (root seed, campaign name, case number, stream name). It does not depend on the order of
requests, on the worker or on other streams.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np


@lru_cache(maxsize=1024)
def hash_words(text: str) -> tuple[int, ...]:
    """Return 128 bits of the SHA-256 of a text as four words for the spawn key of `SeedSequence`."""
    digest = hashlib.sha256(text.encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))


def stream_key(campaign: str, case: int, name: str) -> tuple[int, ...]:
    """The spawn key of a stream: always nine words, so that no two keys coincide."""
    return (*hash_words(campaign), case, *hash_words(name))


@dataclass(frozen=True)
class Streams:
    """The random streams of one case, by the root seed and the name of its campaign and its number from zero."""

    seed: int
    campaign: str
    case: int

    def generator(self, name: str) -> np.random.Generator:
        """Return a new generator at the start of the named stream (of a dispersion or an instrument)."""
        key = stream_key(self.campaign, self.case, name)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))
