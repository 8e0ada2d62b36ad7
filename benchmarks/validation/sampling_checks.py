"""Check of random streams: the seeds of ten million streams differ from each other.

NumPy's `SeedSequence` computes one seed per call; this module contains a vectorised version of its algorithm.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.sim.streams import stream_key

#: Constants INIT_A, MULT_A, MIX_MULT_L, MIX_MULT_R and XSHIFT of NumPy's `SeedSequence`
#: (numpy/random/bit_generator.pyx), whose algorithm is fixed.
_INITIAL_CONSTANT, _MULTIPLIER, _MIX_LEFT, _MIX_RIGHT, _SHIFT_BITS = 0x43B0D7E5, 0x931E8875, 0xCA01F9DD, 0x4973F715, 16
#: Number of 32-bit words of an entropy pool of `SeedSequence`, from which a generator is seeded.
_POOL_WORDS = 4
#: Mask of the lower 32 bits.
_MASK = 2**32 - 1

#: Numbers of campaigns, and of cases per campaign: with 20 streams per case, ten million streams.
CAMPAIGNS, CASES = 25, 20_000


class _Hash:
    """Hash function of `SeedSequence` for arrays of words; it changes its constant at every call."""

    def __init__(self) -> None:
        self._constant = _INITIAL_CONSTANT

    def __call__(self, value: np.ndarray) -> np.ndarray:
        word = value ^ np.uint32(self._constant)
        self._constant = self._constant * _MULTIPLIER & _MASK
        word = word * np.uint32(self._constant)
        return word ^ (word >> np.uint32(_SHIFT_BITS))


def _mix(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Combine two words of the pool, as in `SeedSequence`."""
    result = np.asarray(np.uint32(_MIX_LEFT) * x - np.uint32(_MIX_RIGHT) * y, dtype=np.uint32)
    return result ^ (result >> np.uint32(_SHIFT_BITS))


def seeds(words: np.ndarray) -> np.ndarray:
    """Compute the 128-bit pools of `SeedSequence` for many entropies.

    The initial state of a generator is a bijection of the pool. Two streams are equal only if their pools are equal.

    - words: entropy, (sequences, words) of uint32: words of the root seed, padded to four, then of the spawn key
    - returns: pools, (sequences, 2) of uint64
    """
    hash_word = _Hash()
    pool = [hash_word(words[:, index]) for index in range(_POOL_WORDS)]
    for source in range(_POOL_WORDS):
        for target in range(_POOL_WORDS):
            if source != target:
                pool[target] = _mix(pool[target], hash_word(pool[source]))
    for source in range(_POOL_WORDS, words.shape[1]):
        for target in range(_POOL_WORDS):
            pool[target] = _mix(pool[target], hash_word(words[:, source]))
    return np.ascontiguousarray(np.stack(pool, axis=1)).view(np.uint64)


def stream_words(seed: int, campaign: str, cases: np.ndarray, name: str) -> np.ndarray:
    """Return the entropy of one stream for many cases, in the layout of `seeds`."""
    root_words = [seed & _MASK, seed >> 32, 0, 0]
    key = list(stream_key(campaign, 0, name))
    words = np.tile(np.array([*root_words, *key], dtype=np.uint32), (cases.size, 1))
    # the spawn key consists of four words of the campaign's name, the case, and four words of the stream's name
    words[:, _POOL_WORDS + 4] = cases
    return words


def list_stream_names() -> list[str]:
    """Return the names of twenty streams: 14 of dispersions, and 6 of instruments and events of a descent."""
    dispersions = [f"dispersion:{path}" for path in load_campaign("dimes-gusev").drawn_paths]
    return [*dispersions[:14], "altimeter", "detector noise", "gusts", "image clock", "inertial unit", "landing"]


def all_seeds(campaigns: int, cases: int, names: Sequence[str]) -> np.ndarray:
    """Compute the seeds of the streams `names` of all cases, as in `seeds`.

    The campaigns have two names in turn. Two successive campaigns have the same root seed: 0, 0, 1, 1, ...
    """
    numbers = np.arange(cases)
    return np.concatenate(
        [
            seeds(stream_words(index // 2, ("dimes-gusev", "dimes-meridiani")[index % 2], numbers, name))
            for index in range(campaigns)
            for name in names
        ]
    )


def collisions(pools: np.ndarray) -> int:
    """Count rows that are equal to an earlier row."""
    order = np.lexsort((pools[:, 1], pools[:, 0]))
    return int(np.all(pools[order[1:]] == pools[order[:-1]], axis=1).sum())


def run_streams(quick: bool) -> Iterator[Measure]:
    """Count equal seeds of successive campaigns, cases and streams."""
    names = list_stream_names()
    pools = all_seeds(CAMPAIGNS // 5 if quick else CAMPAIGNS, CASES // 10 if quick else CASES, names)
    how = f"{len(pools):,} streams: {len(names)} names, cases from 0, root seeds from 0, two campaigns; 128-bit seeds"
    yield Measure("pairs of random streams with equal seeds", collisions(pools), "pairs", 0.0, how)


CHECKS = (Check("streams", "Random streams", run_streams),)
