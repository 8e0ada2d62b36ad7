"""Pan-tilt mast of a rover with a stereo pair on its head: pointing errors, mounting and calibration errors.

Pointing: each axis has a motor with an encoder, and gears with backlash b. The motor stops near the command; the
encoder measures its angle in whole counts. The axis follows the motor within half the backlash (play operator:
``axis = clip(axis, motor - b/2, motor + b/2)``): after a long move it lags by half the backlash, and in a reversal
shorter than the backlash it does not move. The true angle is the axis angle minus a zero error of the encoder, which is
constant in a run. Flight software receives the readings of the encoders.

Calibration: the true cameras are those of the design. The calibrated cameras differ by a common rotation of the pair on
the head. In addition, half of a relative rotation is applied to each camera (an error in disparity and perpendicular to
the epipolar lines), and each camera has a roll error and a focal length error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.error_sources import POINTING, STEREO
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration, MastGeometry
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.sensor.presets import preset

Degrees = Annotated[float, Field(ge=0.0, le=10.0)]
Angles = Float64[np.ndarray, "2"]  #: Azimuth and elevation.

#: MER mast: azimuth axis at (0.457, -0.026) m; the elevation axis intersects it 1.096 m above the rover frame of the
#: labels, which is 0.29 m above the ground (Opportunity's PDS labels 1N491020376 and 1N491020519; Maki et al. 2003:
#: navcams 1.54 m above the ground). The navcams are 0.155 m above the elevation axis, 0.013 m to its right.
MER_MAST = MastGeometry(
    base_m=np.array([0.457, -0.026, 1.386]),
    elbow_m=np.zeros(3),
    head_m=np.array([0.0, -0.013, 0.155]),
    elevation_limits_rad=(float(np.radians(-87.0)), float(np.radians(87.0))),
)
#: Mast of the research rover, with cameras at about 1.5 m; all values assumed.
RESEARCH_MAST = MastGeometry(
    base_m=np.array([0.25, 0.0, 1.0]),
    elbow_m=np.array([0.0, 0.0, 0.45]),
    head_m=np.array([0.06, 0.0, 0.05]),
    elevation_limits_rad=(float(np.radians(-80.0)), float(np.radians(80.0))),
)
#: Masts of stereo pairs by camera preset.
MASTS = {"mer-navcam": MER_MAST, "research-navcam": RESEARCH_MAST, "research-pancam": RESEARCH_MAST}


class PointingParameters(Parameters):
    """Pointing errors of a mast, the same for both axes; zero error and settling error are standard deviations.

    Requested and measured angles differ by 0.0004 to 0.015 deg in the labels of two Opportunity navcam images;
    the other values are assumed.
    """

    zero_deg: Annotated[
        Degrees, POINTING, Field(description="zero offset of the mast's encoders, constant in a run, deg")
    ] = 0.1
    backlash_deg: Annotated[Degrees, POINTING, Field(description="full width of the backlash, deg")] = 0.1
    settling_deg: Annotated[Degrees, POINTING, Field(description="motor stop minus command, deg")] = 0.01
    count_deg: Annotated[Degrees, POINTING, Field(description="encoder resolution, deg; 0: no rounding")] = 0.005


@dataclass(frozen=True)
class MastState:
    """Pointing of a mast at one time.

    - readings_rad, true_rad: encoder readings and true angles; azimuth and elevation
    - axes_rad: angles of both axes, without the zero errors of the encoders
    """

    readings_rad: tuple[float, float]
    true_rad: tuple[float, float]
    axes_rad: Angles


@dataclass(frozen=True)
class Mast:
    """A mast with the errors of one run.

    - geometry: dimensions of the mast, known without error
    - zeros_rad: zero errors of the azimuth and elevation encoders, subtracted from the axis angles
    """

    parameters: PointingParameters
    geometry: MastGeometry
    zeros_rad: Angles

    @classmethod
    def draw(cls, parameters: PointingParameters, geometry: MastGeometry, rng: np.random.Generator) -> Mast:
        """Draw the errors of a run."""
        return cls(parameters, geometry, np.radians(parameters.zero_deg) * rng.standard_normal(2))

    @property
    def rest(self) -> MastState:
        """State at azimuth and elevation zero, with the axes in the middle of the backlash."""
        return self._create_state(np.zeros(2), np.zeros(2))

    def point(self, state: MastState, azimuth_rad: float, elevation_rad: float, rng: np.random.Generator) -> MastState:
        """Move the mast to commanded angles (see `MastGeometry`) within its limits; `rng` draws the motor stops."""
        p, g = self.parameters, self.geometry
        lower, upper = np.array([g.azimuth_limits_rad, g.elevation_limits_rad]).T
        settling_errors = np.radians(p.settling_deg) * rng.standard_normal(2)
        motors = np.clip(np.clip(np.array([azimuth_rad, elevation_rad]), lower, upper) + settling_errors, lower, upper)
        half_backlash = 0.5 * np.radians(p.backlash_deg)
        return self._create_state(motors, np.clip(state.axes_rad, motors - half_backlash, motors + half_backlash))

    def rover_from_head(self, state: MastState) -> RigidTransform:
        """Return the true pose of the head in the rover frame."""
        return self.geometry.rover_from_head(*state.true_rad)

    def _create_state(self, motors_rad: Angles, axes_rad: Angles) -> MastState:
        """Create the state for angles of motors and axes, with encoder readings in whole counts."""
        count = np.radians(self.parameters.count_deg)
        readings = count * np.rint(motors_rad / count) if count > 0.0 else motors_rad
        true_angles = axes_rad - self.zeros_rad
        measured_pair, true_pair = ((float(angles[0]), float(angles[1])) for angles in (readings, true_angles))
        return MastState(measured_pair, true_pair, axes_rad)


def stereo_mast(name: str) -> MastCalibration:
    """Return the design of a mast and its stereo pair by camera preset (`MASTS`). Raises ValueError if unknown."""
    if name not in MASTS:
        raise ValueError(f"no mast has the camera preset {name!r}; allowed: {', '.join(MASTS)}")
    left, right = preset(name).cameras()
    return MastCalibration(MASTS[name], left, right)


Pixels = Annotated[float, Field(ge=0.0, le=50.0)]


class StereoCalibrationParameters(Parameters):
    """Calibration errors of a stereo pair; all except the two of the disparity are standard deviations."""

    disparity_error_px: Annotated[Pixels, STEREO, Field(description="limit of the uniform disparity error, px")] = 0.5
    disparity_offset_px: Annotated[
        float, STEREO, bounded_field(-50.0, 50.0, "disparity error that is added to the uniform one, px")
    ] = 0.0
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
        disparity = p.disparity_offset_px + p.disparity_error_px * rng.uniform(-1.0, 1.0)
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
