"""Rover driving with slip: each command is executed in short steps on the terrain.

In each step the rover moves in the body's x-y plane by the command reduced by slip, and is then settled on the ground.
`SlipParameters` defines the slip along the path, across it and in heading, with random factors per run and command.

The default slip on dry sand is 20 % on a slope of 10 deg, 50 % on 15 deg and 100 % on 20 deg. Sources: the tracking
paper reports up to 100 % on 15 to 20 deg (section 5.5), as do MER's tests on loose sand (Lindemann & Voorhees 2005).
Opportunity lost half of its path on Eagle crater's slope of about 15 deg (JPL, March 2004). The division of the slip
into longitudinal, lateral and heading slip is assumed.

The tracking paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from marsyard.sim.dynamics.driven_ground import DrivenGround
from marsyard.sim.dynamics.rover import RoverParameters, Stance, settle
from marsyard.sim.error_sources import SLIP
from marsyard.sim.frames import compose, rotation_matrix
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.parameters import Fraction, Parameters, bounded_field

#: Longest step of a command: metres of path, and radians of turn.
STEP_M, STEP_RAD = 0.2, np.radians(5.0)
#: A command with a shorter path is a turn in place.
_MIN_PATH_M = 1e-9

LogDeviation = Annotated[float, Field(ge=0.0, le=1.0)]


class SlipParameters(Parameters):
    """Slip of a rover, as fractions of the commanded path and turn.

    On a slope a, the slip is ``s(a) = min(flat + (1 - flat) (|a| / full_slope_deg)^exponent, 1)``. The part of it that
    the slope causes is e(a) = s(a) - flat. With the product f of the soil factor and the command's factor:

    - path lost: ``f (flat + e(climb))`` uphill, ``f (flat - downhill e(climb))`` downhill; at most 1
    - path slid sideways, towards the lower side: ``f across e(cross slope)``, at most 1
    - turn lost: ``f (turn + turn_slope e(tilt))``, at most 1

    Climb and cross slope are the slopes along and across the motion; tilt is the rover's angle from the vertical.
    """

    flat: Annotated[Fraction, SLIP, Field(description="wheel slip on level ground, fraction of the commanded path")] = (
        0.01
    )
    full_slope_deg: Annotated[
        float, Field(gt=0.0, lt=90.0, description="slope at which the wheels slip completely")
    ] = 20.0
    exponent: Annotated[float, bounded_field(1.0, 100.0, "exponent of the slope in the slip formula")] = 2.4
    downhill: Annotated[Fraction, SLIP, Field(description="path gained downhill divided by path lost uphill")] = 0.3
    across: Annotated[Fraction, SLIP, Field(description="sideways sliding on a cross slope / path lost uphill")] = 0.5
    turn: Annotated[Fraction, SLIP, Field(description="fraction of a turn lost on level ground")] = 0.03
    turn_slope: Annotated[
        Fraction, SLIP, Field(description="fraction of a turn lost on a slope / path lost uphill")
    ] = 0.5
    soil_spread: Annotated[
        LogDeviation, SLIP, Field(description="RMS of the logarithm of the soil factor of a run")
    ] = 0.15
    step_spread: Annotated[LogDeviation, SLIP, Field(description="RMS of the logarithm of each command's factor")] = (
        0.15
    )
    wander_deg_m: Annotated[
        float, SLIP, bounded_field(0.0, 10.0, "RMS random turn on 1 m of path; grows with the square root of the path")
    ] = 0.3

    def slip_fraction(self, slope_rad: float) -> float:
        """Return the slip s of a slope, without soil factor and command factor."""
        slope_ratio = abs(np.degrees(slope_rad)) / self.full_slope_deg
        return float(min(self.flat + (1.0 - self.flat) * slope_ratio**self.exponent, 1.0))

    def excess_slip(self, slope_rad: float) -> float:
        """Return the slip of a slope minus the slip on level ground."""
        return self.slip_fraction(slope_rad) - self.flat


@dataclass(frozen=True)
class Soil:
    """Soil of one run: slip parameters, and the soil factor, which multiplies all slip of the run."""

    parameters: SlipParameters
    factor: float

    @classmethod
    def draw(cls, parameters: SlipParameters, rng: np.random.Generator) -> Soil:
        """Draw the soil factor of a run: log-normal with median 1."""
        return cls(parameters, float(np.exp(parameters.soil_spread * rng.standard_normal())))


@dataclass(frozen=True)
class DriveStep:
    """One step of a drive: the wheels' command, which an odometer integrates, and the stances before and after it."""

    command: DriveCommand
    before: Stance
    after: Stance

    @cached_property
    def motion(self) -> RigidTransform:
        """True motion of the step: the pose after it in the rover frame before it."""
        return compose(self.before.world_from_rover.inv(), self.after.world_from_rover)

    @cached_property
    def length_m(self) -> float:
        """Length of the true motion."""
        return float(np.linalg.norm(self.motion.translation))

    @cached_property
    def turn_left_rad(self) -> float:
        """True turn to the left about the rover's z axis; a gyro with this axis integrates it."""
        return float(self.motion.rotation.as_rotvec()[2])

    @property
    def progress_m(self) -> float:
        """True path in the commanded direction; 0 for a turn in place."""
        path = np.array([self.command.forward_m, self.command.left_m])
        if (length := float(np.hypot(*path))) < _MIN_PATH_M:
            return 0.0
        # the chord of an arc is rotated by half of the turn
        chord_rad = float(np.arctan2(path[1], path[0])) + 0.5 * self.command.turn_left_rad
        arc_over_chord = length / max(float(np.hypot(*self.command.displacement_m)), _MIN_PATH_M)
        return arc_over_chord * float(self.motion.translation[:2] @ np.array([np.cos(chord_rad), np.sin(chord_rad)]))


