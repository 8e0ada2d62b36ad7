"""Stereo pair on the head of a mast: mounting, and calibration errors.

The true cameras are those of the design. The calibrated cameras differ by a common rotation of the pair on the head. In
addition, half of a relative rotation is applied to each camera (an error in disparity and perpendicular to the epipolar
lines), and each camera has a roll error and a focal length error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.error_sources import STEREO
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.mast import Degrees

Pixels = Annotated[float, Field(ge=0.0, le=50.0)]


class StereoCalibrationParameters(Parameters):
    """Calibration errors of a stereo pair; all except the disparity error are standard deviations."""

    disparity_error_px: Annotated[Pixels, STEREO, Field(description="limit of the uniform disparity error, px")] = 0.5
    epipolar_error_px: Annotated[Pixels, STEREO, Field(description="perpendicular to the epipolar lines, px")] = 0.2
    alignment_deg: Annotated[Degrees, STEREO, Field(description="alignment error of the pair per axis, deg")] = 0.05
    roll_deg: Annotated[Degrees, STEREO, Field(description="roll error of each camera, deg")] = 0.01
    focal_error: Annotated[float, STEREO, Field(ge=0.0, le=0.05, description="relative error of each focal length")] = (
        1e-4
    )


@dataclass(frozen=True)
class StereoHead:
    """A stereo pair on a mast: true cameras (the design) and calibrated cameras (flight software)."""

    true: MastCalibration
    calibrated: MastCalibration

    @classmethod
    def draw(cls, design: MastCalibration, p: StereoCalibrationParameters, rng: np.random.Generator) -> StereoHead:
        """Draw the calibration errors of a pair."""
        disparity = p.disparity_error_px * rng.uniform(-1.0, 1.0)
        epipolar = p.epipolar_error_px * rng.standard_normal()
        alignment = Rotation.from_rotvec(np.radians(p.alignment_deg) * rng.standard_normal(3))
        rolls = np.radians(p.roll_deg) * rng.standard_normal(2)
        focal = 1.0 + p.focal_error * rng.standard_normal(2)
        cameras = []
        for camera, side, roll, scale in zip((design.left, design.right), (0.5, -0.5), rolls, focal, strict=True):
            # a rotation of the camera to the right moves the image to the left
            fx, fy = camera.focal_lengths
            yaw, pitch = camera.down * (-side * disparity / fx), camera.right * (side * epipolar / fy)
            rotation = Rotation.from_rotvec(yaw + pitch + camera.a * roll)
            # rotate about the camera's centre of projection
            pose = rigid(rotation, camera.c - rotation.apply(camera.c.copy()))
            cameras.append(camera.magnify(float(scale)).transform(pose).transform(rigid(alignment, np.zeros(3))))
        return cls(design, replace(design, left=cameras[0], right=cameras[1]))

    def disparity_error_px(self, range_m: float) -> float:
        """Compute calibrated minus true disparity of a point at this range on the mean boresight of the pair."""
        disparities_px = []
        for mast in (self.calibrated, self.true):
            forward = mast.left.boresight() + mast.right.boresight()
            point = 0.5 * (mast.left.c + mast.right.c) + range_m * forward / np.linalg.norm(forward)
            disparities_px.append(float(mast.left.project(point)[0][0] - mast.right.project(point)[0][0]))
        return disparities_px[0] - disparities_px[1]


#: Rotation from a body whose camera looks along -z (columns along x) to a head looking along x (columns along -y).
_HEAD_FROM_DOWN = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))


def mount_on_head(
    left: CameraModel, right: CameraModel, baseline_m: float, toe_in_deg: float
) -> tuple[CameraModel, CameraModel]:
    """Mount two cameras that look along -z on a head, as a forward-looking stereo pair with toe-in."""

    def mount(camera: CameraModel, side: float) -> CameraModel:
        """Mount one camera; `side` is 1 for the left and -1 for the right camera."""
        toe_in = Rotation.from_rotvec([0.0, 0.0, -side * np.radians(toe_in_deg)])
        return camera.transform(rigid(toe_in * _HEAD_FROM_DOWN, np.array([0.0, 0.5 * side * baseline_m, 0.0])))

    return mount(left, 1.0), mount(right, -1.0)
