"""What a rover believes of its pose: by its wheels and an inertial unit, and by visual odometry where that is on.

Attitude (Ali et al. 2005, as on MER). Accelerometers give the tilt at each stop, gyros carry the heading along a drive:

    R_estimated = Rz(heading error) A R_true B N

B is a misalignment of the accelerometers, fixed in the rover and to a run; A, a turn of the world, makes the estimate
right at the start, so that B is felt only when the rover turns or tilts; N is the noise of a stop. The heading error
grows by a share of what is turned, by a drift along the path, and by a random walk.

Position by wheels. Each part of a drive adds what the wheels were told, in the estimated axes; slip goes unseen:

    dp = R_estimated ((1 + scale) path_told + noise)

Position by visual odometry (paper, section 4.2: "roughly 2% of the rover travel distance"). Each drive adds what was
truly driven, with a scale error of its own, a random walk and a floor; the attitude stays the inertial unit's. Where it
does not converge the wheels' count is taken for that drive.

Errors common to a run are drawn once (`Odometer.drawn`), the others with every drive. The estimate is right at the
start by definition. No rover is believed to be lifted: what wheels do not see includes rocks driven over.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
    """Visual odometry. Spreads are one standard deviation.

    With the defaults the position error is 2 % of the distance, rms, on 8 m (the paper's figure; how it divides into
    what is common to a run and what is new is assumed), and 3 % on 2 m.
    """

    scale_error: Annotated[
        Fraction, Field(description="share of the distance, common to a run (stereo calibration)")
    ] = 0.015
    walk_m: Annotated[
        float, Field(ge=0.0, le=1.0, description="error per axis on the first metre, growing as the distance's root, m")
    ] = 0.02
    floor_m: Annotated[float, Field(ge=0.0, le=1.0, description="error per axis new with every drive, m")] = 0.002
    failure_share: Annotated[Fraction, Field(description="share of drives on which it does not converge")] = 0.0


class OdometryParameters(Parameters):
    """Wheel odometry with an inertial unit, and the visual odometry that may be added.

    Spreads are one standard deviation. The unit is of the class of MER's LN-200; all numbers are assumed. On flat, hard
    ground they make 1.1 % of 8 m: slip, which comes on top, is the motion's (`marsyard.sim.dynamics.driving`).
    """

    scale_error: Annotated[Fraction, Field(description="share of the path, common to a run (the wheels' radius)")] = (
        0.01
    )
    walk_m: Annotated[
        float, Field(ge=0.0, le=1.0, description="error along and across on the first metre, growing as the root, m")
    ] = 0.01
    heading_scale_error: Annotated[Fraction, Field(description="share of what is turned, common to a run")] = 0.002
    heading_drift_deg_m: Annotated[Degrees, Field(description="drift along the path, common to a run, deg/m")] = 0.03
    heading_walk_deg: Annotated[
        Degrees, Field(description="error on the first metre, growing as the path's root, deg")
    ] = 0.05
    misalignment_deg: Annotated[Degrees, Field(description="of the accelerometers, per axis, common to a run")] = 0.1
    tilt_noise_deg: Annotated[Degrees, Field(description="of pitch and roll, new at every stop")] = 0.03
    visual: VisualOdometryParameters = VisualOdometryParameters()


#: Odometry without errors of its own: slip alone makes it wrong, and visual odometry sees that.
EXACT = OdometryParameters(
    scale_error=0.0, walk_m=0.0, heading_scale_error=0.0, heading_drift_deg_m=0.0, heading_walk_deg=0.0,
    misalignment_deg=0.0, tilt_noise_deg=0.0,
    visual=VisualOdometryParameters(scale_error=0.0, walk_m=0.0, floor_m=0.0),
)  # fmt: skip


@dataclass(frozen=True)
class PoseEstimate:
    """What the rover believes at a stop.

    Attributes
    ----------
    world_from_rover
        The estimated pose.
    heading_error_rad
        By how much the estimate is turned to the left (truth: for rows and figures, not for flight software).
    visual_failed
        Whether visual odometry was asked for on the last drive and did not converge.
    """

    world_from_rover: RigidTransform
    heading_error_rad: float = 0.0
    visual_failed: bool = False

    def error_m(self, true: RigidTransform) -> Float64[np.ndarray, "3"]:
        """Estimated less true position, world axes, metres."""
        return np.asarray(self.world_from_rover.translation - true.translation)


@dataclass(frozen=True)
class Odometer:
    """The pose estimator of one run, its constant errors drawn.

    Attributes
    ----------
    parameters
        The error model.
    start
        The pose at which it starts, which it knows.
    wheel_scale, visual_scale, heading_scale
        Relative errors of wheels' path, visual odometry's path, and turns.
    heading_drift_rad_m
        Drift along the path, radians per metre, to the left.
    misalignment
        B of the module's equation.
    """

    parameters: OdometryParameters
    start: RigidTransform
    wheel_scale: float
    visual_scale: float
    heading_scale: float
    heading_drift_rad_m: float
    misalignment: Rotation

    @classmethod
    def drawn(cls, parameters: OdometryParameters, start: RigidTransform, rng: np.random.Generator) -> Odometer:
        """An estimator with its errors drawn, right at this pose."""
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
        """The estimate at the start: right."""
        return PoseEstimate(self.start)

    def step(
        self, estimate: PoseEstimate, driven: Drive, rng: np.random.Generator, visual: bool = False
    ) -> PoseEstimate:
        """The estimate after a drive.

        Parameters
        ----------
        estimate
            The estimate at the drive's start.
        driven
            The drive as it truly was.
        rng
            Of the errors; the same number of draws with visual odometry and without.
        visual
            Whether visual odometry is on.
        """
        p = self.parameters
        wheels, walk, *tilt = np.split(rng.standard_normal(8), [2, 3, 5])
        fails = bool(rng.random() < p.visual.failure_share)
        if visual and not fails:
            moved = self._seen(estimate, driven, tilt[1])
        else:
            moved = self._counted(estimate, driven, p.walk_m * np.sqrt(driven.command.length_m) * wheels)
        heading = estimate.heading_error_rad + self.heading_scale * driven.turn_left_rad
        heading += self.heading_drift_rad_m * driven.length_m
        heading += float(np.radians(p.heading_walk_deg) * np.sqrt(driven.length_m) * walk[0])
        noise = Rotation.from_rotvec(np.radians(p.tilt_noise_deg) * np.array([*tilt[0], 0.0]))
        attitude = self._attitude(driven.end.world_from_rover, heading) * noise
        position = estimate.world_from_rover.translation + moved
        return replace(
            estimate,
            world_from_rover=rigid(attitude, position),
            heading_error_rad=heading,
            visual_failed=visual and fails,
        )

    @cached_property
    def _anchor(self) -> Rotation:
        """A of the module's equation."""
        return self.start.rotation * (self.start.rotation * self.misalignment).inv()

    def _attitude(self, true: RigidTransform, heading_error_rad: float) -> Rotation:
        """Estimated attitude without the noise of a stop."""
        return Rotation.from_rotvec([0.0, 0.0, heading_error_rad]) * self._anchor * true.rotation * self.misalignment

    def _counted(
        self, estimate: PoseEstimate, driven: Drive, noise_m: Float64[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "3"]:
        """Motion as the wheels count it, the turn as the gyros have it, world axes."""
        scale = 1.0 + self.wheel_scale
        paths = np.zeros((len(driven.parts), 3))
        for path, part in zip(paths, driven.parts, strict=True):
            told = part.command
            path[:2] = DriveCommand(scale * told.forward_m, scale * told.left_m, part.turn_left_rad).displacement_m
        paths[:, :2] += noise_m / len(paths)
        true = Rotation.concatenate([part.before.world_from_rover.rotation for part in driven.parts])
        turn = Rotation.from_rotvec([0.0, 0.0, estimate.heading_error_rad]) * self._anchor
        return np.asarray((turn * true * self.misalignment).apply(paths).sum(axis=0))

    def _seen(self, estimate: PoseEstimate, driven: Drive, draws: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """Motion as visual odometry has it, world axes."""
        p = self.parameters.visual
        start, end = driven.start.world_from_rover, driven.end.world_from_rover
        motion = (start.inv() * end).translation
        error = np.hypot(p.walk_m * np.sqrt(driven.length_m), p.floor_m) * draws
        attitude = self._attitude(start, estimate.heading_error_rad)
        return np.asarray(attitude.apply((1.0 + self.visual_scale) * motion + error))
