"""The descent camera: as designed, and as calibrated with errors."""

from __future__ import annotations

import numpy as np

from marsyard.scenarios.descent.parameters import CameraParameters
from marsyard.scenarios.optics import Optics, add_calibration_error
from marsyard.scenarios.optics import camera_optics as shared_optics
from marsyard.sim.camera import Cahv, Cahvor, CameraModel


def camera_optics(parameters: CameraParameters) -> Optics:
    """True camera in the body frame: at its origin, looking down, columns to the east at zero attitude."""
    model = parameters.model
    return shared_optics(_camera(parameters, 1.0, (0.0, 0.0), 0.0) if model is None else model.camera())


def calibrated_camera(parameters: CameraParameters, rng: np.random.Generator) -> CameraModel:
    """The true camera of `camera_optics` with drawn calibration errors."""
    p = parameters
    focal, column, row, distortion = rng.standard_normal(4)
    centre = (p.centre_error_px * float(column), p.centre_error_px * float(row))
    focal_error, corner_px = p.focal_error * focal, p.distortion_error_px * distortion
    if p.model is not None:
        return add_calibration_error(p.model.camera(), focal_error, centre, corner_px)
    return _camera(p, 1.0 + focal_error, centre, corner_px)


def _camera(p: CameraParameters, focal: float, centre_px: tuple[float, float], corner_px: float) -> Cahvor:
    """The camera with a factor on its focal length, a shift of its centre, and outward distortion of its corners."""
    middle = (0.5 * (p.columns - 1), 0.5 * (p.rows - 1))
    focal_px = p.focal_length_mm / (1e-3 * p.pixel_pitch_um)
    pinhole = Cahv.from_axes(
        (focal * focal_px, focal * focal_px),
        (p.columns, p.rows),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
        image_centre=(middle[0] + centre_px[0], middle[1] + centre_px[1]),
    )
    # CAHVOR moves a point at the angle a from the axis outwards by (R0 + R1 tan(a)^2 + ...) of its distance
    corner = float(np.hypot(*middle))
    radial_1 = p.radial_1 + corner_px / corner / (corner / focal_px) ** 2
    return Cahvor.from_cahv(pinhole, r=np.array([p.radial_0, radial_1, p.radial_2]))
