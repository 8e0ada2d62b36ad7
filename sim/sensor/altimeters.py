"""Radar and laser altimeters: errors that both have, ranges to the ground, and the true height above it.

A laser measures along a ray. A radar measures the range to the nearest ground point within a cone fixed to the body. On
a slope this is the foot of the perpendicular. Over relief it is a crest. With a tilt of more than half the beam width
it is at the beam's edge. A fraction of the readings can be from the wider cone of the side lobes. Ground reflectivity
is not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field, model_validator
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import ALTITUDE, SIDE_LOBES
from marsyard.sim.parameters import Fraction, Parameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Readings, Sampling, Times, Vector
from marsyard.sim.terrain import Surface

#: Nominal direction of an altimeter in body axes: the optical axis of the descent camera.
DOWN = np.array([0.0, 0.0, -1.0])
MIN_POINTS = 64  #: Minimum number of points along a laser ray that are compared with the ground.
#: Step of the coarsest search grid / height, ratio of successive steps, and number of grids.
COARSEST_STEP, REFINEMENT, GRIDS = 1.0 / 64.0, 5, 3
#: Assumed: ground around a node is nearer than the node by at most (this value + slope at the node) x step.
RELIEF_PER_STEP = 0.2
MAX_SLOPE = 3.0  #: Assumed maximum slope of the ground (rise / run) in the search.

RangeFraction = Annotated[float, Field(ge=0.0, le=0.2)]
RangeDeviation = Annotated[float, Field(ge=0.0, le=100.0)]
_Degrees = Annotated[float, Field(ge=0.0, le=10.0)]


class RangingParameters(Parameters):
    """Parameters of a ranging instrument; errors are standard deviations."""

    scale_error: Annotated[
        RangeFraction, ALTITUDE, Field(description="constant scale error, fraction of the range")
    ] = 0.0
    noise: Annotated[RangeFraction, ALTITUDE, Field(description="noise per reading, fraction of the range")] = 0.0
    noise_m: Annotated[RangeDeviation, ALTITUDE, Field(description="noise per reading, independent of range, m")] = 0.0
    count_m: Annotated[RangeDeviation, Field(description="resolution, m; 0: no rounding")] = 0.0
    min_range_m: Annotated[float, Field(ge=0.0, description="minimum range, m")] = 0.0
    max_range_m: Annotated[float, Field(gt=0.0, le=20000.0, description="maximum range, m")] = 5000.0
    boresight_deg: Annotated[
        _Degrees, ALTITUDE, Field(description="SD per axis of the constant pointing error, deg")
    ] = 0.0

    @model_validator(mode="after")
    def _check_range_limits(self) -> RangingParameters:
        if self.min_range_m >= self.max_range_m:
            limit = self.max_range_m
            raise ValueError(f"min_range_m is {self.min_range_m}; allowed: less than max_range_m, which is {limit}")
        return self


class LaserParameters(RangingParameters):
    """Parameters of a laser altimeter. Defaults: a surveying laser on a small helicopter, assumed.

    The laser is read at the true times of its use: at the images, and at each step of a landing.
    """

    noise_m: Annotated[RangeDeviation, ALTITUDE, Field(description="noise per reading, independent of range, m")] = 0.05
    count_m: Annotated[RangeDeviation, Field(description="resolution, m; 0: no rounding")] = 0.01
    max_range_m: Annotated[float, Field(gt=0.0, le=20000.0, description="maximum range, m")] = 300.0
    boresight_deg: Annotated[
        _Degrees, ALTITUDE, Field(description="SD per axis of the constant pointing error, deg")
    ] = 0.1


@dataclass(frozen=True)
class RangingUnit:
    """A ranging instrument with its constant errors.

    - scale: ratio of measured to true range without noise
    - axis: direction of measurement, body axes
    """

    parameters: RangingParameters
    scale: float
    axis: Vector

    @classmethod
    def draw(cls, parameters: RangingParameters, rng: Generator) -> RangingUnit:
        """Draw the constant errors."""
        p = parameters
        scale = 1.0 + p.scale_error * float(rng.standard_normal())
        tilt = np.radians(p.boresight_deg) * np.append(rng.standard_normal(2), 0.0)
        return cls(p, scale, np.asarray(Rotation.from_rotvec(tilt).apply(DOWN)))

    def read(self, ranges_m: Float64[np.ndarray, "n"], rng: Generator) -> Float64[np.ndarray, "n"]:
        """Simulate the readings of true ranges (infinite without a return); NaN marks a missing reading."""
        p = self.parameters
        relative = self.scale + p.noise * rng.standard_normal(ranges_m.size)
        values = ranges_m * relative + p.noise_m * rng.standard_normal(ranges_m.size)
        if p.count_m > 0.0:
            values = p.count_m * np.rint(values / p.count_m)
        valid = (ranges_m >= p.min_range_m) & (ranges_m <= p.max_range_m)
        return np.where(valid, values, np.nan)


def range_along(surface: Surface, position_m: Vector, axis: Vector, max_range_m: float) -> float:
    """Intersect a ray with the terrain, with at least one point per terrain sample; return the range, or infinity."""
    horizontal_m = float(np.hypot(axis[0], axis[1])) * max_range_m
    count = MIN_POINTS + int(np.ceil(horizontal_m / surface.spacing_m))

    def clearance(distances_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        points = position_m + distances_m[:, None] * axis
        return np.asarray(points[:, 2] - surface.height(points[:, 0], points[:, 1]))

    distances = np.linspace(0.0, max_range_m, count)
    below_ground = np.flatnonzero(clearance(distances) <= 0.0)
    if below_ground.size == 0:
        return np.inf
    if below_ground[0] == 0:
        return 0.0
    return float(
        brentq(lambda d: float(clearance(np.array([d]))[0]), distances[below_ground[0] - 1], distances[below_ground[0]])
    )


def height_above_ground(surface: Surface, positions_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """Compute the true altitude: the height above the ground vertically below each position."""
    return np.asarray(positions_m[:, 2] - surface.height(positions_m[:, 0], positions_m[:, 1]))


class RadarParameters(RangingParameters):
    """Parameters of a radar altimeter. Defaults: the MER descent, with an error of 1 % of altitude.

    The 1 % is that expected of the flight's altimeter (DIMES field test paper, III.D.1). Assumed: 1 % is three standard
    deviations, its split into a constant error and noise, beam, rate, rounding and time tags.
    """

    rate_hz: Annotated[float, Field(gt=0.0, le=10000.0, description="readings per second")] = 10.0
    beam_deg: Annotated[float, Field(gt=0.0, lt=180.0, description="full width of the beam, deg")] = 60.0
    sidelobe_deg: Annotated[float, Field(gt=0.0, lt=180.0, description="full width with the side lobes, deg")] = 120.0
    sidelobe_fraction: Annotated[
        Fraction, SIDE_LOBES, Field(description="fraction of the radar readings that come from side lobes")
    ] = 0.0
    scale_error: Annotated[
        RangeFraction, ALTITUDE, Field(description="constant scale error, fraction of the range")
    ] = 0.003
    noise: Annotated[RangeFraction, ALTITUDE, Field(description="noise per reading, fraction of the range")] = 0.0015
    count_m: Annotated[RangeDeviation, Field(description="resolution, m; 0: no rounding")] = 0.3
    min_range_m: Annotated[float, Field(ge=0.0, description="minimum range, m")] = 5.0
    clock: ClockParameters = ClockParameters(offset_sd_s=0.002, jitter_sd_s=0.001)


@dataclass(frozen=True)
class RadarAltimeter:
    """A radar altimeter over a terrain; flight software uses its range as the altitude."""

    parameters: RadarParameters
    surface: Surface
    sampling: Sampling
    clock: Clock
    unit: RangingUnit

    @classmethod
    def draw(cls, parameters: RadarParameters, surface: Surface, rng: Generator) -> RadarAltimeter:
        """Draw the constant errors."""
        sampling, clock = Sampling.draw(parameters.rate_hz, rng), Clock.draw(parameters.clock, rng)
        return cls(parameters, surface, sampling, clock, RangingUnit.draw(parameters, rng))

    def measure(self, trajectory: Trajectory, times_s: Times, rng: Generator) -> Readings:
        """Measure the range to the nearest ground within the beam at each true time."""
        motion, p = trajectory.motion(times_s), self.parameters
        axes = motion.attitudes.apply(self.unit.axis)
        is_sidelobe = rng.random(times_s.size) < p.sidelobe_fraction
        half_angles = np.radians(0.5 * np.where(is_sidelobe, max(p.sidelobe_deg, p.beam_deg), p.beam_deg))
        ranges = [
            first_return(self.surface, position, axis, float(half_angle), p.max_range_m)
            for position, axis, half_angle in zip(motion.positions_m, axes, half_angles, strict=True)
        ]
        tags = self.clock.tags(times_s, rng)
        return Readings(tags, self.unit.read(np.array(ranges, dtype=np.float64), rng))


def first_return(
    surface: Surface, position_m: Vector, axis: Vector, half_angle_rad: float, max_range_m: float
) -> float:
    """Compute the range to the nearest ground within a cone; infinite if it is beyond the maximum range.

    - position_m, axis: apex of the cone and unit vector along it, world axes
    - half_angle_rad: angle between the cone's axis and its edge

    Let a be the maximum angle of the cone from nadir. In plan view, ground of the cone within a distance r is in the
    square of half side r sin(a) around the apex. A grid over this square determines the range to a few metres. Finer
    grids around candidate nodes reduce the error to 0.05 % of the height. The square is enlarged until r is the range.
    """
    clearance = position_m[2] - float(surface.height(float(position_m[0]), float(position_m[1])))
    if clearance <= 0.0:
        return 0.0
    tilt = float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))
    max_sine = np.sin(min(tilt + half_angle_rad, 0.5 * np.pi))
    min_angle = max(tilt - half_angle_rad, 0.0)
    # initial value: 20 % above the range to flat ground at the cone's edge nearest to nadir
    search_range = min(1.2 * clearance / max(np.cos(min_angle), 0.05), max_range_m)
    while True:
        # the step grows with the search range, which limits the number of nodes
        step = COARSEST_STEP * max(clearance, 0.5 * search_range)
        nearest = _search_nearest_ground(surface, position_m, axis, half_angle_rad, step, search_range * max_sine)
        if nearest <= search_range or search_range >= max_range_m:
            return nearest if nearest <= max_range_m else np.inf
        search_range = min(max(2.0 * search_range, nearest if np.isfinite(nearest) else 0.0), max_range_m)


def _search_nearest_ground(
    surface: Surface, position_m: Vector, axis: Vector, half_angle_rad: float, step_m: float, half_side_m: float
) -> float:
    """Compute the range to the nearest ground within a cone and, in plan view, a square; infinite if there is none."""
    coordinates = np.arange(-np.ceil(half_side_m / step_m), np.ceil(half_side_m / step_m) + 1.0) * step_m
    offsets = np.stack(np.meshgrid(coordinates, coordinates), axis=-1).reshape(-1, 2)
    nearest = np.inf
    for grids_left in reversed(range(GRIDS)):
        # range to the ground (smoothed to the step) at the offsets, and angle from the axis
        level = int(min(np.floor(np.log2(max(step_m / surface.spacing_m, 1.0))), len(surface.levels) - 1))
        x, y = position_m[0] + offsets[:, 0], position_m[1] + offsets[:, 1]
        depths = position_m[2] - surface.height(x, y, level)
        ranges = np.sqrt(offsets[:, 0] ** 2 + offsets[:, 1] ** 2 + depths**2)
        axial = offsets[:, 0] * axis[0] + offsets[:, 1] * axis[1] - depths * axis[2]
        angles = np.arccos(np.clip(axial / ranges, -1.0, 1.0))
        is_in_cone = angles <= half_angle_rad
        if is_in_cone.any():
            nearest = float(ranges[is_in_cone].min())
        if grids_left == 0:
            break
        # candidates: nodes within a step of the cone whose surroundings can contain nearer ground
        candidates = (angles <= half_angle_rad + step_m / ranges) & (
            ranges <= nearest + (RELIEF_PER_STEP + MAX_SLOPE) * step_m
        )
        slopes = np.linalg.norm(surface.gradient(x[candidates], y[candidates], level), axis=-1)
        may_be_nearest = ranges[candidates] <= nearest + (RELIEF_PER_STEP + slopes) * step_m
        offsets = offsets[candidates][may_be_nearest]
        # replace each node by the nodes of a finer grid around it
        step_m /= REFINEMENT
        fine_coordinates = (np.arange(REFINEMENT) - 0.5 * (REFINEMENT - 1)) * step_m
        neighbours = np.stack(np.meshgrid(fine_coordinates, fine_coordinates), axis=-1).reshape(-1, 2)
        offsets = np.asarray((offsets[:, None, :] + neighbours).reshape(-1, 2))
        if not offsets.size:
            break
    return nearest
