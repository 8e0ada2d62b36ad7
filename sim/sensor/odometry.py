"""Pose estimation of a rover: wheel odometry with an inertial unit, and optionally visual odometry.

Attitude (Ali et al. 2005, for MER). Accelerometers measure the tilt at each stop, gyros the heading along a drive:
``R_estimated = Rz(heading error) A R_true B N``. B is a misalignment of the accelerometers, constant in a run. The
rotation A makes the estimate exact at the start, so that B has an effect only when the rover turns or tilts. N is the
noise at a stop. The heading error is the sum of a fraction of the turns, a drift along the path and a random walk.

Position from wheel odometry. Each segment of a drive (`Drive.parts`) adds the commanded path in estimated axes. Slip
is not measured:
``dp = R_estimated ((1 + scale) path_commanded + noise)``.

Position from visual odometry (paper, section 4.2: "roughly 2% of the rover travel distance"). Each drive adds the true
motion with a separate scale error, a random walk and noise of constant variance; attitude comes from the inertial unit.
If visual odometry does not converge, wheel odometry is used for that drive.

Constant errors of a run are sampled once (`Odometer.draw`), the other errors with each drive. The estimate is exact at
the start by definition. Wheel odometry assumes flat ground between stops: climbing over rocks has the effect of slip.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.error_sources import ODOMETRY
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.parameters import Fraction, Parameters

Degrees = Annotated[float, Field(ge=0.0, le=30.0)]


class VisualOdometryParameters(Parameters):
    """Errors of visual odometry, standard deviations.

    With the defaults the RMS position error is 2 % of a distance of 8 m, as in the paper, and 3 % of 2 m. The split
    into constant and random errors is assumed.
    """

    scale_error: Annotated[Fraction, Field(description="fraction of the distance, constant in a run")] = 0.015
    walk_m: Annotated[float, Field(ge=0.0, le=1.0, description="random walk per axis, m/sqrt(m)")] = 0.02
    floor_m: Annotated[float, Field(ge=0.0, le=1.0, description="additional error per axis and drive, m")] = 0.002
    failure_fraction: Annotated[Fraction, Field(description="fraction of drives without convergence")] = 0.0


class OdometryParameters(Parameters):
    """Errors of wheel odometry with an inertial unit, and of visual odometry; standard deviations.

    The unit is similar to MER's LN-200; all values are assumed. On flat, hard ground the error is 1.1 % of 8 m.
    Slip is not included: it is part of the true motion (`marsyard.sim.dynamics.driving`).
    """

    scale_error: Annotated[Fraction, ODOMETRY, Field(description="fraction of the path, constant (wheel radius)")] = (
        0.01
    )
    walk_m: Annotated[float, ODOMETRY, Field(ge=0.0, le=1.0, description="random walk per axis, m/sqrt(m)")] = 0.01
    heading_scale_error: Annotated[Fraction, ODOMETRY, Field(description="fraction of the turn, constant in a run")] = (
        0.002
    )
    heading_drift_deg_m: Annotated[
        Degrees, ODOMETRY, Field(description="drift along the path, constant in a run, deg/m")
    ] = 0.03
    heading_walk_deg: Annotated[Degrees, ODOMETRY, Field(description="random walk of the heading, deg/sqrt(m)")] = 0.05
    misalignment_deg: Annotated[
        Degrees, ODOMETRY, Field(description="accelerometer misalignment per axis, constant")
    ] = 0.1
    tilt_noise_deg: Annotated[Degrees, ODOMETRY, Field(description="pitch and roll noise at each stop")] = 0.03
    visual: VisualOdometryParameters = VisualOdometryParameters()


#: Odometry without sensor errors: the only error of wheel odometry is slip, and visual odometry has no error.
EXACT = OdometryParameters(
    scale_error=0.0, walk_m=0.0, heading_scale_error=0.0, heading_drift_deg_m=0.0, heading_walk_deg=0.0,
    misalignment_deg=0.0, tilt_noise_deg=0.0,
    visual=VisualOdometryParameters(scale_error=0.0, walk_m=0.0, floor_m=0.0),
)  # fmt: skip


@dataclass(frozen=True)
class PoseEstimate:
    """The rover's estimate of its pose at a stop.

    - heading_error_rad: estimated minus true heading, positive to the left; not available to flight software
    - visual_failed: whether visual odometry was used in the last drive and did not converge
    """

    world_from_rover: RigidTransform
    heading_error_rad: float = 0.0
    visual_failed: bool = False

    def error_m(self, true: RigidTransform) -> Float64[np.ndarray, "3"]:
        """Return estimated minus true position, world axes."""
        return np.asarray(self.world_from_rover.translation - true.translation)


@dataclass(frozen=True)
class Odometer:
    """Pose estimator of one run, with its constant errors.

    - start: the initial pose, known exactly
    - wheel_scale, visual_scale, heading_scale: relative errors of wheel path, visual odometry path and turns
    - heading_drift_rad_m: heading drift along the path, positive to the left
    - misalignment: rotation B of the module's equation
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
    def initial_estimate(self) -> PoseEstimate:
        """Estimate at the start, which is exact."""
        return PoseEstimate(self.start)

    def step(
        self, estimate: PoseEstimate, drive: Drive, rng: np.random.Generator, visual: bool = False
    ) -> PoseEstimate:
        """Update the estimate after a drive; `visual`: use visual odometry. Both modes draw the same random numbers."""
        p = self.parameters
        wheel_noise, heading_noise, tilt_noise, visual_noise = np.split(rng.standard_normal(8), [2, 3, 5])
        has_failed = bool(rng.random() < p.visual.failure_fraction)
        if visual and not has_failed:
            start, end = drive.start.world_from_rover, drive.end.world_from_rover
            error = np.hypot(p.visual.walk_m * np.sqrt(drive.length_m), p.visual.floor_m) * visual_noise
            path = (1.0 + self.visual_scale) * (start.inv() * end).translation + error
            displacement = self._estimate_attitude(start, estimate.heading_error_rad).apply(path)
        else:
            noise_m = p.walk_m * np.sqrt(drive.command.length_m) * wheel_noise
            displacement = self._compute_wheel_displacement(estimate, drive, noise_m)
        heading_error_rad = estimate.heading_error_rad + self.heading_scale * drive.turn_left_rad
        heading_error_rad += self.heading_drift_rad_m * drive.length_m
        heading_error_rad += float(np.radians(p.heading_walk_deg) * np.sqrt(drive.length_m) * heading_noise[0])
        noise = Rotation.from_rotvec(np.radians(p.tilt_noise_deg) * np.array([*tilt_noise, 0.0]))
        attitude = self._estimate_attitude(drive.end.world_from_rover, heading_error_rad) * noise
        pose = rigid(attitude, estimate.world_from_rover.translation + displacement)
        return PoseEstimate(pose, heading_error_rad, visual and has_failed)

    @cached_property
    def _start_correction(self) -> Rotation:
        """Rotation A of the module's equation, which makes the estimate exact at the start."""
        return self.start.rotation * (self.start.rotation * self.misalignment).inv()

    def _estimate_attitude(self, true: RigidTransform, heading_error_rad: float) -> Rotation:
        """Compute the estimated attitude without the noise of a stop."""
        heading_error = Rotation.from_rotvec([0.0, 0.0, heading_error_rad])
        return heading_error * self._start_correction * true.rotation * self.misalignment

    def _compute_wheel_displacement(
        self, estimate: PoseEstimate, drive: Drive, noise_m: Float64[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "3"]:
        """Compute the displacement from the wheel path and the turns measured by the gyros, world axes."""
        scale = 1.0 + self.wheel_scale
        paths = np.zeros((len(drive.parts), 3))
        for path, part in zip(paths, drive.parts, strict=True):
            forward_m, left_m = scale * part.command.forward_m, scale * part.command.left_m
            path[:2] = DriveCommand(forward_m, left_m, part.turn_left_rad).displacement_m
        paths[:, :2] += noise_m / len(paths)
        true_attitudes = Rotation.concatenate([part.before.world_from_rover.rotation for part in drive.parts])
        heading_error = Rotation.from_rotvec([0.0, 0.0, estimate.heading_error_rad])
        attitudes = heading_error * self._start_correction * true_attitudes * self.misalignment
        return np.asarray(attitudes.apply(paths).sum(axis=0))
