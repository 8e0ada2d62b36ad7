"""How a rover moves when its wheels are told to: step by step over the ground, with slip.

A command is driven in small parts. In each the wheels turn as commanded; what the rover does is less by slip, lies in
the plane in which its wheels stand (the body's x and y axes), and ends with the rover at rest on the ground again:

- along the motion, climbing: the share ``s(climb)`` of the path is lost; the climb is the slope in the direction of
  motion. Downhill the rover runs on by a part of that.
- across: it slides downhill by a part of ``s(cross slope)`` of the path.
- turning: a part of ``s(slope)`` of the angle is lost, and a share that scrubbing wheels lose anywhere.

The curve is ``s(a) = s0 + (1 - s0) (a / a1)^p``, at most 1, with a1 the slope of 100 % slip. The defaults, dry sand:
20 % at 10 deg, half at 15 deg, all at 20 deg. The tracking paper saw up to 100 % on 15 to 20 deg (section 5.5), as did
MER's tests on loose sand (Lindemann & Voorhees 2005); Opportunity lost half of its way on Eagle crater's slope of about
15 deg (JPL, March 2004). How slip divides into along, across and turn is assumed. A soil's factor scales all slip of a
run; each command draws another on top.
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
from marsyard.sim.frames import composed, turn_matrix
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.parameters import Fraction, Parameters

#: Longest part of a command: metres of path, and radians of turn.
PART_M, PART_RAD = 0.2, np.radians(5.0)
#: A commanded path shorter than this is none, metres.
_NO_PATH_M = 1e-9


class SlipParameters(Parameters):
    """How wheels slip. Shares of what is commanded; see the module for the curve and its sources."""

    flat: Annotated[Fraction, Field(description="share of the path lost on level ground")] = 0.01
    full_slope_deg: Annotated[
        float, Field(gt=0.0, lt=90.0, description="slope on which nothing of the path is gained, deg")
    ] = 20.0
    exponent: Annotated[float, Field(ge=1.0, le=100.0, description="of the curve from level ground to that slope")] = (
        2.4
    )
    downhill: Annotated[
        Fraction, Field(description="how far the rover runs on downhill, over what it loses uphill")
    ] = 0.3
    across: Annotated[Fraction, Field(description="how far it slides across, over what it would lose uphill")] = 0.5
    turn: Annotated[Fraction, Field(description="share of a turn lost to scrubbing wheels on level ground")] = 0.03
    turn_slope: Annotated[
        Fraction, Field(description="share of a turn lost on a slope, over what a climb would lose")
    ] = 0.5
    soil_spread: Annotated[
        float, Field(ge=0.0, le=1.0, description="RMS of the logarithm of the soil's factor, common to a run")
    ] = 0.15
    step_spread: Annotated[
        float, Field(ge=0.0, le=1.0, description="RMS of the logarithm of a factor new with every command")
    ] = 0.15
    wander_deg_m: Annotated[
        float,
        Field(ge=0.0, le=10.0, description="RMS turn that wheels add on the first metre, growing as its root, deg"),
    ] = 0.3

    def share(self, slope_rad: float) -> float:
        """The curve s at a slope, radians, before soil and step scale it."""
        relative = abs(np.degrees(slope_rad)) / self.full_slope_deg
        return float(min(self.flat + (1.0 - self.flat) * relative**self.exponent, 1.0))


@dataclass(frozen=True)
class Soil:
    """The soil of one run: its parameters, and the factor by which it is more slippery than those say."""

    parameters: SlipParameters
    factor: float

    @classmethod
    def drawn(cls, parameters: SlipParameters, rng: np.random.Generator) -> Soil:
        """A soil with its factor drawn."""
        return cls(parameters, float(np.exp(parameters.soil_spread * rng.standard_normal())))


@dataclass(frozen=True)
class DrivenPart:
    """A part of a drive.

    Attributes
    ----------
    command
        What the wheels were told, and what an odometer that trusts them counts.
    before, after
        The rover at both ends.
    """

    command: DriveCommand
    before: Stance
    after: Stance

    @cached_property
    def motion(self) -> RigidTransform:
        """True motion: the pose after in the axes of the pose before."""
        return composed(self.before.world_from_rover.inv(), self.after.world_from_rover)

    @cached_property
    def length_m(self) -> float:
        """Length of the true motion."""
        return float(np.linalg.norm(self.motion.translation))

    @cached_property
    def turn_left_rad(self) -> float:
        """True turn about the rover's own z axis, to the left: what a gyro there sums up."""
        return float(self.motion.rotation.as_rotvec()[2])


