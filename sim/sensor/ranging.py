"""Ranging instruments: common errors, laser ranges along a ray, and the true height above ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field, model_validator
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from marsyard.sim.error_sources import ALTITUDE
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Readings, Sampling, Times, Vector
from marsyard.sim.terrain import Surface

#: Nominal direction of an altimeter in body axes: the optical axis of the descent camera.
DOWN = np.array([0.0, 0.0, -1.0])
MIN_POINTS = 64  #: Minimum number of points along a laser ray that are compared with the ground.

RangeFraction = Annotated[float, Field(ge=0.0, le=0.2)]
RangeDeviation = Annotated[float, Field(ge=0.0, le=100.0)]
_Degrees = Annotated[float, Field(ge=0.0, le=10.0)]


class RangingParameters(Parameters):
    """Parameters of a ranging instrument; errors are standard deviations."""

    rate_hz: Annotated[float, Field(gt=0.0, le=10000.0, description="readings per second")] = 10.0
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
    clock: ClockParameters = ClockParameters()

    @model_validator(mode="after")
    def _check_range_limits(self) -> RangingParameters:
        if self.min_range_m >= self.max_range_m:
            limit = self.max_range_m
            raise ValueError(f"min_range_m is {self.min_range_m}; allowed: less than max_range_m, which is {limit}")
        return self


class LaserParameters(RangingParameters):
    """Parameters of a laser altimeter. Defaults: a surveying laser on a small helicopter, assumed."""

    rate_hz: Annotated[float, Field(gt=0.0, le=10000.0, description="readings per second")] = 50.0
    noise_m: Annotated[RangeDeviation, ALTITUDE, Field(description="noise per reading, independent of range, m")] = 0.05
    count_m: Annotated[RangeDeviation, Field(description="resolution, m; 0: no rounding")] = 0.01
    max_range_m: Annotated[float, Field(gt=0.0, le=20000.0, description="maximum range, m")] = 300.0
    boresight_deg: Annotated[
        _Degrees, ALTITUDE, Field(description="SD per axis of the constant pointing error, deg")
    ] = 0.1
    clock: ClockParameters = ClockParameters(offset_sd_s=0.002, jitter_sd_s=0.0005)


@dataclass(frozen=True)
class RangingUnit:
    """A ranging instrument with its constant errors.

    - scale: ratio of measured to true range without noise
    - axis: direction of measurement, body axes
    """

    parameters: RangingParameters
    sampling: Sampling
    clock: Clock
    scale: float
    axis: Vector

    @classmethod
    def draw(cls, parameters: RangingParameters, rng: Generator) -> RangingUnit:
        """Draw the constant errors."""
        p = parameters
        sampling, clock = Sampling.draw(p.rate_hz, rng), Clock.draw(p.clock, rng)
        scale = 1.0 + p.scale_error * float(rng.standard_normal())
        tilt = np.radians(p.boresight_deg) * np.append(rng.standard_normal(2), 0.0)
        return cls(p, sampling, clock, scale, np.asarray(Rotation.from_rotvec(tilt).apply(DOWN)))

    def readings(self, times_s: Times, ranges_m: Float64[np.ndarray, "n"], rng: Generator) -> Readings:
        """Simulate readings of true ranges (infinite without a return) at true times."""
        p = self.parameters
        tags = self.clock.tags(times_s, rng)
        relative = self.scale + p.noise * rng.standard_normal(times_s.size)
        values = ranges_m * relative + p.noise_m * rng.standard_normal(times_s.size)
        if p.count_m > 0.0:
            values = p.count_m * np.rint(values / p.count_m)
        valid = (ranges_m >= p.min_range_m) & (ranges_m <= p.max_range_m)
        return Readings(tags, np.where(valid, values, np.nan))


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
