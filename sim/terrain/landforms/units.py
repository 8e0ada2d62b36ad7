"""Surface units: patches of ground with their own albedo, roughness, texture and rock density.

Orbital mosaics of the Martian plains show such units with boundaries from ten to hundreds of metres: dust-mantled
plains, soil with a lag of granules, rubble and outcrop, sand sheets (Greeley et al. 2006; Golombek et al. 2006 for
Gusev; Sullivan et al. 2005 for Meridiani).
"""

from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32
from numpy.random import Generator
from pydantic import Field
from scipy.ndimage import gaussian_filter

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.craters import crater_freshness
from marsyard.sim.terrain.landforms.ground import Grid, TerrainGround, refine
from marsyard.sim.terrain.landforms.kernels.shapes import cut_channels, scale_roughness, stamp_streaks
from marsyard.sim.terrain.landforms.random_fields import Spectrum
from marsyard.sim.terrain.landforms.relief import draw_channels
from marsyard.sim.terrain.surface import ROCKS, ROUGHNESS

#: Samples of the terrain per sample of the factors (see `Surface`), along each side.
FACTOR_STEP = 4
#: Hurst exponent of the fields whose level lines bound the units: outlines have the fractal dimension 2 - H = 1.4.
OUTLINE_HURST = 0.6
#: Iterations of the fit of the units' areas, and maximum number of samples along each side for this fit.
_FIT_STEPS, _FIT_SIDE = 40, 128


def compute_relative_height(ground: TerrainGround, largest_m: float) -> Grid:
    """Compute the height above the mean of the surroundings, metres: positive on crests, negative in valleys.

    The mean is weighted by a Gaussian with a standard deviation of a quarter of `largest_m`. The grid is that of the
    factors.
    """
    height = ground.height[::FACTOR_STEP, ::FACTOR_STEP]
    deviation = 0.25 * largest_m * len(height) / ground.period_m
    # the mean is smooth: samples every half standard deviation are enough
    step = 2 ** max(int(np.log2(0.5 * deviation)), 0)
    mean = gaussian_filter(height[::step, ::step], deviation / step, mode="wrap")
    return np.asarray(height - refine(mean, len(height)))


class SurfaceUnit(Parameters):
    """One type of ground. Factors are relative to the terrain's own values; a factor of 1 leaves them unchanged."""

    name: Annotated[str, Field(min_length=1, description="name of the unit")]
    fraction: Annotated[Fraction, Field(description="expected fraction of the terrain's area")]
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "logarithm of albedo divided by the terrain's mean")] = 0.0
    roughness: Annotated[NonNegative, Field(description="factor of fine relief")] = 1.0
    texture: Annotated[NonNegative, Field(description="factor of fine albedo contrast")] = 1.0
    rocks: Annotated[NonNegative, Field(description="factor of rock density")] = 1.0
    elevation: Annotated[
        float, bounded_field(-5.0, 5.0, "preference for high ground, if positive, or low ground; 0: none")
    ] = 0.0
    craters: Annotated[float, bounded_field(-5.0, 5.0, "preference for the surroundings of craters; 0: none")] = 0.0


