"""Pose estimation of a rover: wheel odometry with an inertial unit, and optional visual odometry.

Attitude (Ali et al. 2005, as on MER). Accelerometers measure the tilt at each stop, gyros the heading along a drive:
``R_estimated = Rz(heading error) A R_true B N``. B is a misalignment of the accelerometers, constant in a run. A, a
rotation of the world, makes the estimate exact at the start: B has an effect only when the rover turns or tilts. N is
the noise of a stop. The heading error is the sum of a fraction of the turns, a drift along the path and a random walk.

Position by wheels. Each part of a drive adds the commanded path in the estimated axes; slip is not observed:
``dp = R_estimated ((1 + scale) path_commanded + noise)``.

Position by visual odometry (paper, section 4.2: "roughly 2% of the rover travel distance"). Each drive adds its true
motion with an own scale error, a random walk and a floor; the attitude is the inertial unit's. If it does not converge,
the wheels' estimate is used for that drive.

Constant errors of a run are drawn once (`Odometer.drawn`), the others with every drive. The estimate is exact at the
start by definition. The estimate assumes flat ground between stops: climbed rocks are part of the slip.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics import Drive
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.parameters import Fraction, Parameters

Degrees = Annotated[float, Field(ge=0.0, le=30.0)]


class VisualOdometryParameters(Parameters):
    """Visual odometry; spreads are one standard deviation.

    With the defaults the RMS position error is 2 % of the distance on 8 m (the paper's value; its split into a constant
    error of a run and random errors is assumed), and 3 % on 2 m.
    """

    scale_error: Annotated[Fraction, Field(description="of the distance, constant in a run (stereo)")] = 0.015
    walk_m: Annotated[float, Field(ge=0.0, le=1.0, description="error per axis per root metre, m")] = 0.02
    floor_m: Annotated[float, Field(ge=0.0, le=1.0, description="error per axis new with every drive, m")] = 0.002
    failure_fraction: Annotated[Fraction, Field(description="fraction of drives without convergence")] = 0.0


class OdometryParameters(Parameters):
    """Wheel odometry with an inertial unit, and optional visual odometry; spreads are one standard deviation.

    The unit is of the class of MER's LN-200; all values are assumed. On flat, hard ground the error is 1.1 % of 8 m;
    slip, in addition, is part of the motion (`marsyard.sim.dynamics.driving`).
    """

    scale_error: Annotated[Fraction, Field(description="of the path, constant in a run (wheel radius)")] = 0.01
    walk_m: Annotated[float, Field(ge=0.0, le=1.0, description="error along and across per root metre, m")] = 0.01
    heading_scale_error: Annotated[Fraction, Field(description="of the turn, constant in a run")] = 0.002
    heading_drift_deg_m: Annotated[Degrees, Field(description="drift along the path, constant in a run, deg/m")] = 0.03
    heading_walk_deg: Annotated[Degrees, Field(description="heading error per root metre of path, deg")] = 0.05
    misalignment_deg: Annotated[Degrees, Field(description="of the accelerometers, per axis, constant in a run")] = 0.1
    tilt_noise_deg: Annotated[Degrees, Field(description="of pitch and roll, new at every stop")] = 0.03
    visual: VisualOdometryParameters = VisualOdometryParameters()


#: Odometry without own errors: slip is its only error, which visual odometry observes.
EXACT = OdometryParameters(
    scale_error=0.0, walk_m=0.0, heading_scale_error=0.0, heading_drift_deg_m=0.0, heading_walk_deg=0.0,
    misalignment_deg=0.0, tilt_noise_deg=0.0,
    visual=VisualOdometryParameters(scale_error=0.0, walk_m=0.0, floor_m=0.0),
)  # fmt: skip


@dataclass(frozen=True)
class PoseEstimate:
    """The rover's estimate of its pose at a stop.

    - heading_error_rad: true error of the estimated heading, to the left: for rows and figures, not for flight software
    - visual_failed: whether visual odometry was on during the last drive and did not converge
    """

    world_from_rover: RigidTransform
    heading_error_rad: float = 0.0
    visual_failed: bool = False

    def error_m(self, true: RigidTransform) -> Float64[np.ndarray, "3"]:
        """Estimated less true position, world axes."""
        return np.asarray(self.world_from_rover.translation - true.translation)


@dataclass(frozen=True)
class Odometer:
    """The pose estimator of one run with its constant errors drawn.

    - start: the initial pose, known exactly
    - wheel_scale, visual_scale, heading_scale: relative errors of the wheels' path, visual odometry's path and turns
    - heading_drift_rad_m: heading drift along the path, to the left
    - misalignment: B of the module's equation
    """

    parameters: OdometryParameters
    start: RigidTransform
    wheel_scale: float
    visual_scale: float
    heading_scale: float
    heading_drift_rad_m: float
    misalignment: Rotation

    @classmethod
    def draw(cls, parameters: OdometryParameters, start: RigidTransform, rng: np.random.Generator) -> Odometer:
        """Draw the constant errors; the estimate is exact at `start`."""
        p = parameters
        wheel, visual, heading, drift, *tilt = rng.standard_normal(6)
        return cls(
            parameters=p,
            start=start,
            wheel_scale=float(p.scale_error * wheel),
            visual_scale=float(p.visual.scale_error * visual),
            heading_scale=float(p.heading_scale_error * heading),
            heading_drift_rad_m=float(np.radians(p.heading_drift_deg_m) * drift),
            misalignment=Rotation.from_rotvec(np.radians(p.misalignment_deg) * np.array([*tilt, 0.0])),
        )

    @property
    def first(self) -> PoseEstimate:
        """The exact estimate at the start."""
        return PoseEstimate(self.start)

    def step(
        self, estimate: PoseEstimate, driven: Drive, rng: np.random.Generator, visual: bool = False
    ) -> PoseEstimate:
        """Update the estimate after a true drive, with or without visual odometry; the number of draws is the same."""
        p = self.parameters
        wheels, walk, *tilt = np.split(rng.standard_normal(8), [2, 3, 5])
        fails = bool(rng.random() < p.visual.failure_fraction)
        if visual and not fails:
            start, end = driven.start.world_from_rover, driven.end.world_from_rover
            error = np.hypot(p.visual.walk_m * np.sqrt(driven.length_m), p.visual.floor_m) * tilt[1]
            path = (1.0 + self.visual_scale) * (start.inv() * end).translation + error
            displacement = self._attitude(start, estimate.heading_error_rad).apply(path)
        else:
            noise_m = p.walk_m * np.sqrt(driven.command.length_m) * wheels
            displacement = self._wheel_displacement(estimate, driven, noise_m)
        heading = estimate.heading_error_rad + self.heading_scale * driven.turn_left_rad
        heading += self.heading_drift_rad_m * driven.length_m
        heading += float(np.radians(p.heading_walk_deg) * np.sqrt(driven.length_m) * walk[0])
        noise = Rotation.from_rotvec(np.radians(p.tilt_noise_deg) * np.array([*tilt[0], 0.0]))
        attitude = self._attitude(driven.end.world_from_rover, heading) * noise
        return PoseEstimate(
            rigid(attitude, estimate.world_from_rover.translation + displacement), heading, visual and fails
        )

    @cached_property
    def _anchor(self) -> Rotation:
        """A of the module's equation."""
        return self.start.rotation * (self.start.rotation * self.misalignment).inv()

    def _attitude(self, true: RigidTransform, heading_error_rad: float) -> Rotation:
        """Estimated attitude without the noise of a stop."""
        return Rotation.from_rotvec([0.0, 0.0, heading_error_rad]) * self._anchor * true.rotation * self.misalignment

    def _wheel_displacement(
        self, estimate: PoseEstimate, driven: Drive, noise_m: Float64[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "3"]:
        """Displacement by the wheels' path and the gyros' turn, world axes."""
        scale = 1.0 + self.wheel_scale
        paths = np.zeros((len(driven.parts), 3))
        for path, part in zip(paths, driven.parts, strict=True):
            forward_m, left_m = scale * part.command.forward_m, scale * part.command.left_m
            path[:2] = DriveCommand(forward_m, left_m, part.turn_left_rad).displacement_m
        paths[:, :2] += noise_m / len(paths)
        true = Rotation.concatenate([part.before.world_from_rover.rotation for part in driven.parts])
        turn = Rotation.from_rotvec([0.0, 0.0, estimate.heading_error_rad]) * self._anchor
        return np.asarray((turn * true * self.misalignment).apply(paths).sum(axis=0))
