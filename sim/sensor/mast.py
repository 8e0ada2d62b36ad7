"""A mast that points a stereo pair: by how much it misses, and by how much its calibration is wrong.

Pointing. Each axis has a motor with an encoder and, after it, gears with backlash. The motor stops near the command;
the encoder reads it in whole counts. The axis follows the motor within the backlash's half to either side (the play
operator: ``axis = clip(axis, motor - b/2, motor + b/2)``), so that it lags behind by half of it after a long move and
stays where it is in a reversal shorter than the backlash. The true angle is the axis' less an error of the encoder's
zero that is fixed to a run. Flight software gets the encoders' readings.

Calibration. The true cameras are those of the design; the calibrated ones differ from them by what a calibration is
wrong by: both by a common rotation (the pair on its head), and each by half a rotation of the pair against itself that
shows as an error of disparity or across the epipolar lines, by a roll and by its focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration, MastGeometry
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.presets import preset

Degrees = Annotated[float, Field(ge=0.0, le=10.0)]
Pixels = Annotated[float, Field(ge=0.0, le=50.0)]

#: MER's mast: it turns about (0.457, -0.026) m, and its elevation axis crosses that at 1.096 m above the rover frame of
#: its labels, which lies 0.29 m above the ground (Opportunity's PDS labels 1N491020376 and 1N491020519; Maki et al.
#: 2003: navcams 1.54 m above the ground). The navcams are 0.155 m above the elevation axis, 0.013 m to its right.
MER_MAST = MastGeometry(
    base_m=np.array([0.457, -0.026, 1.386]),
    elbow_m=np.zeros(3),
    head_m=np.array([0.0, -0.013, 0.155]),
    elevation_limits_rad=(float(np.radians(-87.0)), float(np.radians(87.0))),
)
#: The research rover's mast, with cameras at about 1.5 m: all assumed.
RESEARCH_MAST = MastGeometry(
    base_m=np.array([0.25, 0.0, 1.0]),
    elbow_m=np.array([0.0, 0.0, 0.45]),
    head_m=np.array([0.06, 0.0, 0.05]),
    elevation_limits_rad=(float(np.radians(-80.0)), float(np.radians(80.0))),
)
#: Stereo pairs on masts, by the names of their cameras' presets.
MASTS = {"mer-navcam": MER_MAST, "research-navcam": RESEARCH_MAST, "research-pancam": RESEARCH_MAST}


class PointingParameters(Parameters):
    """How a mast misses where it is told to point. Both axes alike; spreads are one standard deviation.

    Requested and measured angles differ by 0.0004 to 0.015 deg in the labels of two of Opportunity's navcam pictures;
    the other numbers are assumed.
    """

    zero_deg: Annotated[Degrees, Field(description="error of the encoder's zero, fixed to a run, deg")] = 0.1
    backlash_deg: Annotated[Degrees, Field(description="full width of the gears' play, deg")] = 0.1
    settling_deg: Annotated[Degrees, Field(description="how far from the command the motor stops, deg")] = 0.01
    count_deg: Annotated[Degrees, Field(description="the encoder's count, deg; 0: no rounding")] = 0.005


class StereoCalibrationParameters(Parameters):
    """How far a stereo pair's calibrated cameras differ from the true ones. Spreads are one standard deviation."""

    disparity_error_px: Annotated[
        Pixels,
        Field(description="most of the disparity's error in the frames' middle, drawn evenly between +- this, px"),
    ] = 0.5
    epipolar_error_px: Annotated[Pixels, Field(description="across the epipolar lines in the frames' middle, px")] = 0.2
    alignment_deg: Annotated[Degrees, Field(description="of the pair on its head, each axis, deg")] = 0.05
    roll_deg: Annotated[Degrees, Field(description="of each camera about its axis, deg")] = 0.01
    focal_error: Annotated[float, Field(ge=0.0, le=0.05, description="of each focal length, relative")] = 1e-4


@dataclass(frozen=True)
class MastState:
    """Where a mast points.

    Attributes
    ----------
    readings_rad
        Azimuth and elevation as the encoders read them: what flight software is given.
    true_rad
        Azimuth and elevation as they are.
    axes_rad, motors_rad
        Both axes and both motors before the error of the encoders' zeros.
    """

    readings_rad: tuple[float, float]
    true_rad: tuple[float, float]
    axes_rad: Float64[np.ndarray, "2"]
    motors_rad: Float64[np.ndarray, "2"]


@dataclass(frozen=True)
class Mast:
    """A mast with the errors of one run.

    Attributes
    ----------
    parameters
        How it misses.
    geometry
        The mast, as surveyed and as it is.
    zeros_rad
        Errors of the encoders' zeros, azimuth and elevation: true angles are less by this than the axes' counts.
    """

    parameters: PointingParameters
    geometry: MastGeometry
    zeros_rad: Float64[np.ndarray, "2"]

    @classmethod
    def drawn(cls, parameters: PointingParameters, geometry: MastGeometry, rng: np.random.Generator) -> Mast:
        """A mast with its errors drawn."""
        return cls(parameters, geometry, np.radians(parameters.zero_deg) * rng.standard_normal(2))

    @property
    def rest(self) -> MastState:
        """Looking straight ahead, the gears in the middle of their play."""
        return self._state(np.zeros(2), np.zeros(2))

    def pointed(
        self, state: MastState, azimuth_rad: float, elevation_rad: float, rng: np.random.Generator
    ) -> MastState:
        """The mast after a command; beyond a limit it stops there, as its readings tell.

        Parameters
        ----------
        state
            Where it pointed.
        azimuth_rad, elevation_rad
            Where to point, as `MastGeometry` counts angles.
        rng
            Of where the motors stop.
        """
        p, g = self.parameters, self.geometry
        least, most = np.array([g.azimuth_limits_rad, g.elevation_limits_rad]).T
        stopped = np.radians(p.settling_deg) * rng.standard_normal(2)
        motors = np.clip(np.clip(np.array([azimuth_rad, elevation_rad]), least, most) + stopped, least, most)
        play = 0.5 * np.radians(p.backlash_deg)
        return self._state(motors, np.clip(state.axes_rad, motors - play, motors + play))

    def rover_from_head(self, state: MastState) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.geometry.rover_from_head(*state.true_rad)

    def _state(self, motors_rad: Float64[np.ndarray, "2"], axes_rad: Float64[np.ndarray, "2"]) -> MastState:
        count = np.radians(self.parameters.count_deg)
        readings = count * np.rint(motors_rad / count) if count > 0.0 else motors_rad
        true = axes_rad - self.zeros_rad
        return MastState(
            (float(readings[0]), float(readings[1])), (float(true[0]), float(true[1])), axes_rad, motors_rad
        )


@dataclass(frozen=True)
class StereoHead:
    """A stereo pair on a mast, as it is and as calibrated.

    Attributes
    ----------
    true
        The cameras as they are: the design's.
    calibrated
        What flight software is given.
    """

    true: MastCalibration
    calibrated: MastCalibration

    @classmethod
    def drawn(
        cls, design: MastCalibration, parameters: StereoCalibrationParameters, rng: np.random.Generator
    ) -> StereoHead:
        """A pair with the errors of its calibration drawn."""
        p = parameters
        disparity = p.disparity_error_px * rng.uniform(-1.0, 1.0)
        across = p.epipolar_error_px * rng.standard_normal()
        common = Rotation.from_rotvec(np.radians(p.alignment_deg) * rng.standard_normal(3))
        rolls = np.radians(p.roll_deg) * rng.standard_normal(2)
        focal = 1.0 + p.focal_error * rng.standard_normal(2)
        cameras = []
        for camera, side, roll, scale in zip((design.left, design.right), (0.5, -0.5), rolls, focal, strict=True):
            # turned to the right about its rows' normal, a camera sees everything further to the left
            columns, rows = camera.focal_lengths
            turn = camera.down * (-side * disparity / columns) + camera.right * (side * across / rows) + camera.a * roll
            cameras.append(_rotated(camera.magnified(float(scale)), Rotation.from_rotvec(turn)))
        left, right = (camera.moved(rigid(common, np.zeros(3))) for camera in cameras)
        return cls(design, replace(design, left=left, right=right))

    def disparity_error_px(self, range_m: float) -> float:
        """Calibrated less true disparity of the point at this range straight ahead of the pair: as applied.

        The common rotation is left out: the calibrated pair is asked for the point that lies so before itself.
        """
        pairs = [(mast.left, mast.right) for mast in (self.calibrated, self.true)]
        calibrated, true = (_disparity_px(left, right, range_m) for left, right in pairs)
        return calibrated - true


#: From a body whose camera looks along -z, its columns along x, to a head whose cameras look along x, columns along -y.
_HEAD_FROM_DOWN = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))


def on_head(
    left: CameraModel, right: CameraModel, baseline_m: float, toe_in_deg: float
) -> tuple[CameraModel, CameraModel]:
    """Two cameras at a body's origin that look down (`marsyard.sim.camera.looking_down`), put onto a head as a stereo
    pair.

    Both look forwards, half the baseline to either side of the head's origin, each turned towards the other by the
    toe-in.
    """

    def put(camera: CameraModel, side: float) -> CameraModel:
        turn = Rotation.from_rotvec([0.0, 0.0, -side * np.radians(toe_in_deg)])
        return camera.moved(rigid(turn * _HEAD_FROM_DOWN, np.array([0.0, 0.5 * side * baseline_m, 0.0])))

    return put(left, 1.0), put(right, -1.0)


def stereo_mast(name: str) -> MastCalibration:
    """The design of a mast and its stereo pair, by the name of the cameras' preset (`MASTS`).

    Raises
    ------
    ValueError
        If no mast carries such cameras.
    """
    if name not in MASTS:
        raise ValueError(f"no mast carries cameras called {name!r}; allowed: {', '.join(MASTS)}")
    left, right = preset(name).cameras()
    return MastCalibration(MASTS[name], left, right)


def _disparity_px(left: CameraModel, right: CameraModel, range_m: float) -> float:
    """Column in the left less that in the right of a point before the middle between them."""
    ahead = left.boresight() + right.boresight()
    point = 0.5 * (left.c + right.c) + range_m * ahead / np.linalg.norm(ahead)
    return float(left.project(point)[0][0] - right.project(point)[0][0])


C = TypeVar("C", bound=CameraModel)


def _rotated(camera: C, turn: Rotation) -> C:
    """The camera turned about its own centre."""
    return camera.moved(rigid(turn, camera.c - turn.apply(camera.c.copy())))
