"""Impact craters: their sizes, ages and outlines, and the brightness of their ejecta and of the sand in them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.kernels.shapes import stamp_craters

if TYPE_CHECKING:
    from marsyard.sim.terrain.parameters import TerrainParameters

RADIUS_SAMPLES = 24  #: Minimum number of samples along the radius of a crater on a coarser grid.
#: Maximum distance of ejecta from the centre of a crater, in radii; optical depth of the ejecta at the rim (assumed:
#: they cover a third of the ground at two radii).
EJECTA_EXTENT_RADII, EJECTA_OPACITY = 3.0, 3.0
#: Width of the margin in which a crater's fill thins out, in crater radii; fitted to Spirit's descent images.
FILL_MARGIN = 0.4
#: Depth from the rim crest to the floor, divided by the diameter: 0.2 for fresh simple craters (Pike 1977; Robbins &
#: Hynek 2012 for Mars); 0.04 is barely visible. Small Martian craters are mostly degraded (Golombek et al. 2014).
FRESH_DEPTH, DEGRADED_DEPTH = 0.2, 0.04
#: Height of the rim crest above the surroundings of a fresh crater, divided by the diameter (Pike 1977).
FRESH_RIM = 0.04
SHARPEST_RIM, ROUNDEST_RIM = 0.08, 0.9  #: Height over which the rim is rounded, as a fraction of the depth.
DEEPEST_FILL = 0.45  #: Fraction of the original bowl's depth that is filled in the most degraded craters.
MIN_FILL = 0.25  #: Fraction that is filled in fresh craters whose albedo wears (assumed).
DARK_EJECTA = 0.15  #: Fraction of the craters whose ejecta are darker than the ground (assumed).
FULL_CONTRAST_M = 60.0  #: Diameter from which sand and ejecta have the contrast of the parameters (assumed).
SMALLEST_FILL, LARGEST_FILL = 0.6, 1.0  #: Radius of the sand in a crater, in crater radii (assumed).
#: Outlines in the table, and positions along each; waves around an outline; RMS of its radius, and exponent of the
#: waves' amplitudes (assumed): a real rim is scalloped at all scales, and deviates from a circle by 5 to 10 %.
OUTLINES, POSITIONS, OUTLINE_WAVES = 64, 256, (2, 28)
OUTLINE_RMS, OUTLINE_EXPONENT = 0.05, -1.1
#: Relative increase of the fill's strength per radius towards the wind, in craters whose albedo wears (assumed).
WIND_ASYMMETRY = 0.8
RAY_WAVES = (5, 16)  #: Rays around a crater: waves of equal amplitude (assumed).
WORN_EXTENT_RADII = 1.6  #: Extent of the ejecta of the most worn craters, in radii (assumed).
#: Small craters in clusters of secondaries (assumed): largest diameter, fraction, number and radius of a cluster.
LARGEST_SECONDARY_M, SECONDARY_FRACTION, CLUSTER_SIZE, CLUSTER_RADIUS_M = 30.0, 0.5, 10, 45.0
_TABLE_SEED = 20040104  #: Seed of the tables of outlines and rays, which are the same for all terrains.


#: Columns of `kernels.stamp_craters`, where they are described.
CRATER = np.dtype(
    [
        (name, np.float64)
        for name in (
            *("x", "y", "radius", "depth", "rim", "rounding", "fill", "ejecta_log_albedo", "fill_log_albedo"),
            *("fill_radius", "lee_x", "lee_y", "outline", "rotation", "extent", "opacity", "margin", "core"),
        )
    ]
)


def draw_craters(parameters: TerrainParameters, rng: Generator) -> np.ndarray:
    """Draw impact craters in order of decreasing size, as a table of type `CRATER`.

    Their number has a Poisson distribution. The cumulative size-frequency distribution is ``D**-crater_exponent`` up to
    `crater_knee_m` (saturation, Hartmann 1984: -1.83) and ``D**-crater_steep_exponent`` above it (production function,
    Hartmann 2005). Outlines deviate from circles (`outline_tables`). Sand, dark on Mars, fills the inner part of some
    craters, and dust that the impact has brought up or that the rim retains brightens the ejecta of most.

    Diffusion wears craters: the depth of a Gaussian bowl is ``1 / (1 + t)`` of the initial one after the time t, in
    units that are proportional to the square of the diameter. A crater vanishes at `DEGRADED_DEPTH`. Saturation is the
    balance of new and vanished craters: below the knee the ages are uniform up to that of the vanishing crater, above
    it up to that of the ground, so that large craters are fresher.
    """
    p = parameters
    min_m, max_m = p.crater_diameter_min_m, p.crater_diameter_max_m
    if max_m <= min_m:
        limit = f"crater_diameter_min_m, {min_m:g}"
        raise ValueError(f"crater_diameter_max_m is {max_m:g}; it must be larger than {limit}")
    period = p.samples * p.spacing_m
    count = int(rng.poisson(p.craters_per_km2 * (period / 1000.0) ** 2))
    knee = min(max(p.crater_knee_m, min_m), max_m)
    knee_fraction = (knee / min_m) ** -p.crater_exponent  # fraction of craters larger than the knee
    fraction = rng.uniform(knee_fraction * (max_m / knee) ** -p.crater_steep_exponent, 1.0, count)
    below_knee = min_m * fraction ** (-1.0 / p.crater_exponent)
    above_knee = knee * (fraction / knee_fraction) ** (-1.0 / p.crater_steep_exponent)
    diameter = np.sort(np.where(fraction > knee_fraction, below_knee, above_knee))[::-1]
    age = (FRESH_DEPTH / DEGRADED_DEPTH - 1.0) * rng.uniform(0.0, 1.0, count) * np.minimum(knee / diameter, 1.0) ** 2
    freshness = 1.0 / (1.0 + age)
    position = rng.uniform(0.0, period, (count, 2))
    # the sharper rim wears faster than the bowl: as the square (assumed)
    rim = diameter * FRESH_RIM * freshness**2
    depth = diameter * FRESH_DEPTH * freshness - rim
    rounding = depth * (ROUNDEST_RIM + (SHARPEST_RIM - ROUNDEST_RIM) * freshness)
    fill = DEEPEST_FILL * (1.0 - freshness)
    # small craters shelter less sand, and throw out less material of other brightness
    size_factor = np.minimum(diameter / FULL_CONTRAST_M, 1.0)
    ejecta_log_albedo = p.crater_ejecta_contrast * size_factor * rng.gamma(3.0, 1.0 / 3.0, count)
    ejecta_log_albedo *= np.where(rng.uniform(size=count) < DARK_EJECTA, -1.0, 1.0)
    has_sand = rng.uniform(size=count) < p.crater_sand_fraction * size_factor
    fill_log_albedo = np.where(
        has_sand,
        p.crater_sand_log_albedo * rng.uniform(0.5, 1.5, count),
        p.crater_floor_contrast * rng.standard_normal(count),
    )
    # spread of sand and of its asymmetry between craters (assumed)
    fill_radius = rng.uniform(SMALLEST_FILL, LARGEST_FILL, count)
    lee = 0.3 * rng.standard_normal((count, 2))
    craters = np.zeros(count, dtype=CRATER)
    craters["radius"], craters["depth"], craters["rim"], craters["rounding"] = diameter / 2.0, depth, rim, rounding
    craters["fill"], craters["fill_radius"], craters["fill_log_albedo"] = fill, fill_radius, fill_log_albedo
    craters["lee_x"], craters["lee_y"] = lee.T
    craters["outline"] = rng.integers(0, OUTLINES, count)
    craters["rotation"] = rng.uniform(0.0, 1.0, count)
    craters["ejecta_log_albedo"] = ejecta_log_albedo
    craters["extent"], craters["opacity"], craters["margin"] = EJECTA_EXTENT_RADII, EJECTA_OPACITY, FILL_MARGIN
    if p.craters_wear_albedo:
        _wear_albedo(craters, p, freshness, rng)
        _gather_secondaries(position, diameter, period, rng)
    craters["x"], craters["y"] = position.T
    return craters


def _wear_albedo(
    craters: np.ndarray, p: TerrainParameters, freshness: Float64[np.ndarray, "craters"], rng: Generator
) -> None:
    """Make fill and ejecta of craters, a table of type `CRATER`, depend on their age, in place.

    A deep bowl shelters more sand than a shallow one. Ejecta are mixed into the soil as the rim wears, and the border
    of the fill becomes gradual. Large craters have a deposit of dust in their middle. The fill is thicker on the upwind
    side if the terrain has units with a wind. All laws are assumed.
    """
    count, diameter = len(craters), 2.0 * craters["radius"]
    size_factor = np.minimum(diameter / FULL_CONTRAST_M, 1.0)
    craters["fill"] += MIN_FILL * (1.0 - craters["fill"])
    craters["ejecta_log_albedo"] = np.abs(craters["ejecta_log_albedo"])
    has_sand = rng.uniform(size=count) < p.crater_sand_fraction
    supply = size_factor**0.7 * np.minimum(np.sqrt(2.0 * FULL_CONTRAST_M / diameter), 1.0)
    fill_log_albedo = p.crater_sand_log_albedo * has_sand * supply * freshness * rng.uniform(0.7, 1.3, count)
    craters["fill_log_albedo"] = fill_log_albedo + p.crater_floor_contrast * size_factor * rng.standard_normal(count)
    craters["extent"] = WORN_EXTENT_RADII + (EJECTA_EXTENT_RADII - WORN_EXTENT_RADII) * freshness
    craters["opacity"] = EJECTA_OPACITY * freshness**1.5
    margin_m = 1.5 + 12.0 * (1.0 - freshness) * rng.uniform(0.3, 1.0, count)
    craters["margin"] = np.minimum(2.0 * margin_m / diameter, 0.5)
    craters["fill_radius"] = 1.0 + 0.2 * craters["margin"]
    craters["core"] = size_factor * rng.uniform(0.2, 0.7, count)
    if p.units is not None:
        # sand gathers in the lee of the upwind rim
        upwind = np.radians(90.0 - p.units.wind_from_deg)
        craters["lee_x"] = 0.5 * craters["lee_x"] + WIND_ASYMMETRY * np.cos(upwind)
        craters["lee_y"] = 0.5 * craters["lee_y"] + WIND_ASYMMETRY * np.sin(upwind)


def _gather_secondaries(
    position: Float64[np.ndarray, "craters 2"], diameter: Float64[np.ndarray, "craters"], period: float, rng: Generator
) -> None:
    """Move a fraction of the small craters into clusters, in place: ejecta of a distant impact fall together."""
    is_secondary = (diameter < LARGEST_SECONDARY_M) & (rng.uniform(size=diameter.size) < SECONDARY_FRACTION)
    count = int(np.count_nonzero(is_secondary))
    clusters = rng.uniform(0.0, period, (count // CLUSTER_SIZE + 1, 2))
    offset = CLUSTER_RADIUS_M * rng.standard_normal((count, 2))
    position[is_secondary] = clusters[rng.integers(0, len(clusters), count)] + offset


@cache
def outline_tables() -> tuple[Float64[np.ndarray, "outlines positions"], Float64[np.ndarray, "outlines positions"]]:
    """Return the relative displacements of outlines, and the rays (RMS 1), at the positions of `stamp_craters`.

    Both are sums of waves around the crater with random phases and a power law of amplitudes.
    """
    rng = np.random.default_rng(_TABLE_SEED)
    quarter = 4.0 * np.arange(POSITIONS) / POSITIONS
    # the square |x| + |y| = 1, along which the positions are uniform
    y, x = (1.0 - np.abs((quarter + shift) % 4.0 - 2.0) for shift in (1.0, 2.0))
    azimuth = np.arctan2(y, x)
    tables = []
    for (first, last), exponent, rms in ((OUTLINE_WAVES, OUTLINE_EXPONENT, OUTLINE_RMS), (RAY_WAVES, 0.0, 1.0)):
        waves = np.arange(first, last + 1)
        amplitude = waves**exponent
        amplitude *= rms / np.sqrt(0.5 * np.sum(amplitude**2))
        phase = rng.uniform(0.0, 2.0 * np.pi, (OUTLINES, waves.size))
        tables.append(np.cos(waves * azimuth[:, None] + phase[:, None, :]) @ amplitude)
    return tables[0], tables[1]


def crater_freshness(craters: np.ndarray) -> Float64[np.ndarray, "craters"]:
    """Return the depth of craters (a table of type `CRATER`) below their rim, relative to that of a fresh crater."""
    return np.asarray((craters["depth"] + craters["rim"]) / craters["radius"] / (2.0 * FRESH_DEPTH))


def crater_rows(craters: np.ndarray) -> Float64[np.ndarray, "craters columns"]:
    """Return a table of craters as rows of numbers for `kernels.stamp_craters`."""
    return craters.view(np.float64).reshape(craters.size, CRATER.itemsize // 8)


def add_craters(ground: TerrainGround, craters: np.ndarray) -> None:
    """Add a table of craters, each on the coarsest grid with at least `RADIUS_SAMPLES` samples along its radius."""
    octave = np.floor(np.log2(np.maximum(craters["radius"] / (RADIUS_SAMPLES * ground.spacing_m), 1.0)))
    layer = None
    for step in range(int(octave.max(initial=0.0)), -1, -1):
        grid = ground.coarser(ground.spacing_m * 2.0**step) if step else ground
        if layer is not None:
            grid.add(layer)
        rows = crater_rows(craters[octave == step])
        stamp_craters(grid.height, grid.log_albedo, grid.spacing_m, rows, *outline_tables())
        layer = grid
