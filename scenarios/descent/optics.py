"""The descent camera: as designed, and as it truly is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
from jaxtyping import Float64

from scenarios.descent.parameters import CameraParameters
from scenarios.optics import Optics
from sim.camera import Cahv, Cahvor, Cahvore, CameraModel


@cache
def camera_optics(parameters: CameraParameters) -> Optics:
    """The descent camera in the body frame: at its origin, looking down, columns to the east at zero attitude."""
    if parameters.model is not None:
        return Optics.of(parameters.model.camera())
    return Optics.of(_camera(parameters, 1.0, (0.0, 0.0), 0.0))


def calibrated_camera(parameters: CameraParameters, rng: np.random.Generator) -> CameraModel:
    """The camera as calibrated: that of `camera_optics`, which is the true one, with the calibration's errors."""
    p = parameters
    focal, column, row, distortion = rng.standard_normal(4)
    if p.model is not None:
        moved = p.centre_error_px * np.array([column, row])
        camera = p.model.camera().magnified(1.0 + p.focal_error * focal).recentred(float(moved[0]), float(moved[1]))
        return _bent(camera, p.distortion_error_px * distortion)
    return _camera(
        p, 1.0 + p.focal_error * focal, p.centre_error_px * np.array([column, row]), p.distortion_error_px * distortion
    )


def _bent(camera: CameraModel, corner_px: float) -> CameraModel:
    """The camera with its corners moved outwards by distortion, whatever its lens: R1 moves by chi^3."""
    if isinstance(camera, Cahv):
        camera = Cahvor.from_cahv(camera, r=np.zeros(3))
    corner = float(np.hypot(0.5 * (camera.size[0] - 1), 0.5 * (camera.size[1] - 1)))
    radial = cast(Cahvor | Cahvore, camera)
    chi = corner / (camera.focal_lengths[0] * (1.0 + float(radial.r[0])))
    return replace(radial, r=radial.r + np.array([0.0, corner_px / camera.focal_lengths[0] / chi**3, 0.0]))


def _camera(
    p: CameraParameters, focal: float, centre_px: Float64[np.ndarray, "2"] | tuple[float, float], corner_px: float
) -> Cahvor:
    """The camera with its focal length scaled, its centre moved, and its corners moved outwards by distortion."""
    middle = (0.5 * (p.columns - 1), 0.5 * (p.rows - 1))
    focal_px = p.focal_length_mm / (1e-3 * p.pixel_pitch_um)
    pinhole = Cahv.from_axes(
        (focal * focal_px, focal * focal_px),
        (p.columns, p.rows),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
        image_centre=(middle[0] + float(centre_px[0]), middle[1] + float(centre_px[1])),
    )
    # CAHVOR moves a point at the angle a from the axis outwards by (R0 + R1 tan(a)^2 + ...) of its distance
    corner = float(np.hypot(*middle))
    radial_1 = p.radial_1 + corner_px / corner / (corner / focal_px) ** 2
    return Cahvor.from_cahv(pinhole, r=np.array([p.radial_0, radial_1, p.radial_2]))
