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


def select_middle_rows(rows_summed: int) -> slice:
    """Select the rendered row in the middle of each group of summed rows: it represents the truth of an image row."""
    return slice(rows_summed // 2, None, rows_summed)


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
        range_m=frame.range_m[rows].astype(np.float32),
        normal=frame.normal[rows],
        rocks=(frame.body[rows] >= 0).astype(np.uint8),
        hazard=hazard,
        camera=camera,
        metadata=metadata,
    )
