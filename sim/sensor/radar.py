"""A radar altimeter: the range to the nearest ground within a wide beam.

The beam is a cone fixed to the body; the first return within it is what is read. Over a slope that is the foot of the
perpendicular, over relief the nearest crest, and when the vehicle tilts by more than the beam's half-width, the beam's
edge. How strongly the ground scatters is left out, as is the antenna's pattern within and outside the cone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.sensor.clock import ClockParameters
from marsyard.sim.sensor.instrument import Readings, Sampling
from marsyard.sim.sensor.ranging import DOWN, RangingParameters, RangingUnit
from marsyard.sim.terrain import Surface

#: The ground is first scanned in steps of this share of the height, then about its nearest points in smaller ones.
COARSEST_STEP = 1.0 / 64.0
REFINEMENT = 5
PASSES = 3
#: Ground about a node may be nearer than the node by this and the node's slope, times the step: as much as is kept.
RELIEF_PER_STEP = 0.2
#: Slopes beyond this are not looked for.
STEEPEST = 3.0


class RadarParameters(RangingParameters):
    """A radar altimeter. Defaults are those of the MER descent: 1 % of altitude is three standard deviations.

    How the 1 % divides into what is common to a descent and what is new in each reading is assumed, as are beam, rate,
    rounding and time tags.
    """

    beam_deg: Annotated[float, Field(gt=0.0, lt=180.0, description="full width of the beam, deg")] = 60.0
    scale_error: Annotated[
        float, Field(ge=0.0, le=0.2, description="share of the range, common to all of a unit's readings")
    ] = 0.003
    noise: Annotated[float, Field(ge=0.0, le=0.2, description="share of the range, new in every reading")] = 0.0015
    count_m: Annotated[float, Field(ge=0.0, le=100.0, description="range of a count, m; 0: no rounding")] = 0.3
    min_range_m: Annotated[float, Field(ge=0.0, description="shortest range that is read, m")] = 5.0
    clock: ClockParameters = ClockParameters(offset_sd_s=0.002, jitter_sd_s=0.001)


@dataclass(frozen=True)
class RadarAltimeter:
    """A radar altimeter over one terrain."""

    parameters: RadarParameters
    surface: Surface
    unit: RangingUnit

    @classmethod
    def drawn(cls, parameters: RadarParameters, surface: Surface, rng: np.random.Generator) -> RadarAltimeter:
        """An altimeter with its constant errors drawn."""
        return cls(parameters, surface, RangingUnit.drawn(parameters, rng))

    @property
    def sampling(self) -> Sampling:
        """When it reads."""
        return self.unit.sampling

    def measure(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator) -> Readings:
        """One reading at each true time: flight software takes it as the altitude."""
        return self.unit.readings(times_s, self.true_ranges(trajectory, times_s), rng)

    def true_ranges(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Range to the nearest ground within the beam, metres; infinite if there is none within reach."""
        motion = trajectory.motion(times_s)
        axes = motion.attitudes.apply(DOWN.copy())
        half_angle = np.radians(0.5 * self.parameters.beam_deg)
        ranges = [
            first_return(self.surface, position, axis, half_angle, self.parameters.max_range_m)
            for position, axis in zip(motion.positions_m, axes, strict=True)
        ]
        return np.array(ranges, dtype=np.float64)


