"""Cameras of cases: the optics of the true camera, and the errors of the calibrated camera of an algorithm."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, cast

import numpy as np
from jaxtyping import Float32

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel
from marsyard.sim.error_sources import CALIBRATION
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.render import PixelRays
from marsyard.sim.sensor import natural_fall_off


@dataclass(frozen=True)
class Optics:
    """A camera in the body frame, the rays of its pixels and the relative illumination (fall-off) of its lens."""

    camera: CameraModel
    rays: PixelRays
    fall_off: Float32[np.ndarray, "rows columns"]


@lru_cache(maxsize=8)
def camera_optics(camera: CameraModel) -> Optics:
    """Return the cached optics of a camera in the body frame."""
    return Optics(camera, PixelRays.from_camera(camera), natural_fall_off(camera))


class CalibrationParameters(Parameters):
    """Errors of the calibrated camera that an algorithm receives.

    The values of the descent camera are assumed for all cameras.
    """

    focal_error: Annotated[
        float, CALIBRATION, bounded_field(0.0, 0.05, "RMS relative error of the calibrated focal length")
    ] = 0.0002
    centre_error_px: Annotated[
        float, CALIBRATION, bounded_field(0.0, 50.0, "RMS error of the calibrated image centre per axis, px")
    ] = 0.5
    distortion_error_px: Annotated[
        float, CALIBRATION, bounded_field(0.0, 50.0, "RMS error of the calibrated distortion in the image corners, px")
    ] = 0.3


def draw_calibrated(camera: CameraModel, p: CalibrationParameters, rng: np.random.Generator) -> CameraModel:
    """Return a camera with normally distributed calibration errors; that of the distortion moves corners outwards."""
    focal, column, row, distortion = rng.standard_normal(4)
    magnified = camera.magnify(1.0 + p.focal_error * focal)
    recentred = magnified.recentre(p.centre_error_px * float(column), p.centre_error_px * float(row))
    if isinstance(recentred, Cahv):
        recentred = Cahvor.from_cahv(recentred, r=np.zeros(3))
    # R1 displaces a point outwards by R1 chi^3; chi is the radial coordinate of its ray (`marsyard.sim.camera.models`)
    corner_px = 0.5 * float(np.hypot(recentred.size[0] - 1, recentred.size[1] - 1))
    radial = cast(Cahvor | Cahvore, recentred)
    focal_px = recentred.focal_lengths[0]
    chi = corner_px / (focal_px * (1.0 + float(radial.r[0])))
    displacement = p.distortion_error_px * distortion / focal_px
    return replace(radial, r=radial.r + np.array([0.0, displacement / chi**3, 0.0]))
