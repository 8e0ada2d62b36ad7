"""The motion of a descent by a class of a user's own: `[parameters.flight]` with `motion`.

A class that has

- options, which it takes by name when it is made, each with a default;
- ``random``, whether its poses depend on the random stream;
- ``fly(place: DescentPlace, rng: numpy.random.Generator) -> Poses``, the poses of one case.

Poses are continued between their instants as those of a recorded flight are (`marsyard.sim.dynamics.recorded`), and
every instrument measures the motion as it would a simulated one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.own_axes import RecordedAxes
from marsyard.scenarios.parts.named import DYNAMICS, OwnPart
from marsyard.sim.dynamics.recorded import RecordedMotion

#: A quaternion's length may be off 1 by this.
UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class DescentPlace:
    """What a motion is told of its case.

    Attributes
    ----------
    ground_height
        Height of the ground (metres) above that at the place, by metres east and north of it.
    gravity_m_s2
        Gravity of the site.
    pictures_s
        When pictures are taken, seconds; the first at 0.
    from_s, until_s
        The poses must reach from there, or before, to there, or after. A motion that is known until it is down at the
        thrusters' firing height fires there; one that ends before, at its end.
    firing_height_m
        The thrusters' firing height above the ground.
    """

    ground_height: Callable[[float, float], float]
    gravity_m_s2: float
    pictures_s: tuple[float, ...]
    from_s: float
    until_s: float
    firing_height_m: float


@dataclass(frozen=True)
class Poses:
    """A motion, by its poses at instants close enough for a cubic spline.

    Attributes
    ----------
    times_s
        Increasing times, seconds, at least four; the first picture is at 0.
    positions_m
        Metres from the ground at the place, in the world axes that the campaign states: east, north, up by default.
    quaternions_xyzw
        Rotations to those axes from those of the camera or body that the campaign states; of length 1, scalar last.
    columns
        What else is to be told of the case in its row, as `flight_NAME`: what was drawn, for one.
    """

    times_s: Float[np.ndarray, "n"]
    positions_m: Float[np.ndarray, "n 3"]
    quaternions_xyzw: Float[np.ndarray, "n 4"]
    columns: Mapping[str, Scalar] = field(default_factory=dict)


class Dynamics(Protocol):
    """A motion of a user's own. `random`: whether the poses depend on the random stream."""

    random: bool

    def fly(self, place: DescentPlace, rng: np.random.Generator) -> Poses:
        """The poses of one case."""
        ...


class OwnMotion(OwnPart, RecordedAxes):
    """A motion that a class of a user's own computes (see `marsyard.scenarios.parts.motions`).

    Positions count from the ground at `place`; they are the camera's, unless `lever_m` says where the camera is.
    """

    kind = DYNAMICS
    named_by = "motion"

    motion: Annotated[str, Field(description="an own motion's class: module:Class, or the name of an entry point")]
    axes: Annotated[
        Literal["enu", "ned"], Field(description="its world axes: east, north, up; or north, east, down")
    ] = "enu"
    lead_s: Annotated[
        float, Field(ge=0.2, le=30.0, description="how long before the first picture navigation is followed, s")
    ] = 5.0

    def flown(
        self, place: DescentPlace, ground_m: Float[np.ndarray, "3"], rng: np.random.Generator
    ) -> tuple[RecordedMotion, dict[str, Scalar]]:
        """The motion of a case in the terrain's world, and columns that say what it was.

        Raises
        ------
        ValueError
            Where the poses are not what they should be.
        """
        poses = checked_poses(self.spec, self.made().fly(place, rng), place)
        recorded = self.world * Rotation.from_quat(poses.quaternions_xyzw)
        positions = self.world.apply(poses.positions_m) + self.levers(recorded) + ground_m
        try:
            motion = RecordedMotion(poses.times_s, positions, self.bodies(recorded), place.gravity_m_s2)
        except ValueError as error:
            raise ValueError(f"the motion of '{self.spec}' {error}") from error
        return motion, self.columns("flight", poses.columns)


def checked_poses(spec: str, poses: object, place: DescentPlace) -> Poses:
    """The poses that a motion gave, as arrays of 64 bits. Raises ValueError where they are not as they should be."""
    if not isinstance(poses, Poses):
        raise ValueError(f"'{spec}' flies a {type(poses).__name__}; allowed: marsyard.scenarios.parts.Poses")
    times = np.array(poses.times_s, dtype=np.float64)
    positions = np.array(poses.positions_m, dtype=np.float64)
    quaternions = np.array(poses.quaternions_xyzw, dtype=np.float64)
    shapes = (("times_s", times, (times.size,)), ("positions_m", positions, (times.size, 3)))
    for name, given, allowed in (*shapes, ("quaternions_xyzw", quaternions, (times.size, 4))):
        if given.shape != allowed:
            raise ValueError(f"'{spec}' gives {name} of shape {given.shape}; allowed: {allowed}")
        if not np.all(np.isfinite(given)):
            raise ValueError(f"'{spec}' gives {name} that are not finite")
    if times.size == 0 or times[0] > place.from_s or times[-1] < place.until_s:
        known = f"{times[0]:.6g} to {times[-1]:.6g} s" if times.size else "no time at all"
        raise ValueError(
            f"'{spec}' flies {known}; allowed: from {place.from_s:.6g} s or before to {place.until_s:.6g} s or after"
        )
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > UNIT_TOLERANCE)
    if wrong.size:
        raise ValueError(
            f"'{spec}' gives a quaternion of length {lengths[wrong[0]]:.6g} (pose {wrong[0] + 1}); allowed: 1"
        )
    return Poses(times, positions, quaternions, poses.columns)
