"""Rover driving with slip: a command is executed step by step over the ground.

In each step the wheels turn as commanded; the rover's motion is reduced by slip, lies in the body's x-y plane, and ends
with the rover settled on the ground:

- along the motion, uphill: the fraction ``s(climb)`` of the path is lost, with the slope along the motion as climb;
  downhill a fraction of it is gained.
- across the motion: it slides downhill by a fraction of ``s(cross slope)`` of the path.
- turning: a fraction of ``s(slope)`` of the angle is lost, and another to scrubbing wheels on any ground.

The curve is ``s(a) = s0 + (1 - s0) (a / a1)^p``, at most 1, with a1 the slope of 100 % slip. The defaults, dry sand:
20 % at 10 deg, half at 15 deg, all at 20 deg. The tracking paper reports up to 100 % on 15 to 20 deg (section 5.5), as
do MER's tests on loose sand (Lindemann & Voorhees 2005); Opportunity lost half of its path on Eagle crater's slope of
about 15 deg (JPL, March 2004). The division of slip into along, across and turn is assumed. A soil factor scales all
slip of a run; each command draws a factor of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from marsyard.sim.dynamics.rover import Ground, RoverParameters, Stance, settle
from marsyard.sim.frames import compose, rotation_matrix
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.parameters import Fraction, Parameters, bounded_field

#: Longest step of a command: metres of path, and radians of turn.
STEP_M, STEP_RAD = 0.2, np.radians(5.0)
#: A commanded path shorter than this is a turn in place, metres.
_MIN_PATH_M = 1e-9

Spread = Annotated[float, Field(ge=0.0, le=1.0)]


class SlipParameters(Parameters):
    """Slip of the wheels, as fractions of the command; the module states the curve and its sources."""

    flat: Annotated[Fraction, Field(description="fraction of the path lost on level ground")] = 0.01
    full_slope_deg: Annotated[float, Field(gt=0.0, lt=90.0, description="slope of 100 % slip, deg")] = 20.0
    exponent: Annotated[float, bounded_field(1.0, 100.0, "exponent of the slope in the curve")] = 2.4
    downhill: Annotated[Fraction, Field(description="path gained downhill over path lost uphill")] = 0.3
    across: Annotated[Fraction, Field(description="sideways sliding on a cross slope over path lost uphill")] = 0.5
    turn: Annotated[Fraction, Field(description="fraction of a turn lost to scrubbing wheels on level ground")] = 0.03
    turn_slope: Annotated[Fraction, Field(description="turn lost on a slope over path lost uphill")] = 0.5
    soil_spread: Annotated[Spread, Field(description="RMS of the logarithm of the soil factor, common to a run")] = 0.15
    step_spread: Annotated[Spread, Field(description="RMS of the logarithm of each command's own factor")] = 0.15
    wander_deg_m: Annotated[
        float, bounded_field(0.0, 10.0, "RMS random turn on 1 m, growing as the root of the path")
    ] = 0.3

    def slip_fraction(self, slope_rad: float) -> float:
        """The curve s at a slope, without soil and command factors."""
        relative = abs(np.degrees(slope_rad)) / self.full_slope_deg
        return float(min(self.flat + (1.0 - self.flat) * relative**self.exponent, 1.0))

    def excess_slip(self, slope_rad: float) -> float:
        """Slip of a slope in excess of level ground."""
        return self.slip_fraction(slope_rad) - self.flat


@dataclass(frozen=True)
class Soil:
    """Soil of one run: slip parameters, and a factor on all slip."""

    parameters: SlipParameters
    factor: float

    @classmethod
    def draw(cls, parameters: SlipParameters, rng: np.random.Generator) -> Soil:
        """Draw a soil's factor."""
        return cls(parameters, float(np.exp(parameters.soil_spread * rng.standard_normal())))


@dataclass(frozen=True)
class DriveStep:
    """One step of a drive: the wheels' command, which an odometer integrates, and the rover before and after."""

    command: DriveCommand
    before: Stance
    after: Stance

    @cached_property
    def motion(self) -> RigidTransform:
        """True motion: the pose after in the axes of the pose before."""
        return compose(self.before.world_from_rover.inv(), self.after.world_from_rover)

    @cached_property
    def length_m(self) -> float:
        """Length of the true motion."""
        return float(np.linalg.norm(self.motion.translation))

    @cached_property
    def turn_left_rad(self) -> float:
        """True turn to the left about the rover's z axis, as a gyro integrates it."""
        return float(self.motion.rotation.as_rotvec()[2])

    @property
    def gained_m(self) -> float:
        """True motion along the commanded direction."""
        commanded = np.array([self.command.forward_m, self.command.left_m])
        if (length := float(np.hypot(*commanded))) < _MIN_PATH_M:
            return 0.0
        angle = float(np.arctan2(commanded[1], commanded[0])) + 0.5 * self.command.turn_left_rad
        arc_over_chord = length / max(float(np.hypot(*self.command.displacement_m)), _MIN_PATH_M)
        return arc_over_chord * float(self.motion.translation[:2] @ np.array([np.cos(angle), np.sin(angle)]))