class SurfaceUnits(Parameters):
    """A map of surface units. The ground belongs to the unit with the largest random field.

    The field of a unit increases with the height above the surroundings (see `compute_relative_height`) times the
    unit's `elevation`, so that its borders follow valleys, crests and scarps: both have the standard deviation 1.
    The areas vary from terrain to terrain by a Dirichlet distribution around the expected fractions.
    """

    kinds: Annotated[tuple[SurfaceUnit, ...], Field(min_length=1, description="the units")]
    largest_m: Annotated[Positive, Field(description="size of the largest patches, m")] = 500.0
    smallest_m: Annotated[Positive, Field(description="size of the smallest patches, m")] = 10.0
    boundary: Annotated[Positive, Field(description="softness of boundaries, standard deviations of the field")] = 0.15
    elongation: Annotated[
        float, Field(ge=1.0, le=10.0, description="length of patches along the wind divided by width")
    ] = 2.0
    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="mean azimuth from which the wind blows")] = 0.0
    wind_spread_deg: Annotated[NonNegative, Field(description="SD of this azimuth between terrains, deg")] = 20.0
    concentration: Annotated[
        Positive, Field(description="concentration of the Dirichlet distribution; areas vary less if larger")
    ] = 8.0

    tracks_per_km2: Annotated[NonNegative, Field(description="tracks of dust devils per km2")] = 0.0
    track_log_albedo: Annotated[
        float, bounded_field(-1.0, 0.0, "logarithm of a track's albedo divided by the ground's")
    ] = -0.12
    track_width_m: Annotated[Positive, Field(description="median width of a track, m")] = 25.0
    track_length_m: Annotated[Positive, Field(description="mean length of a track, m")] = 900.0
    streak_fraction: Annotated[Fraction, Field(description="fraction of craters with a wind tail")] = 0.0
    streak_min_m: Annotated[Positive, Field(description="smallest diameter of craters with a tail, m")] = 20.0
    streak_log_albedo_rms: Annotated[Fraction, Field(description="RMS of the logarithm of albedo of tails")] = 0.12

    def apply(self, ground: TerrainGround, craters: np.ndarray, rng: Generator) -> Float32[np.ndarray, "side side 3"]:
        """Add the albedo of units, dust devil tracks and wind tails (streaks) of craters to the ground.

        `craters` is a table of type `CRATER`. Returns the factors of roughness, texture and rocks (see
        `Surface`). Craters change the roughness: filled floors are smoother, fresh ejecta are rougher.
        """
        units = self.kinds
        expected_areas = np.array([unit.fraction for unit in units])
        areas = rng.dirichlet(self.concentration * expected_areas / expected_areas.sum())
        side = ground.side // FACTOR_STEP
        spacing = ground.period_m / side
        downwind = np.radians(270.0 - self.wind_from_deg - self.wind_spread_deg * rng.standard_normal())
        spectrum = Spectrum.power_law(side, spacing, OUTLINE_HURST, self.largest_m, self.elongation, downwind)
        spectrum = spectrum.apply_low_pass(self.smallest_m)
        fields = np.stack([spectrum.draw_field(rng, 1.0) for _ in units], axis=-1)
        elevation = np.array([unit.elevation for unit in units], dtype=np.float32)
        if elevation.any():
            height = compute_relative_height(ground, self.largest_m)
            fields += (height / max(float(height.std()), 1e-6))[..., None] * elevation
        halo = np.array([unit.craters for unit in units], dtype=np.float32)
        if halo.any():
            fields += self._draw_halos(craters, side, spacing, downwind, rng)[..., None] * halo
        membership = self._compute_membership(fields, areas)
        unit_factors = np.array([(unit.roughness, unit.texture, unit.rocks) for unit in units])
        factors = np.exp(membership @ np.log(np.maximum(unit_factors, 1e-3)).astype(np.float32))
        log_albedo = np.ascontiguousarray(membership @ np.array([unit.log_albedo for unit in units], dtype=np.float32))
        self._add_tracks(log_albedo, spacing, downwind, rng)
        ground.add(TerrainGround(np.zeros_like(log_albedo), log_albedo, spacing))
        self._add_streaks(ground, craters, downwind, rng)
        if len(craters):
            # assumed factors of roughness on the floor and on the ejecta
            floor_factor, ejecta_factor = (
                1.0 - 0.8 * craters["fill"],
                1.0 + np.clip(crater_freshness(craters), 0.0, 1.0),
            )
            circles = (craters["x"], craters["y"], craters["radius"])
            crater_factors = np.column_stack([*circles, floor_factor, ejecta_factor])
            roughness = np.ascontiguousarray(factors[..., ROUGHNESS])
            scale_roughness(roughness, spacing, crater_factors, 2.0)
            factors[..., ROUGHNESS] = roughness
        # factors with the mean 1, because the parameter `abundance` of the rocks refers to the whole terrain
        factors[..., ROCKS] /= factors[..., ROCKS].mean(dtype=np.float64)
        return np.asarray(factors)

    def _add_tracks(self, log_albedo: Grid, spacing: float, downwind: float, rng: Generator) -> None:
        """Darken the tracks of dust devils: winding channels whose depth is the decrease of the logarithm of albedo."""
        period = log_albedo.shape[0] * spacing
        count = int(rng.poisson(self.tracks_per_km2 * (period / 1000.0) ** 2))
        heading = downwind + 0.5 * rng.standard_normal(count)
        width = np.maximum(self.track_width_m * np.exp(0.5 * rng.standard_normal(count)), 2.0 * spacing)
        length = self.track_length_m * rng.exponential(1.0, count)
        start = rng.uniform(0.0, period, (count, 2))
        max_darkening = -self.track_log_albedo * rng.uniform(0.3, 1.0, count)
        discs = draw_channels(start, heading, length, width, max_darkening, 0.12, rng)
        darkening = np.zeros_like(log_albedo)
        cut_channels(darkening, spacing, discs, 2.0)
        log_albedo -= darkening

    def _add_streaks(self, ground: TerrainGround, craters: np.ndarray, downwind: float, rng: Generator) -> None:
        """Add wind tails (streaks) behind a random selection of the craters of at least `streak_min_m`."""
        large = craters[craters["radius"] > 0.5 * self.streak_min_m]
        sources = large[rng.uniform(size=len(large)) < self.streak_fraction]
        radius, count = sources["radius"], len(sources)
        heading = downwind + 0.12 * rng.standard_normal(count)
        length = 2.0 * radius * rng.uniform(2.0, 7.0, count)
        log_albedo = self.streak_log_albedo_rms * rng.standard_normal(count)
        start = (sources["x"], sources["y"])
        streaks = np.column_stack([*start, radius, length, np.cos(heading), np.sin(heading), log_albedo])
        stamp_streaks(ground.log_albedo, ground.spacing_m, streaks)

    def _draw_halos(self, craters: np.ndarray, side: int, spacing: float, downwind: float, rng: Generator) -> Grid:
        """Draw the surroundings of large craters, 1 at most: long downwind, short upwind, weaker for worn ones."""
        sources = craters[craters["radius"] > 0.5 * self.streak_min_m]
        radius = sources["radius"]
        strength = np.minimum(crater_freshness(sources) * rng.uniform(0.5, 1.5, len(sources)), 1.0)
        halos = np.zeros((side, side), dtype=np.float32)
        for heading, length in ((downwind, rng.uniform(3.0, 12.0, len(sources))), (downwind + np.pi, 4.0)):
            c, s = (np.full(len(sources), value) for value in (np.cos(heading), np.sin(heading)))
            stamp_streaks(
                halos,
                spacing,
                np.column_stack([sources["x"], sources["y"], 2.0 * radius, length * radius, c, s, strength]),
            )
        return halos

    def _compute_membership(
        self, fields: Float32[np.ndarray, "side side kinds"], areas: Float[np.ndarray, "kinds"]
    ) -> Float32[np.ndarray, "side side kinds"]:
        """Compute the soft membership of each unit: a softmax of the fields, shifted until the areas match."""
        shift = np.zeros(areas.size)
        step = max(fields.shape[0] // _FIT_SIDE, 1)
        for _ in range(_FIT_STEPS):
            mean = self._softmax(fields[::step, ::step], shift).mean(axis=(0, 1))
            shift += np.log(np.maximum(areas, 1e-3) / np.maximum(mean, 1e-6)) * 0.5
        return self._softmax(fields, shift)

    def _softmax(
        self, fields: Float32[np.ndarray, "rows columns kinds"], shift: Float[np.ndarray, "kinds"]
    ) -> Float32[np.ndarray, "rows columns kinds"]:
        """Compute the softmax of the shifted fields; `boundary` is its temperature."""
        logits = (fields + shift.astype(np.float32)) / np.float32(self.boundary)
        logits -= logits.max(axis=-1, keepdims=True)
        weights = np.exp(logits, out=logits)
        return np.asarray(weights / weights.sum(axis=-1, keepdims=True), dtype=np.float32)
