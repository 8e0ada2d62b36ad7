"""Samples for learning: pictures with the truth of their pixels."""

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
    """A picture and the truth of each pixel.

    - image: counts of `bits` bits, as delivered
    - range_m: distance along the pixel's ray to the surface; infinite for the sky
    - normal: unit normal of the surface, world axes
    - rocks: 1 for a rock or another body, 0 for ground
    - hazard: footprint hazard of a lander: 0 safe, 1 hazard, 255 not completely visible; None without a lander
    - camera: in the body's axes
    - about: pose, sun and other metadata; plain data
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
    """Select the frame's rows with the truth of a picture's rows: the middle one of each that are summed."""
    return slice(rows_summed // 2, None, rows_summed)


@runtime_checkable
class GivesSamples(Protocol):
    """A scenario that provides samples for learning."""

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """Yield the pictures of one case that `run` gives to its algorithms."""
        ...