@dataclass(frozen=True)
class Drive:
    """One executed command with its true motion; `parts` are its steps, at least one, whose commands add up to it."""

    command: DriveCommand
    parts: tuple[DriveStep, ...]

    @property
    def start(self) -> Stance:
        """Stance of the rover before the drive."""
        return self.parts[0].before

    @property
    def end(self) -> Stance:
        """Stance of the rover after the drive."""
        return self.parts[-1].after

    @property
    def stances(self) -> tuple[Stance, ...]:
        """Stances of the rover before the drive and after each part."""
        return (self.start, *(part.after for part in self.parts))

    @property
    def length_m(self) -> float:
        """Length of the true path, metres: sum over the parts."""
        return sum(part.length_m for part in self.parts)

    @property
    def turn_left_rad(self) -> float:
        """True turn to the left about the rover's z axis, radians: sum over the parts."""
        return sum(part.turn_left_rad for part in self.parts)

    @property
    def progress_m(self) -> float:
        """True path in the commanded direction, metres: sum over the parts; 0 for a turn in place."""
        return sum(part.progress_m for part in self.parts)

    @property
    def slip(self) -> float:
        """Slip: 1 - true path in the commanded direction / commanded path; NaN for a turn in place."""
        if self.command.length_m < _MIN_PATH_M:
            return float("nan")
        return 1.0 - self.progress_m / self.command.length_m


def drive(
    rover: RoverParameters,
    ground: DrivenGround,
    soil: Soil,
    start: Stance,
    command: DriveCommand,
    rng: np.random.Generator,
) -> Drive:
    """Execute one command (a path forward, backward, sideways or along an arc, or a turn in place) from a stance.

    `rng` draws the slip; the number of draws does not depend on the command.
    """
    p = soil.parameters
    command_draw, wander_draw = rng.standard_normal(2)
    factor = soil.factor * float(np.exp(p.step_spread * command_draw))
    wander_rad = np.radians(p.wander_deg_m) * np.sqrt(command.length_m) * float(wander_draw)
    # 1e-9: tolerance for rounding errors
    count = max(1, int(np.ceil(max(command.length_m / STEP_M, abs(command.turn_left_rad) / STEP_RAD) - 1e-9)))
    step_command = command.part(1.0 / count)
    parts: list[DriveStep] = []
    before = start
    for _ in range(count):
        # slip reduces path and turn; then the rover is settled on the ground at its new position
        rotation = rotation_matrix(before.world_from_rover)
        path = _apply_slip(p, factor, rotation, step_command)
        turn_factor = max(1.0 - factor * (p.turn + p.turn_slope * p.excess_slip(before.tilt_rad)), 0.0)
        turn = turn_factor * step_command.turn_left_rad + wander_rad / count
        motion = DriveCommand(float(path[0]), float(path[1]), float(turn))
        position = before.world_from_rover.translation + rotation[:, :2] @ motion.displacement_m
        forward = rotation @ np.array([np.cos(turn), np.sin(turn), 0.0])
        azimuth = float(np.arctan2(forward[0], forward[1]))
        after = settle(rover, ground, float(position[0]), float(position[1]), azimuth, initial=before)
        parts.append(DriveStep(step_command, before, after))
        before = after
    return Drive(command, tuple(parts))


def _apply_slip(
    p: SlipParameters, factor: float, rotation: Float64[np.ndarray, "3 3"], command: DriveCommand
) -> Float64[np.ndarray, "2"]:
    """Reduce a commanded path by slip; return the true path along the body's x and y axes, metres."""
    path = np.array([command.forward_m, command.left_m])
    length = float(np.hypot(*path))
    if length < _MIN_PATH_M:
        return path
    forward = path / length
    left = np.array([-forward[1], forward[0]])
    # slopes along and across the motion: angles of these axes from the horizontal
    climb, cross_slope = (float(np.arcsin(np.clip(rotation[2, :2] @ axis, -1.0, 1.0))) for axis in (forward, left))
    lost_fraction = factor * (p.flat + (1.0 if climb >= 0.0 else -p.downhill) * p.excess_slip(climb))
    side_fraction = -np.sign(cross_slope) * factor * p.across * p.excess_slip(cross_slope)
    return np.asarray(length * (max(1.0 - lost_fraction, 0.0) * forward + max(-1.0, min(side_fraction, 1.0)) * left))