@dataclass(frozen=True)
class Drive:
    """One command, driven.

    Attributes
    ----------
    command
        What was asked for.
    parts
        The motion in the order of time; their commands add up to `command`. At least one.
    """

    command: DriveCommand
    parts: tuple[DrivenPart, ...]

    @property
    def start(self) -> Stance:
        """The rover before."""
        return self.parts[0].before

    @property
    def end(self) -> Stance:
        """The rover after: the truth of the next stop."""
        return self.parts[-1].after

    @property
    def stances(self) -> tuple[Stance, ...]:
        """The rover before, and after each part."""
        return (self.start, *(part.after for part in self.parts))

    @property
    def length_m(self) -> float:
        """Length of the true path."""
        return sum(part.length_m for part in self.parts)

    @property
    def turn_left_rad(self) -> float:
        """True turn about the rover's z axis, to the left."""
        return sum(part.turn_left_rad for part in self.parts)

    @property
    def slip(self) -> float:
        """Fraction of the commanded path that was not gained along it; NaN for a turn in place. Negative: it ran on."""
        if self.command.length_m < _NO_PATH_M:
            return float("nan")
        gained = sum(_along(part) for part in self.parts)
        return 1.0 - gained / self.command.length_m


def drive(
    rover: RoverParameters,
    ground: Ground,
    soil: Soil,
    start: Stance,
    command: DriveCommand,
    rng: np.random.Generator,
) -> Drive:
    """Drives one command: forward, backward, along an arc, sideways, or turning in place.

    Parameters
    ----------
    rover, ground, soil
        What drives on what.
    start
        Where it stands.
    command
        What its wheels are told.
    rng
        Of the drive's slip; the same number of draws whatever the command.
    """
    p = soil.parameters
    step, wander = rng.standard_normal(2)
    factor = soil.factor * float(np.exp(p.step_spread * step))
    strayed = np.radians(p.wander_deg_m) * np.sqrt(command.length_m) * float(wander)
    count = max(1, int(np.ceil(max(command.length_m / PART_M, abs(command.turn_left_rad) / PART_RAD) - 1e-9)))
    told = command.part(1.0 / count)
    parts: list[DrivenPart] = []
    here = start
    for _ in range(count):
        there = _slipped(rover, ground, p, factor, here, told, strayed / count)
        parts.append(DrivenPart(told, here, there))
        here = there
    return Drive(command, tuple(parts))


def _slipped(
    rover: RoverParameters,
    ground: Ground,
    p: SlipParameters,
    factor: float,
    here: Stance,
    told: DriveCommand,
    strayed_rad: float,
) -> Stance:
    """The rover after a part of a command."""
    turn = turn_matrix(here.world_from_rover)
    path = _moved(p, factor, turn, told)
    kept = max(1.0 - factor * (p.turn + p.turn_slope * _share(p, here.tilt_rad)), 0.0)
    turned = kept * told.turn_left_rad + strayed_rad
    done = DriveCommand(float(path[0]), float(path[1]), float(turned))
    place = here.world_from_rover.translation + turn[:, :2] @ done.displacement_m
    forward = turn @ np.array([np.cos(turned), np.sin(turned), 0.0])
    azimuth = float(np.arctan2(forward[0], forward[1]))
    return settle(rover, ground, float(place[0]), float(place[1]), azimuth, near=here)


def _moved(
    p: SlipParameters, factor: float, turn: Float64[np.ndarray, "3 3"], told: DriveCommand
) -> Float64[np.ndarray, "2"]:
    """The path that is gained, in the body's x and y axes, metres."""
    commanded = np.array([told.forward_m, told.left_m])
    length = float(np.hypot(*commanded))
    if length < _NO_PATH_M:
        return commanded
    along = commanded / length
    across = np.array([-along[1], along[0]])
    # slopes of the body's own plane: the world's z of its axes
    climb, cross = (float(np.arcsin(np.clip(turn[2, :2] @ axis, -1.0, 1.0))) for axis in (along, across))
    lost = factor * (p.flat + (1.0 if climb >= 0.0 else -p.downhill) * _share(p, climb))
    aside = -np.sign(cross) * factor * p.across * _share(p, cross)
    return np.asarray(length * (max(1.0 - lost, 0.0) * along + max(-1.0, min(aside, 1.0)) * across))


def _share(p: SlipParameters, slope_rad: float) -> float:
    """What a slope adds to the slip on level ground."""
    return p.share(slope_rad) - p.flat


def _along(part: DrivenPart) -> float:
    """True motion of a part along its commanded direction, metres."""
    ahead = np.array([part.command.forward_m, part.command.left_m])
    if (length := float(np.hypot(*ahead))) < _NO_PATH_M:
        return 0.0
    angle = float(np.arctan2(ahead[1], ahead[0])) + 0.5 * part.command.turn_left_rad
    chord = length / max(float(np.hypot(*part.command.displacement_m)), _NO_PATH_M)
    return chord * float(part.motion.translation[:2] @ np.array([np.cos(angle), np.sin(angle)]))
