"""Dunes, lava flows, swells, ramps and impact craters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive
from marsyard.sim.terrain.landforms.ground import Ground, resampled, smooth_pair
from marsyard.sim.terrain.landforms.kernels import Bedforms, add_dunes, stamp_lobes

if TYPE_CHECKING:
    from marsyard.sim.terrain.parameters import TerrainParameters

#: Samples a slip face should have along its slope.
SAMPLES_ON_SLIP_FACE = 2.1
#: RMS displacement of a lobe's outline, in half widths.
CRENULATION = 0.28
#: RMS of a cubic B-spline over that of its control values, where these are independent: 151/315.
SPLINE_OF_NOISE_RMS = 151.0 / 315.0
EJECTA_REACH_RADII = 3.0
#: Depth from the rim crest to the floor over diameter: 0.2 for fresh simple craters (Pike 1977; Robbins & Hynek 2012
#: for Mars), down to what is barely visible. Small Martian craters are mostly degraded (Golombek et al. 2014).
FRESH_DEPTH, DEGRADED_DEPTH = 0.2, 0.04
#: Height of the rim crest above the surroundings over diameter: 0.04 fresh (Pike 1977); diffusion lowers it faster
#: than the bowl.
FRESH_RIM, DEGRADED_RIM = 0.04, 0.004
#: Height over which the rim is rounded, as a fraction of the depth.
SHARPEST_RIM, ROUNDEST_RIM = 0.08, 0.9
#: Fraction of the original bowl's depth that is filled in the most degraded craters.
DEEPEST_FILL = 0.45
#: Freshness above which ejecta keep their own brightness.
BRIGHT_ABOVE = 0.75


class Dunes(Parameters):
    """A train of transverse bedforms: gentle towards the wind, a slip face with an apron at its foot away from it.

    Dunes and ripples differ in size, and ripples of wind, which do not avalanche, fall at about 20 deg where dunes rest
    at the angle of repose (Sharp 1963). Crests wander and end in defects, as they do where bedforms of a range of
    wavelengths interact (Werner & Kocurek 1999). Dry sand rests at 30-34 deg (Bagnold 1941).
    """

    wavelength_m: Annotated[Positive, Field(description="distance from crest to crest, m")] = 110.0
    height_m: Annotated[Positive, Field(description="RMS height of crest over trough, m")] = 5.0
    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth the wind comes from")] = 270.0
    repose_deg: Annotated[float, Field(ge=10.0, le=36.0, description="slope of the faces away from the wind")] = 32.0
    crest_length: Annotated[float, Field(ge=0.5, le=50.0, description="length of crests, wavelengths")] = 4.0
    regularity: Annotated[float, Field(ge=0.3, le=20.0, description="wavelengths over which spacing persists")] = 1.5
    albedo_contrast: Annotated[
        float, Field(ge=-1.0, le=1.0, description="logarithm of crests' albedo over troughs'")
    ] = 0.05

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the dunes. The wave is the nearest one, in length and direction, that fits into the period."""
        # the wave travels downwind; azimuth is clockwise from north, x is east
        downwind = np.radians(90.0 - (self.wind_from_deg + 180.0))
        waves = ground.period_m / self.wavelength_m * np.array([np.cos(downwind), np.sin(downwind)])
        whole = np.round(waves)
        if not whole.any():
            raise ValueError(
                f"dunes.wavelength_m is {self.wavelength_m:g}; the terrain's side is {ground.period_m:g} m"
            )
        wave = 2.0 * np.pi * whole / ground.period_m
        across, along = (length * self.wavelength_m / np.sqrt(2.0) for length in (self.crest_length, self.regularity))
        modulation = smooth_pair(ground.period_m, across, along, float(downwind), rng)
        step = max(modulation.shape[0] // ground.side, 1)
        modulation = np.ascontiguousarray(modulation[::step, ::step])
        steepest = float(np.tan(np.radians(self.repose_deg)))
        slip_face_m = self.height_m / steepest
        part = ground.coarser(min(slip_face_m / SAMPLES_ON_SLIP_FACE, ground.period_m / modulation.shape[0]))
        bedforms = Bedforms(float(wave[0]), float(wave[1]), self.height_m, steepest, self.albedo_contrast)
        add_dunes(part.height, part.tone, part.spacing_m, modulation, bedforms)
        ground.add(part)


class Lava(Parameters):
    """Numerous thin flows, as at Pisgah: rough at a few metres, gentle beyond (Wood & Kienle 1990; field test III.A).

    Lobes of 1-3 m thickness overlap; a'a covers patches with blocks and pinnacles of a few metres.
    """

    layers: Annotated[float, Field(gt=0.0, le=10.0, description="lobes lying over one another, on average")] = 3.0
    lobe_length_m: Annotated[Positive, Field(description="median length of a lobe, m")] = 210.0
    lobe_thickness_m: Annotated[NonNegative, Field(description="median thickness of a lobe, m")] = 1.5
    flow_to_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth the flows run to")] = 280.0
    lobe_contrast: Annotated[Fraction, Field(description="RMS of the lobes' log albedo")] = 0.05
    aa_share: Annotated[Fraction, Field(description="share of the ground under a'a")] = 0.25
    aa_block_m: Annotated[Positive, Field(description="size of its blocks, m")] = 6.0
    aa_relief_m: Annotated[NonNegative, Field(description="RMS height of its blocks, m")] = 0.45
    aa_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="log albedo of a'a over pahoehoe's")] = -0.06
    pahoehoe_relief_m: Annotated[
        NonNegative, Field(description="RMS height of hummocks of the blocks' size on pahoehoe, m")
    ] = 0.05

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the flows, then the blocks."""
        part = ground.coarser(max(self.lobe_length_m / 36.0, self.lobe_thickness_m))
        crenulation = self.lobe_length_m / 12.0
        warp = np.float32(CRENULATION) * smooth_pair(ground.period_m, crenulation, crenulation, 0.0, rng)
        lobes = self._lobes(ground.period_m, rng)
        warp_x, warp_y = (resampled(warp[..., axis], part.side) for axis in (0, 1))
        stamp_lobes(part.height, part.tone, part.spacing_m, lobes, warp_x, warp_y)
        ground.add(part)
        self._add_blocks(ground, rng)

    def _lobes(self, period_m: float, rng: np.random.Generator) -> np.ndarray:
        """Rows of `stamp_lobes`, in random order: log-normal lengths, two to four times as long as wide."""
        spread = 0.5
        mean_area = np.pi / 4.0 * self.lobe_length_m**2 * np.exp(2.0 * spread**2) * 0.38
        count = int(rng.poisson(self.layers * period_m**2 / mean_area))
        half_length = 0.5 * self.lobe_length_m * np.exp(spread * rng.standard_normal(count))
        half_width = half_length / rng.uniform(2.0, 4.0, count)
        thickness = self.lobe_thickness_m * np.exp(0.35 * rng.standard_normal(count))
        heading = np.radians(90.0 - self.flow_to_deg) + 0.45 * rng.standard_normal(count)
        position = rng.uniform(0.0, period_m, (count, 2))
        tone = self.lobe_contrast * rng.standard_normal(count)
        return np.column_stack([position, half_length, half_width, thickness, np.cos(heading), np.sin(heading), tone])

    def _add_blocks(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add noise of the blocks' size, strong in patches bounded by a level line of a smooth field."""
        blocks = ground.coarser(self.aa_block_m / 2.0)
        patches = np.zeros((blocks.side, blocks.side), dtype=np.float32)
        for scale, strength in ((1.0, 1.0), (0.35, 0.45), (0.12, 0.2)):
            size = scale * self.lobe_length_m
            field = smooth_pair(ground.period_m, size, size, 0.0, rng)[..., 0]
            patches += np.float32(strength) * resampled(field, blocks.side)
        threshold = float(np.quantile(patches[::4, ::4], 1.0 - self.aa_share))
        cover = np.clip((patches - np.float32(threshold)) * np.float32(6.0) + np.float32(0.5), 0.0, 1.0)
        relief = np.float32(self.pahoehoe_relief_m) + np.float32(self.aa_relief_m - self.pahoehoe_relief_m) * cover
        relief *= rng.standard_normal(relief.shape, dtype=np.float32)
        relief *= np.float32(1.0 / SPLINE_OF_NOISE_RMS)
        blocks.height[...] = relief
        np.multiply(cover, np.float32(self.aa_contrast), out=blocks.tone)
        ground.add(blocks)


