"""Images with the truth of each pixel, to train and test learned methods (`marsyard dataset`)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from pydantic import BaseModel

from marsyard.sim.camera import CameraModel
from marsyard.sim.render import Frame
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class ImageSample:
    """An image and the truth of each pixel.

    With summed rows, normal, rocks and hazard are those of a rendered row at most half a rendered row from the pixel's
    centre (`select_middle_rows`).

    - image: counts of `bits` bits, as delivered
    - range_m: distance along the pixel's ray to the surface; infinite for the sky
    - normal: unit normal of the surface, world axes
    - rocks: 1 for a rock or another object, 0 for ground
    - hazard: footprint hazard of a lander: 0 safe, 1 hazard, 255 not completely visible; None without a lander
    - camera: camera in body axes
    - metadata: pose, sun and other values that JSON can store
    """

    image: UInt16[np.ndarray, "rows columns"]
    bits: int
    range_m: Float32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    rocks: UInt8[np.ndarray, "rows columns"]
    hazard: UInt8[np.ndarray, "rows columns"] | None
    camera: CameraModel
    metadata: Mapping[str, Any]


#: Maximum relative difference between the ranges of two rendered rows that see the same surface (assumed). Rows of the
#: descent camera are 0.82 mrad apart: on one surface they differ by less, up to an incidence of 87.6 deg. The mean of
#: two surfaces that differ by less is wrong by at most 1 %.
_MAX_RANGE_STEP = 0.02


def select_middle_rows(rows_summed: int) -> slice:
    """Select the rendered row in the middle of each group of summed rows, or the lower of both middle rows."""
    return slice(rows_summed // 2, None, rows_summed)


def interpolate_range(frame: Frame, rows_summed: int) -> Float32[np.ndarray, "rows columns"]:
    """Compute the range at the centre of each delivered pixel: of even numbers, the mean of both middle rows.

    Where the two rows see different surfaces, the range is that of the lower row.
    """
    below = frame.range_m[rows_summed // 2 :: rows_summed]
    above = frame.range_m[(rows_summed - 1) // 2 :: rows_summed]
    with np.errstate(invalid="ignore"):  # sky in both rows
        is_same_surface = np.abs(below - above) < _MAX_RANGE_STEP * below
    return np.where(is_same_surface, 0.5 * (below + above), below).astype(np.float32)


@runtime_checkable
class ProvidesSamples(Protocol):
    """A scenario that provides images with ground truth, to train and test learned methods."""

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[ImageSample]:
        """Yield the images of one case that `run` passes to its algorithms."""


def pixel_sample(
    counts: UInt16[np.ndarray, "rows columns"],
    frame: Frame,
    detector: DetectorParameters,
    camera: CameraModel,
    metadata: Mapping[str, Any],
    hazard: UInt8[np.ndarray, "rows columns"] | None = None,
) -> ImageSample:
    """Assemble an image and the truth of its pixels; `camera` is that of the delivered image."""
    rows = select_middle_rows(detector.rows_summed)
    return ImageSample(
        image=counts,
        bits=detector.bits,
        range_m=interpolate_range(frame, detector.rows_summed),
        normal=frame.normal[rows],
        rocks=(frame.body[rows] >= 0).astype(np.uint8),
        hazard=hazard,
        camera=camera,
        metadata=metadata,
    )