def first_return(
    surface: Surface,
    position_m: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half_angle_rad: float,
    max_range_m: float,
) -> float:
    """Range to the nearest ground within a cone, metres; infinite if there is none within reach.

    Parameters
    ----------
    surface
        The ground.
    position_m
        Apex of the cone, world axes.
    axis
        Unit vector along the cone, world axes.
    half_angle_rad
        Between the cone's axis and its edge.
    max_range_m
        Farthest return looked for.

    Notes
    -----
    Ground within a distance r lies, in plan, within r sin(a) of the apex, a the cone's greatest angle from nadir. Nodes
    of a grid over that square give the nearest ground to a few metres; finer grids about all nodes that might still
    hold the nearest give it to 0.05 % of the height. Ground that is near but outside this square has not been seen, so
    the square grows until the range found is within it.
    """
    clearance = position_m[2] - float(surface.height(float(position_m[0]), float(position_m[1])))
    if clearance <= 0.0:
        return 0.0
    tilt = float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))
    widest = np.sin(min(tilt + half_angle_rad, 0.5 * np.pi))
    nearest_angle = max(tilt - half_angle_rad, 0.0)
    reach = min(1.2 * clearance / max(np.cos(nearest_angle), 0.05), max_range_m)
    while True:
        # far out the steps grow with the reach, which bounds the number of nodes
        step = COARSEST_STEP * max(clearance, 0.5 * reach)
        found = _search(surface, position_m, axis, half_angle_rad, step, reach * widest)
        if found <= reach or reach >= max_range_m:
            return found if found <= max_range_m else np.inf
        reach = min(max(2.0 * reach, found if np.isfinite(found) else 0.0), max_range_m)


def _search(
    surface: Surface,
    position_m: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half_angle_rad: float,
    step_m: float,
    half_side_m: float,
) -> float:
    """Range to the nearest ground that lies within a cone and, in plan, within a square; infinite if there is none."""
    line = np.arange(-np.ceil(half_side_m / step_m), np.ceil(half_side_m / step_m) + 1.0) * step_m
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    nearest = np.inf
    for number in range(PASSES):
        ranges, angles = _seen(surface, position_m, axis, offsets, step_m)
        inside = angles <= half_angle_rad
        if inside.any():
            nearest = float(ranges[inside].min())
        if number == PASSES - 1:
            return nearest
        # a node stands for half a step around it: beyond the edge by as much, nearer by what relief may hide there
        beside = angles <= half_angle_rad + step_m / ranges
        near = beside & (ranges <= nearest + (RELIEF_PER_STEP + STEEPEST) * step_m)
        offsets, ranges = offsets[near], ranges[near]
        slopes = _slopes(surface, position_m, offsets, step_m)
        kept = ranges <= nearest + (RELIEF_PER_STEP + slopes) * step_m
        step_m /= REFINEMENT
        offsets = _refined(offsets[kept], step_m)
        if not offsets.size:
            return nearest
    return nearest


def _seen(
    surface: Surface,
    position_m: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    offsets_m: Float64[np.ndarray, "n 2"],
    step_m: float,
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Range to ground at offsets in plan, and its angle from an axis; the ground is smoothed to the step."""
    level = _level(surface, step_m)
    x, y = position_m[0] + offsets_m[:, 0], position_m[1] + offsets_m[:, 1]
    down = position_m[2] - surface.height(x, y, level)
    ranges = np.sqrt(offsets_m[:, 0] ** 2 + offsets_m[:, 1] ** 2 + down**2)
    along = offsets_m[:, 0] * axis[0] + offsets_m[:, 1] * axis[1] - down * axis[2]
    return ranges, np.arccos(np.clip(along / ranges, -1.0, 1.0))


def _slopes(
    surface: Surface, position_m: Float64[np.ndarray, "3"], offsets_m: Float64[np.ndarray, "n 2"], step_m: float
) -> Float64[np.ndarray, "n"]:
    """Slope of the ground at offsets in plan, smoothed to the step."""
    x, y = position_m[0] + offsets_m[:, 0], position_m[1] + offsets_m[:, 1]
    return np.asarray(np.linalg.norm(surface.gradient(x, y, _level(surface, step_m)), axis=-1))


def _refined(offsets_m: Float64[np.ndarray, "n 2"], step_m: float) -> Float64[np.ndarray, "m 2"]:
    """These nodes, each with its neighbours of a grid `REFINEMENT` times as fine."""
    line = (np.arange(REFINEMENT) - 0.5 * (REFINEMENT - 1)) * step_m
    about = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return np.asarray((offsets_m[:, None, :] + about).reshape(-1, 2))


def _level(surface: Surface, step_m: float) -> int:
    """The level of the pyramid whose samples are about as far apart as a step, or closer."""
    level = np.floor(np.log2(max(step_m / surface.spacing_m, 1.0)))
    return int(min(level, len(surface.levels) - 1))
