"""Named random streams: each dispersed parameter and each instrument of a case has its own random generator.

A stream is a pure function of (root seed, campaign name, case number, stream name). It does not depend on the order in
which streams are used, on the worker or on other streams.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np


@lru_cache(maxsize=1024)
def hash_words(text: str) -> tuple[int, ...]:
    """Return the first 128 bits of a text's SHA-256 hash as four 32-bit words for the spawn key of `SeedSequence`."""
    digest = hashlib.sha256(text.encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))


def stream_key(campaign: str, case: int, name: str) -> tuple[int, ...]:
    """Return the spawn key of a stream: nine integers."""
    return (*hash_words(campaign), case, *hash_words(name))


@dataclass(frozen=True)
class Streams:
    """Random streams of one case: root seed and name of the campaign, and number of the case, counted from zero."""

    seed: int
    campaign: str
    case: int

    def generator(self, name: str) -> np.random.Generator:
        """Return a new generator at the start of the stream with this name."""
        key = stream_key(self.campaign, self.case, name)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))