class Swell(Parameters):
    """Broad relief of a stated height: a few waves of the order of the terrain's side, as the mass of a dune field."""

    relief_m: Annotated[Positive, Field(description="lowest to highest, m")] = 200.0
    waves: Annotated[int, Field(ge=1, le=8, description="most waves along a side")] = 1

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the swell."""
        part = ground.coarser(ground.period_m / 64.0)
        phase = 2.0 * np.pi * np.arange(part.side) / part.side
        field = np.zeros((part.side, part.side))
        for m in range(self.waves + 1):
            for n in range(-self.waves, self.waves + 1):
                if (m, n) <= (0, 0):
                    continue
                strength = rng.uniform(0.7, 1.0) / (m * m + n * n) ** 1.25
                shift = rng.uniform(0.0, 2.0 * np.pi)
                field += strength * np.cos(m * phase[None, :] + n * phase[:, None] + shift)
        field *= self.relief_m / np.ptp(field)
        part.height[...] = field
        ground.add(part, tone=False)


class Ramp(Parameters):
    """An even slope for driving tests, as part of a ridge, because the ground repeats.

    Along the direction of `uphill` the ground is level, climbs at the stated slope over `length_m`, is level on top and
    descends at the same slope; across it nothing changes. The climb is centred a quarter of the period from the
    terrain's edge (east_m or north_m = 0.25 period), the descent at three quarters. Bends are rounded over a
    tenth of the slope's length.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=40.0, description="slope of the ramp")] = 8.0
    length_m: Annotated[Positive, Field(description="horizontal length of the even slope, m")] = 30.0
    uphill: Annotated[Literal["east", "north"], Field(description="direction in which the first slope climbs")] = "east"

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the ramp."""
        period = ground.period_m
        longest = 0.45 * period
        if self.length_m > longest:
            raise ValueError(f"ramp.length_m is {self.length_m:g}; at most {longest:g} fit on this terrain")
        position = np.arange(ground.side) * ground.spacing_m
        bend = 0.1 * self.length_m
        climb, fall = (
            np.clip((0.5 * self.length_m + bend / 2.0 - np.abs(position - at * period)) / bend, 0.0, 1.0)
            for at in (0.25, 0.75)
        )
        rise = climb - fall
        profile = (np.cumsum(rise) - 0.5 * rise) * ground.spacing_m * np.tan(np.radians(self.slope_deg))
        profile = (profile - profile.mean()).astype(np.float32)
        np.add(ground.height, profile[None, :] if self.uphill == "east" else profile[:, None], out=ground.height)


def draw_craters(parameters: TerrainParameters, rng: np.random.Generator) -> Float64[np.ndarray, "craters 15"]:
    """Draw impact craters, the largest first, as rows of `kernels.stamp_craters`.

    Their number is Poisson; diameters follow the truncated power law ``N(>D) ~ D**-exponent``. Freshness is ``u**2``,
    u uniform: a crater is degraded for most of its life. Outlines are out of round by a few per cent.
    """
    smallest, largest = parameters.crater_diameter_min_m, parameters.crater_diameter_max_m
    if largest <= smallest:
        raise ValueError(
            f"crater_diameter_max_m is {largest:g}; it must be larger than crater_diameter_min_m, {smallest:g}"
        )
    period = parameters.samples * parameters.spacing_m
    count = int(rng.poisson(parameters.craters_per_km2 * (period / 1000.0) ** 2))
    exponent = parameters.crater_exponent
    fraction_above = rng.uniform((largest / smallest) ** -exponent, 1.0, count)
    diameter = np.sort(smallest * fraction_above ** (-1.0 / exponent))[::-1]
    fresh = rng.uniform(0.0, 1.0, count) ** 2
    position = rng.uniform(0.0, period, (count, 2))
    rim = diameter * (DEGRADED_RIM + (FRESH_RIM - DEGRADED_RIM) * fresh)
    depth = diameter * (DEGRADED_DEPTH + (FRESH_DEPTH - DEGRADED_DEPTH) * fresh) - rim
    rounding = depth * (ROUNDEST_RIM + (SHARPEST_RIM - ROUNDEST_RIM) * fresh)
    fill = DEEPEST_FILL * (1.0 - fresh)
    bright = parameters.crater_ejecta_contrast * np.maximum(fresh - BRIGHT_ABOVE, 0.0) / (1.0 - BRIGHT_ABOVE)
    bright *= rng.choice([-1.0, 1.0], count)
    outline = rng.standard_normal((count, 6)) * np.repeat([0.025, 0.02, 0.012], 2)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.column_stack([position, diameter / 2.0, depth, rim, rounding, fill, bright, outline, phase])
