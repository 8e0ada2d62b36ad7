"""Relief: swells, ramps, and winding channels such as gullies."""

from itertools import product
from typing import Annotated, Literal

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.kernels.shapes import cut_channels

#: Exponent of a gully's profile (`cut_channels`); wander of its direction (`draw_channels`), radians (assumed).
_SHARPNESS, _WANDER_RAD = 1.5, 0.15
Channels = Float64[np.ndarray, "channels"]  #: One value per channel.
Points = Float64[np.ndarray, "channels 2"]


class Swell(Parameters):
    """Broad relief of a specified height, such as a dune field: a few waves about as long as the terrain's side."""

    relief_m: Annotated[Positive, Field(description="lowest to highest, m")] = 200.0
    waves: Annotated[int, Field(ge=1, le=8, description="maximum number of waves along a side")] = 1

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the swell."""
        layer = ground.coarser(ground.period_m / 64.0)
        phase = 2.0 * np.pi * np.arange(layer.side) / layer.side
        field = np.zeros((layer.side, layer.side))
        for m, n in product(range(self.waves + 1), range(-self.waves, self.waves + 1)):
            if (m, n) > (0, 0):  # a wave with the opposite wave vector is the same wave
                strength = rng.uniform(0.7, 1.0) / (m * m + n * n) ** 1.25
                shift = rng.uniform(0.0, 2.0 * np.pi)
                field += strength * np.cos(m * phase[None, :] + n * phase[:, None] + shift)
        field *= self.relief_m / np.ptp(field)
        layer.height[...] = field
        ground.add(layer, include_albedo=False)


class Ramp(Parameters):
    """Slope of constant angle for driving tests, as one side of a ridge, because the ground is periodic.

    Along the direction `uphill` the ground is level, climbs with the slope `slope_deg` over `length_m`, is level again
    and descends with the same slope. Perpendicular to it the profile is constant. The centre of the climb is at a
    quarter of the period (east_m or north_m = 0.25 period), that of the descent at three quarters. Bends are rounded
    over a tenth of the length of the slope.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=40.0, description="slope of the ramp")] = 8.0
    length_m: Annotated[Positive, Field(description="horizontal length of the even slope, m")] = 30.0
    uphill: Annotated[Literal["east", "north"], Field(description="direction in which the first slope climbs")] = "east"

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the ramp."""
        period = ground.period_m
        max_length = 0.45 * period
        if self.length_m > max_length:
            raise ValueError(f"ramp.length_m is {self.length_m:g}; at most {max_length:g} fit on this terrain")
        position = np.arange(ground.side) * ground.spacing_m
        bend = 0.1 * self.length_m
        climb, fall = (
            np.clip((0.5 * self.length_m + bend / 2.0 - np.abs(position - centre * period)) / bend, 0.0, 1.0)
            for centre in (0.25, 0.75)
        )
        relative_slope = climb - fall
        profile = np.cumsum(relative_slope) - 0.5 * relative_slope
        profile = profile * ground.spacing_m * np.tan(np.radians(self.slope_deg))
        profile = (profile - profile.mean()).astype(np.float32)
        np.add(ground.height, profile[None, :] if self.uphill == "east" else profile[:, None], out=ground.height)


def draw_channels(
    start: Points, heading: Channels, length: Channels, width: Channels, depth: Channels, wander: float, rng: Generator
) -> Float64[np.ndarray, "discs 4"]:
    """Draw winding channels as rows of discs (x, y, half width, depth) with a spacing of a quarter of their width.

    The direction of a channel deviates from its heading (radians, counter-clockwise from x) by a first-order
    Gauss-Markov process. Its correlation length is eight widths, its RMS about four times `wander` (radians): each step
    adds noise with the standard deviation `wander`. Both ends of a channel are narrow and shallow.
    """
    channels = [np.empty((0, 4))]
    for origin, mean_heading, length_m, width_m, depth_m in zip(start, heading, length, width, depth, strict=True):
        step = 0.25 * width_m
        count = max(int(length_m / step), 2)
        correlation = np.exp(-step / (8.0 * width_m))
        noise = 2.0 * wander * np.sqrt(step / width_m) * rng.standard_normal(count)
        deviation = np.asarray(scipy.signal.lfilter([1.0], [1.0, -correlation], noise))
        steps = np.column_stack([np.cos(mean_heading + deviation), np.sin(mean_heading + deviation)]) * step
        fraction = (np.arange(count) + 0.5) / count
        taper = np.sqrt(np.minimum(1.0, 8.0 * fraction) * np.minimum(1.0, 5.0 * (1.0 - fraction)))
        position = origin + np.cumsum(steps, axis=0)
        channels.append(np.column_stack([position, 0.5 * width_m * np.maximum(taper, 0.3), depth_m * taper]))
    return np.concatenate(channels)


class Gullies(Parameters):
    """Steep-walled gullies, which are landing hazards: trunks with tributaries, and walls with a specified slope."""

    per_km2: Annotated[NonNegative, Field(description="trunks per square kilometre")] = 200.0
    width_m: Annotated[Positive, Field(description="median width of a trunk from rim to rim, m")] = 6.0
    wall_slope_deg: Annotated[float, Field(gt=0.0, le=60.0, description="steepest slope of the walls")] = 35.0
    length_m: Annotated[Positive, Field(description="mean length of a trunk, m")] = 90.0
    tributaries: Annotated[int, Field(ge=0, le=50, description="tributaries of a trunk")] = 4
    downhill_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth to which they run")] = 90.0
    contrast: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of their floors / of the ground)")] = -0.1

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Cut the gullies."""
        # until the channels are complete, the albedo grid of `layer` contains their depth
        layer = ground.coarser(self.width_m / 12.0)
        count = int(rng.poisson(self.per_km2 * (ground.period_m / 1000.0) ** 2))
        heading = np.radians(90.0 - self.downhill_deg) + 0.3 * rng.standard_normal(count)
        width = self.width_m * np.exp(0.3 * rng.standard_normal(count))
        length = self.length_m * rng.uniform(0.6, 1.4, count)
        start = rng.uniform(0.0, ground.period_m, (count, 2))
        # the depth is proportional to the width
        depth = width * self._compute_depth(1.0)
        trunks = draw_channels(start, heading, length, width, depth, _WANDER_RAD, rng)
        cut_channels(layer.log_albedo, layer.spacing_m, trunks, _SHARPNESS)
        if self.tributaries and trunks.size:
            mouths = trunks[rng.integers(0, len(trunks), count * self.tributaries)]
            start, half_width, _ = np.split(mouths, [2, 3], axis=1)
            heading = np.radians(90.0 - self.downhill_deg) + np.pi + rng.choice([-0.7, 0.7], len(mouths))
            width = half_width[:, 0] * 2.0 * rng.uniform(0.35, 0.6, len(mouths))
            length = 6.0 * width + 0.1 * self.length_m
            depth = width * self._compute_depth(1.0)
            branches = draw_channels(start, heading, length, width, depth, _WANDER_RAD, rng)
            cut_channels(layer.log_albedo, layer.spacing_m, branches, _SHARPNESS)
        layer.height[...] = -layer.log_albedo
        layer.log_albedo[...] *= np.float32(self.contrast / (0.5 * self._compute_depth(self.width_m)))
        np.clip(layer.log_albedo, -abs(self.contrast), abs(self.contrast), out=layer.log_albedo)
        ground.add(layer)

    def _compute_depth(self, width: float) -> float:
        """Compute the depth of a gully from its width and the slope of its walls, m.

        The profile of `cut_channels` is steepest at the rim: `_SHARPNESS` times depth divided by half width.
        """
        return float(0.5 * width * np.tan(np.radians(self.wall_slope_deg)) / _SHARPNESS)
