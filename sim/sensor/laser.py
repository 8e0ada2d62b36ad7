"""A laser altimeter: the slant range to the ground along an axis of the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.optimize import brentq

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.sensor.clock import ClockParameters
from marsyard.sim.sensor.instrument import Readings, Sampling
from marsyard.sim.sensor.ranging import DOWN, RangingParameters, RangingUnit
from marsyard.sim.terrain import Surface

#: Points along the ray at which the ground is first compared with it, at least.
LEAST_POINTS = 64


class LaserParameters(RangingParameters):
    """A laser altimeter. Defaults are those of a surveying laser on a small helicopter, assumed."""

    rate_hz: Annotated[float, Field(gt=0.0, le=10000.0, description="readings per second")] = 50.0
    noise_m: Annotated[float, Field(ge=0.0, le=100.0, description="at any range, new in every reading, m")] = 0.05
    count_m: Annotated[float, Field(ge=0.0, le=100.0, description="range of a count, m; 0: no rounding")] = 0.01
    max_range_m: Annotated[float, Field(gt=0.0, le=20000.0, description="longest range that is read, m")] = 300.0
    beam_mrad: Annotated[float, Field(ge=0.0, le=50.0, description="full width of the beam, mrad")] = 0.0
    clock: ClockParameters = ClockParameters(offset_sd_s=0.002, jitter_sd_s=0.0005)


@dataclass(frozen=True)
class LaserAltimeter:
    """A laser altimeter over one terrain, its beam along a body axis.

    What a beam of some width reads is the mean range of seven rays that share it evenly.
    """

    parameters: LaserParameters
    surface: Surface
    unit: RangingUnit
    axis_body: Float64[np.ndarray, "3"]

    @classmethod
    def drawn(
        cls,
        parameters: LaserParameters,
        surface: Surface,
        rng: np.random.Generator,
        axis_body: Float64[np.ndarray, "3"] = DOWN,
    ) -> LaserAltimeter:
        """An altimeter with its constant errors drawn, along a unit vector in body axes."""
        return cls(parameters, surface, RangingUnit.drawn(parameters, rng), axis_body)

    @property
    def sampling(self) -> Sampling:
        """When it reads."""
        return self.unit.sampling

    def measure(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator) -> Readings:
        """One slant range at each true time."""
        return self.unit.readings(times_s, self.true_ranges(trajectory, times_s), rng)

    def true_ranges(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Range along the axis to the ground, metres; infinite if there is none within reach."""
        motion = trajectory.motion(times_s)
        width = 1e-3 * self.parameters.beam_mrad
        rays = np.array(self.axis_body)[None] if width == 0.0 else beam_rays(self.axis_body, width)
        axes = np.stack([motion.attitudes.apply(ray) for ray in rays], axis=1)
        ranges = [
            np.mean([range_along(self.surface, position, axis, self.parameters.max_range_m) for axis in beam])
            for position, beam in zip(motion.positions_m, axes, strict=True)
        ]
        return np.array(ranges, dtype=np.float64)


def beam_rays(axis: Float64[np.ndarray, "3"], width_rad: float) -> Float64[np.ndarray, "7 3"]:
    """Unit vectors in the middles of seven equal parts of a round beam's area: its middle and a ring about it.

    Each ray stands for a seventh of the area; the ring lies at the root mean square radius of what the middle leaves.
    """
    sideways = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    sideways /= np.linalg.norm(sideways)
    # outside a seventh of the area r^2 runs evenly from 1/7 to 1 of the beam's radius squared
    ring = 0.5 * width_rad * np.sqrt(4.0 / 7.0)
    turns = np.arange(6) * np.pi / 3.0
    around = np.outer(np.cos(turns), sideways) + np.outer(np.sin(turns), np.cross(axis, sideways))
    rays = np.concatenate([axis[None], axis + np.tan(ring) * around])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def range_along(
    surface: Surface, position_m: Float64[np.ndarray, "3"], axis: Float64[np.ndarray, "3"], max_range_m: float
) -> float:
    """Range from a point along a unit vector, world axes, to the first ground, metres; infinite if there is none.

    The ray is compared with the ground at least once per sample of the terrain; a crest that it grazes between two
    comparisons is missed.
    """
    across = float(np.hypot(axis[0], axis[1])) * max_range_m
    count = LEAST_POINTS + int(np.ceil(across / surface.spacing_m))

    def clearance(distances_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        points = position_m + distances_m[:, None] * axis
        return np.asarray(points[:, 2] - surface.height(points[:, 0], points[:, 1]))

    distances = np.linspace(0.0, max_range_m, count)
    under = np.flatnonzero(clearance(distances) <= 0.0)
    if under.size == 0:
        return np.inf
    if under[0] == 0:
        return 0.0
    return float(brentq(lambda d: float(clearance(np.array([d]))[0]), distances[under[0] - 1], distances[under[0]]))
