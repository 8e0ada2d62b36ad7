"""Values of the columns that several scenarios have: sun, contrast, attitude, and provenance of images.

`marsyard.scenarios.common_columns` declares the columns.
"""

import hashlib
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt16

from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.sensor import DetectorParameters

#: Side of the image of which the local contrast is computed, pixels, as in DIMES; and side of its blocks.
SIDE_PX, BLOCK_PX = 256, 16


class LocalContrast(NamedTuple):
    """Percentiles over the blocks of an image of the local contrast: standard deviation / mean of a block."""

    p10: float
    median: float
    p90: float


def sun_columns(direction: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Return the sun's azimuth, clockwise from north, and elevation from its direction in world axes."""
    return {
        "sun_azimuth_deg": float(np.degrees(np.arctan2(direction[0], direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(direction[2], -1.0, 1.0)))),
    }


def contrast_columns(image: UInt16[np.ndarray, "rows columns"], detector: DetectorParameters) -> dict[str, Scalar]:
    """Return the median of a delivered image's local contrast, and its 90 % quantile divided by its 10 % quantile.

    `local_contrast` defines the contrast; the quotient is NaN if the 10 % quantile is 0.
    """
    contrast = local_contrast(np.maximum(image - detector.offset_dn, 0.0))
    patchiness = contrast.p90 / contrast.p10 if contrast.p10 > 0.0 else np.nan
    return {"image_contrast": contrast.median, "image_patchiness": patchiness}


def local_contrast(image: Float[np.ndarray, "rows columns"]) -> LocalContrast:
    """Compute the local contrast of an image, which is resized to `SIDE_PX` x `SIDE_PX` pixels first.

    The result is NaN if all blocks are black.
    """
    small = cv2.resize(np.asarray(image, dtype=np.float64), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    blocks = small.reshape(SIDE_PX // BLOCK_PX, BLOCK_PX, SIDE_PX // BLOCK_PX, BLOCK_PX)
    deviation, mean = blocks.std(axis=(1, 3)), blocks.mean(axis=(1, 3))
    if not np.any(mean > 0.0):
        return LocalContrast(np.nan, np.nan, np.nan)
    p10, p50, p90 = np.percentile(deviation[mean > 0.0] / mean[mean > 0.0], [10.0, 50.0, 90.0])
    return LocalContrast(float(p10), float(p50), float(p90))


def off_nadir_deg(state: State) -> float:
    """Return the angle between the body's camera axis and nadir."""
    # the camera looks along -z of the body; the element is the cosine of the angle between the z axes of body and world
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))


def attitude_rate_deg_s(state: State) -> float:
    """Return the magnitude of the body rate."""
    return float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))


def hash_images(images: Iterable[UInt16[np.ndarray, "rows columns"]]) -> str:
    """Compute the SHA-256 of the counts of images."""
    return hashlib.sha256(b"".join(counts.tobytes() for counts in images)).hexdigest()


def image_columns(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """Return the provenance columns of images rendered by a backend."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }
