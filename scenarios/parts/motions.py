"""User-defined motion of a descent: `[parameters.flight]` with `motion`.

A motion is a class with

- options: arguments of the constructor, each with a default value;
- ``random``: whether the poses depend on the random stream;
- ``fly(inputs: MotionInputs, rng: numpy.random.Generator) -> Poses``: returns the poses of one case.

Poses are interpolated as in a recorded flight (`marsyard.sim.dynamics.recorded`). Instruments measure the interpolated
motion as they measure a simulated motion.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.named import DYNAMICS, CustomPart
from marsyard.scenarios.recorded_axes import RecordedAxes
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.parameters import bounded_field

#: Maximum deviation of a quaternion's length from 1.
UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class MotionInputs:
    """Ground, gravity and times of a descent: the inputs of a motion.

    The origin of positions is the ground point of the case's location.

    - ground_height: function that returns the height of the ground (m, relative to the origin) at x metres east and
      y metres north of the origin
    - gravity_m_s2: gravity at the origin
    - image_times_s: nominal times of the images; the first image is at 0
    - from_s, until_s: interval that the poses must cover
    - firing_height_m: height above the ground at which the thrusters fire; they fire at the end of a motion that ends
      above this height
    """

    ground_height: Callable[[float, float], float]
    gravity_m_s2: float
    image_times_s: tuple[float, ...]
    from_s: float
    until_s: float
    firing_height_m: float


@dataclass(frozen=True)
class Poses:
    """A motion as a sequence of poses, sampled densely enough for a cubic spline.

    - times_s: increasing times, at least four; the first image is at time 0
    - positions_m: positions relative to the origin (`MotionInputs`), in the world axes of the key `axes` (default:
      east, north, up)
    - quaternions_xyzw: unit quaternions (x, y, z, w) of rotations to these world axes from the frame of the key
      `attitude_of` (default: OpenCV camera frame)
    - columns: further result columns, such as sampled values; the prefix `flight_` is added to their names
    """

    times_s: Float[np.ndarray, "n"]
    positions_m: Float[np.ndarray, "n 3"]
    quaternions_xyzw: Float[np.ndarray, "n 4"]
    columns: Mapping[str, Scalar] = field(default_factory=dict)


class CustomMotion(CustomPart, RecordedAxes):
    """A user-defined motion (see `marsyard.scenarios.parts.motions`).

    Positions are those of the camera or, with `lever_m`, of the vehicle.
    """

    kind = DYNAMICS
    name_key = "motion"

    motion: Annotated[str, Field(description="custom motion's class: module:Class, or an entry point's name")]
    axes: Annotated[Literal["enu", "ned"], Field(description="east, north, up; or north, east, down")] = "enu"
    lead_s: Annotated[float, bounded_field(0.2, 30.0, "start of the navigation before the first image")] = 5.0

    def compute(
        self, inputs: MotionInputs, ground_m: Float[np.ndarray, "3"], rng: np.random.Generator
    ) -> tuple[RecordedMotion, dict[str, Scalar]]:
        """Compute the motion of a case in world axes, and its columns. Raises ValueError for invalid poses."""
        poses = check_poses(self.spec, self.create().fly(inputs, rng), inputs)
        attitudes = self.enu_from_axes * Rotation.from_quat(poses.quaternions_xyzw)
        positions = self.enu_from_axes.apply(poses.positions_m) + self.lever_arms(attitudes) + ground_m
        try:
            motion = RecordedMotion(poses.times_s, positions, self.body_attitudes(attitudes), inputs.gravity_m_s2)
        except ValueError as error:
            raise ValueError(f"the motion of '{self.spec}' {error}") from error
        return motion, self.columns("flight", poses.columns)


def check_poses(spec: str, poses: object, inputs: MotionInputs) -> Poses:
    """Check a motion's poses and return them as 64-bit arrays. Raises ValueError for invalid poses."""
    if not isinstance(poses, Poses):
        raise ValueError(f"'{spec}' returns a {type(poses).__name__}; allowed: marsyard.scenarios.parts.Poses")
    names = ("times_s", "positions_m", "quaternions_xyzw")
    times, positions, quaternions = (np.array(getattr(poses, name), dtype=np.float64) for name in names)
    shapes = ((times.size,), (times.size, 3), (times.size, 4))
    for name, array, shape in zip(names, (times, positions, quaternions), shapes, strict=True):
        if array.shape != shape:
            raise ValueError(f"'{spec}' returns {name} of shape {array.shape}; allowed: {shape}")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"'{spec}' returns {name} that are not finite")
    if times.size == 0 or times[0] > inputs.from_s or times[-1] < inputs.until_s:
        interval = f"{times[0]:.6g} to {times[-1]:.6g} s" if times.size else "no times"
        raise ValueError(
            f"'{spec}' covers {interval}; allowed: from at most {inputs.from_s:.6g} s "
            f"to at least {inputs.until_s:.6g} s"
        )
    lengths = np.linalg.norm(quaternions, axis=1)
    invalid = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE)
    if invalid.size:
        raise ValueError(
            f"'{spec}' returns a quaternion of length {lengths[invalid[0]]:.6g} (pose {invalid[0] + 1}); allowed: 1"
        )
    return Poses(times, positions, quaternions, poses.columns)