@dataclass(frozen=True)
class Drive:
    """One executed command; the commands of its parts, at least one, add up to it."""

    command: DriveCommand
    parts: tuple[DriveStep, ...]

    @property
    def start(self) -> Stance:
        """The rover before the drive."""
        return self.parts[0].before

    @property
    def end(self) -> Stance:
        """The rover after the drive: the truth of the next stop."""
        return self.parts[-1].after

    @property
    def stances(self) -> tuple[Stance, ...]:
        """The rover before the drive, and after each part."""
        return (self.start, *(part.after for part in self.parts))

    @property
    def length_m(self) -> float:
        """Length of the true path."""
        return sum(part.length_m for part in self.parts)

    @property
    def turn_left_rad(self) -> float:
        """True turn to the left about the rover's z axis."""
        return sum(part.turn_left_rad for part in self.parts)

    @property
    def slip(self) -> float:
        """Fraction of the commanded path lost along it; negative: path gained; NaN for a turn in place."""
        if self.command.length_m < _MIN_PATH_M:
            return float("nan")
        return 1.0 - sum(part.gained_m for part in self.parts) / self.command.length_m


def drive(
    rover: RoverParameters, ground: Ground, soil: Soil, start: Stance, command: DriveCommand, rng: np.random.Generator
) -> Drive:
    """Execute one command: forward, backward, along an arc, sideways, or a turn in place.

    `rng` draws the slip; the number of draws does not depend on the command.
    """
    p = soil.parameters
    step, wander = rng.standard_normal(2)
    factor = soil.factor * float(np.exp(p.step_spread * step))
    wander_rad = np.radians(p.wander_deg_m) * np.sqrt(command.length_m) * float(wander)
    count = max(1, int(np.ceil(max(command.length_m / STEP_M, abs(command.turn_left_rad) / STEP_RAD) - 1e-9)))
    step_command = command.part(1.0 / count)
    parts: list[DriveStep] = []
    before = start
    for _ in range(count):
        # slope of the ground reduces the path and the turn; then the rover settles at its new position
        rotation = rotation_matrix(before.world_from_rover)
        path = _apply_slip(p, factor, rotation, step_command)
        turn_factor = max(1.0 - factor * (p.turn + p.turn_slope * p.excess_slip(before.tilt_rad)), 0.0)
        turn = turn_factor * step_command.turn_left_rad + wander_rad / count
        motion = DriveCommand(float(path[0]), float(path[1]), float(turn))
        position = before.world_from_rover.translation + rotation[:, :2] @ motion.displacement_m
        forward = rotation @ np.array([np.cos(turn), np.sin(turn), 0.0])
        azimuth = float(np.arctan2(forward[0], forward[1]))
        after = settle(rover, ground, float(position[0]), float(position[1]), azimuth, near=before)
        parts.append(DriveStep(step_command, before, after))
        before = after
    return Drive(command, tuple(parts))


def _apply_slip(
    p: SlipParameters, factor: float, rotation: Float64[np.ndarray, "3 3"], command: DriveCommand
) -> Float64[np.ndarray, "2"]:
    """True path along the body's x and y axes, metres."""
    commanded = np.array([command.forward_m, command.left_m])
    length = float(np.hypot(*commanded))
    if length < _MIN_PATH_M:
        return commanded
    along = commanded / length
    across = np.array([-along[1], along[0]])
    # slopes of the body's x-y plane: the world's z components of these axes
    climb, cross = (float(np.arcsin(np.clip(rotation[2, :2] @ axis, -1.0, 1.0))) for axis in (along, across))
    lost = factor * (p.flat + (1.0 if climb >= 0.0 else -p.downhill) * p.excess_slip(climb))
    sideways = -np.sign(cross) * factor * p.across * p.excess_slip(cross)
    return np.asarray(length * (max(1.0 - lost, 0.0) * along + max(-1.0, min(sideways, 1.0)) * across))
