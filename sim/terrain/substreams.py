"""Named random substreams: each part of a terrain draws from its own, so that adding one changes no other."""

from __future__ import annotations

import hashlib

import numpy as np


def substream(rng: np.random.Generator, name: str) -> np.random.Generator:
    """The stream of this name below the one that `rng` was seeded with.

    It depends on the seed of `rng` and on the name alone, neither on what has been drawn or spawned from `rng` nor on
    the order in which substreams are asked for; `rng` is left as it is. Raises TypeError for a generator that was not
    made from a `SeedSequence`.
    """
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        raise TypeError(f"a generator seeded by a SeedSequence is needed, not by {type(seed).__name__}")
    digest = hashlib.sha256(name.encode()).digest()
    words = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    below = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *words), pool_size=seed.pool_size)
    return np.random.Generator(np.random.PCG64(below))
