"""Named random streams: each dispersed parameter and each instrument of a case has its own random generator.

A stream is a pure function of (root seed, campaign name, case number, stream name). It does not depend on the order in
which streams are used, on the worker or on other streams.

A study of rare violations moves through the noise of cases in small steps: `Streams.blend` combines the streams of
several cases, so that the normal and uniform numbers change continuously with the weights, and keep their distribution.
"""

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri


@lru_cache(maxsize=1024)
def hash_words(text: str) -> tuple[int, ...]:
    """Return the first 128 bits of a text's SHA-256 hash as four 32-bit words for the spawn key of `SeedSequence`."""
    digest = hashlib.sha256(text.encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))


@cache
def _stream_names() -> Mapping[str, str]:
    """Read the names of streams that differ from those of their parameters."""
    names: dict[str, str] = tomllib.loads(Path(__file__).with_name("stream_names.toml").read_text(encoding="utf-8"))
    return names


def stream_name(path: str) -> str:
    """Return the name of the random stream of a dispersed parameter."""
    return _stream_names().get(path, path)


def stream_key(campaign: str, case: int, name: str) -> tuple[int, ...]:
    """Return the spawn key of a stream: nine integers."""
    return (*hash_words(campaign), case, *hash_words(name))


def substream(rng: np.random.Generator, name: str) -> np.random.Generator:
    """Derive a random generator from the seed of `rng` and a name.

    It does not depend on earlier draws or spawns from `rng`, and does not change `rng`. Raises TypeError if `rng` was
    not created from a `SeedSequence`.
    """
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        raise TypeError(f"the generator is seeded by {type(seed).__name__}; a SeedSequence is needed")
    key = (*seed.spawn_key, *hash_words(name))
    child = np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size)
    return np.random.Generator(np.random.PCG64(child))


#: Components of blended streams: numbers of cases and their weights, whose squares add up to 1; the newest is the last.
Blend = tuple[tuple[int, float], ...]
#: Maximum number of values of a draw that is blended. Larger draws, such as the noise of an image, are those of the
#: newest component.
MAX_BLENDED = 100_000
#: Smallest distance of a uniform number from 0 and 1 before its transformation to a normal number.
_MIN_TAIL = 1e-16


class BlendedGenerator(np.random.Generator):
    """Random generator whose normal numbers are weighted sums of those of several generators.

    The sum of independent standard normal numbers with weights whose squares add up to 1 is a standard normal number.
    Uniform numbers are transformed to normal numbers, summed, and transformed back. All other distributions, and draws
    of more than `MAX_BLENDED` values, are those of the newest generator alone.
    """

    def __init__(self, components: Sequence[tuple[np.random.Generator, float]]) -> None:
        *self._older, (newest, self._weight) = components
        super().__init__(newest.bit_generator)

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Draw standard normal numbers as `numpy.random.Generator`."""
        newest = super().standard_normal(size, dtype, out)
        if out is not None or np.size(newest) > MAX_BLENDED:
            return newest
        total = self._weight * newest
        for generator, weight in self._older:
            total = total + weight * generator.standard_normal(size)
        return total if np.ndim(total) == 0 else total.astype(dtype)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Draw normal numbers as `numpy.random.Generator`."""
        shape = (np.broadcast(loc, scale).shape or None) if size is None else size
        return loc + scale * self.standard_normal(shape)

    def random(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Draw uniform numbers from 0 to 1 as `numpy.random.Generator`."""
        newest = super().random(size, dtype, out)
        if out is not None or np.size(newest) > MAX_BLENDED:
            return newest
        total = self._weight * _to_normal(newest)
        for generator, weight in self._older:
            total = total + weight * _to_normal(generator.random(size))
        uniform = np.minimum(ndtr(total), 1.0 - _MIN_TAIL)
        return float(uniform) if np.ndim(uniform) == 0 else uniform.astype(dtype)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Draw uniform numbers from `low` to `high` as `numpy.random.Generator`."""
        shape = (np.broadcast(low, high).shape or None) if size is None else size
        return low + (np.asarray(high) - low) * self.random(shape)


def _to_normal(uniform: Any) -> Any:
    return ndtri(np.clip(uniform, _MIN_TAIL, 1.0 - _MIN_TAIL))


@dataclass(frozen=True)
class Streams:
    """Random streams of one case: root seed and name of the campaign, and number of the case, counted from zero.

    blend: components of blended streams, of which `case` is the newest; empty for the streams of the case alone
    """

    seed: int
    campaign: str
    case: int
    blend: Blend = ()

    def generator(self, name: str) -> np.random.Generator:
        """Return a new generator at the start of the stream with this name."""
        if len(self.blend) > 1:
            return BlendedGenerator([(self._component(case, name), weight) for case, weight in self.blend])
        return self._component(self.case, name)

    def _component(self, case: int, name: str) -> np.random.Generator:
        key = stream_key(self.campaign, case, name)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))
