"""Named random streams: each dispersed parameter and each instrument of a case has its own random generator.

A stream is a pure function of (root seed, campaign name, case number, stream name). It does not depend on the order in
which streams are used, on the worker or on other streams.

A study of rare violations moves through the noise of cases in small steps: `Streams.blend` combines the streams of
several cases, so that the normal and uniform numbers change continuously with the weights, and keep their distribution.
"""

import hashlib
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr


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


class BlendedGenerator(np.random.Generator):
    """Random generator whose normal and uniform numbers are those of blended components.

    A component is the sequence of the standard normal numbers of a generator. The k-th normal number of the blend is
    the weighted sum of the k-th numbers of all components; with weights whose squares add up to 1, it is standard
    normal. A uniform number is the distribution function at the next normal number. Nothing else draws from the
    components, so that a component has the same numbers in each blend, for any other draws of a case. All other
    distributions, and draws of more than `MAX_BLENDED` values, have a stream of their own, that of the newest
    component.
    """

    def __init__(self, components: Sequence[tuple[np.random.Generator, float]]) -> None:
        self._components = components
        newest, _ = components[-1]
        super().__init__(substream(newest, "draws that are not blended").bit_generator)

    def spawn(self, n_children: int) -> list[np.random.Generator]:
        """Create generators of other streams, which are not blended, as `numpy.random.Generator`."""
        return np.random.Generator(self.bit_generator).spawn(n_children)

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Draw standard normal numbers as `numpy.random.Generator`."""
        if out is not None or not _is_blended(size):
            return super().standard_normal(size, dtype, out)
        total = sum(weight * generator.standard_normal(size) for generator, weight in self._components)
        return total if np.ndim(total) == 0 else np.asarray(total, dtype)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Draw normal numbers as `numpy.random.Generator`."""
        shape = (np.broadcast(loc, scale).shape or None) if size is None else size
        return loc + scale * self.standard_normal(shape)

    def random(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Draw uniform numbers from 0 to 1 as `numpy.random.Generator`."""
        if out is not None or not _is_blended(size):
            return super().random(size, dtype, out)
        uniform = np.asarray(ndtr(self.standard_normal(size)), dtype)
        below_1 = np.minimum(uniform, np.nextafter(uniform.dtype.type(1.0), uniform.dtype.type(0.0)))
        return float(below_1) if np.ndim(below_1) == 0 else below_1

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Draw uniform numbers from `low` to `high` as `numpy.random.Generator`."""
        shape = (np.broadcast(low, high).shape or None) if size is None else size
        return low + (np.asarray(high) - low) * self.random(shape)


def _is_blended(size: Any) -> bool:
    """Whether a draw of this size is blended."""
    return size is None or math.prod(np.atleast_1d(size).tolist()) <= MAX_BLENDED


@dataclass(frozen=True)
class Streams:
    """Random streams of one case: root seed and name of the campaign, and number of the case, counted from zero.

    blend: components of blended streams, of which `case` is the newest; empty for streams that are never blended
    """

    seed: int
    campaign: str
    case: int
    blend: Blend = ()

    def generator(self, name: str) -> np.random.Generator:
        """Return a new generator at the start of the stream with this name."""
        if self.blend:
            return BlendedGenerator([(self._component(case, name), weight) for case, weight in self.blend])
        return self._component(self.case, name)

    def _component(self, case: int, name: str) -> np.random.Generator:
        key = stream_key(self.campaign, case, name)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))
