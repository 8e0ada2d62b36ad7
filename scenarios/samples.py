"""Pictures with the truth of their pixels, for learning: what scenarios that have it give, sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from pydantic import BaseModel

from marsyard.sim.camera import CameraModel
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Sample:
    """A picture and what is true of each of its pixels.

    Attributes
    ----------
    image
        Counts as delivered, of `bits` bits.
    bits
        Of a count.
    range_m
        Distance along the pixel's ray to what it sees; infinite for the sky.
    normal
        Unit normal of the surface seen, world axes.
    rocks
        1 where the pixel sees a rock or another body, 0 where ground.
    hazard
        What a lander would stand on there: 0 safe, 1 not, 255 not all in sight; None where no lander is asked about.
    camera
        In the body's axes.
    about
        The pose, the sun, and whatever else is to be told; plain data.
    """

    image: UInt16[np.ndarray, "rows columns"]
    bits: int
    range_m: Float32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    rocks: UInt8[np.ndarray, "rows columns"]
    hazard: UInt8[np.ndarray, "rows columns"] | None
    camera: CameraModel
    about: Mapping[str, Any]


def summed_rows(rows_summed: int) -> slice:
    """The rows of a frame whose truth stands for that of a picture's rows: the middle one of each that are summed."""
    return slice(rows_summed // 2, None, rows_summed)


@runtime_checkable
class GivesSamples(Protocol):
    """A scenario whose cases are pictures to learn from."""

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """The pictures of one case, those that `run` gives to its algorithms."""
        ...
