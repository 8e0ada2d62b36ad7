"""Camera optics (rays and lens fall-off), and calibrated cameras with the errors of their calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, cast

import numpy as np
from jaxtyping import Float32

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel
from marsyard.sim.parameters import Parameters, bounded
from marsyard.sim.render import PixelRays
from marsyard.sim.sensor import natural_fall_off


@dataclass(frozen=True)
class Optics:
    """A camera in the body frame, the rays of its pixels and the fall-off of its lens."""

    camera: CameraModel
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]


@lru_cache(maxsize=8)
def camera_optics(camera: CameraModel) -> Optics:
    """Return the cached optics of a camera in the body frame."""
    return Optics(camera, PixelRays.of(camera), natural_fall_off(camera))


class CalibrationParameters(Parameters):
    """Errors of the calibrated camera that an algorithm is given.

    Assumed: those of the descent camera's calibration, in pixels and as a fraction of the focal length.
    """

    focal_error: Annotated[float, bounded(0.0, 0.05, "RMS relative error of the calibrated focal length")] = 0.0002
    centre_error_px: Annotated[float, bounded(0.0, 50.0, "RMS error of the calibrated image centre per axis, px")] = 0.5
    distortion_error_px: Annotated[
        float, bounded(0.0, 50.0, "RMS error of the calibrated distortion in the picture's corners, px")
    ] = 0.3


def add_calibration_error(
    camera: CameraModel, focal_error: float, centre_error_px: tuple[float, float], distortion_error_px: float
) -> CameraModel:
    """Return a camera with errors of its calibration.

    - focal_error: relative error of the focal length
    - centre_error_px: error of the image centre, (columns, rows)
    - distortion_error_px: outward displacement of the corners
    """
    shifted = camera.magnified(1.0 + focal_error).recentred(*centre_error_px)
    if isinstance(shifted, Cahv):
        shifted = Cahvor.from_cahv(shifted, r=np.zeros(3))
    # R1 moves a point outwards by the cube of its angle
    corner = float(np.hypot(0.5 * (shifted.size[0] - 1), 0.5 * (shifted.size[1] - 1)))
    radial = cast(Cahvor | Cahvore, shifted)
    chi = corner / (shifted.focal_lengths[0] * (1.0 + float(radial.r[0])))
    return replace(radial, r=radial.r + np.array([0.0, distortion_error_px / shifted.focal_lengths[0] / chi**3, 0.0]))


def draw_calibrated(camera: CameraModel, p: CalibrationParameters, rng: np.random.Generator) -> CameraModel:
    """Draw a calibrated camera with normally distributed errors."""
    focal, column, row, distortion = rng.standard_normal(4)
    centre = (p.centre_error_px * float(column), p.centre_error_px * float(row))
    return add_calibration_error(camera, p.focal_error * focal, centre, p.distortion_error_px * distortion)
