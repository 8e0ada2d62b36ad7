"""Checks of sunlight, skylight and haze in dusty air, compared with a Monte Carlo simulation of light in plane layers.

The simulation has no delta scaling, no two streams, and no limit of the order of scattering. All radiances are radiance
factors (I/F) for the sunlight above the atmosphere.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64

from benchmarks.validation.light_checks import FLAT_ALBEDO, make_flat_surface
from benchmarks.validation.motion import View, render
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import cameras, level_pose, renderer
from marsyard.reports.validation_rows import Conditions
from marsyard.scenarios.radiance import add_haze
from marsyard.sim.frames import direction
from marsyard.sim.render import DustySky, Photometry, Scene, Sun
from marsyard.sim.terrain import Environment

#: Compared pixels of a descent image, from its left and upper border, as fractions of its sides.
PIXELS = ((0.5, 0.5), (0.1, 0.5), (0.9, 0.5))
#: Maximum difference of the light on level ground (assumed: the exposure time corrects larger ones), of the light in a
#: shadow relative to that next to it (assumed), and of the contrast of ground in descent images: the assumed spread of
#: the contrast between terrains (`contrast_spread`).
LIGHT_LIMIT, SHADOW_LIMIT, CONTRAST_LIMIT = 0.1, 0.05, 0.2
#: Weight of a ray below which its further scattering is neglected.
MIN_WEIGHT = 1e-3
Directions = Float64[np.ndarray, "rays 3"]
Rays = Float64[np.ndarray, "rays"]


def _scatter(forward: Directions, asymmetry: float, rng: np.random.Generator) -> Directions:
    """Draw directions after scattering by the phase function of Henyey & Greenstein (1941)."""
    u, turn = rng.uniform(size=(2, len(forward)))
    g = asymmetry
    cosine = (1.0 + g * g - ((1.0 - g * g) / (1.0 - g + 2.0 * g * u)) ** 2) / (2.0 * g)
    axis = np.where(np.abs(forward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(forward, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(forward, first)
    sine, azimuth = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)), 2.0 * np.pi * turn
    sideways = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second
    return np.asarray(cosine[:, None] * forward + sine[:, None] * sideways)


def draw_upward(count: int, rng: np.random.Generator) -> Directions:
    """Draw directions above the horizon with a density proportional to the sine of elevation."""
    up_squared, turns = rng.uniform(size=(2, count))
    horizontal, azimuth = np.sqrt(1.0 - up_squared), 2.0 * np.pi * turns
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sqrt(up_squared)], axis=1)


def simulate_radiance(
    air: Environment, sun: Sun, ground_albedo: float, depth: float, looking: Directions, rng: np.random.Generator
) -> Rays:
    """Simulate the radiance that arrives from directions at an optical depth below the top of the atmosphere.

    Rays are traced backwards; each scattering adds single-scattered sunlight. The ground is a Lambert surface. The
    sun's disc itself is not seen. The mean over rays with the same direction is the radiance.
    """
    optical_depth, scattering, g = air.optical_depth, air.single_scattering_albedo, air.asymmetry
    to_sun, up = np.asarray(sun.direction), float(sun.direction[2])
    radiance, weight = np.zeros(len(looking)), np.ones(len(looking))
    depths, heading = np.full(len(looking), depth), looking.copy()
    active = np.arange(len(looking))
    while active.size:
        depths[active] += rng.exponential(size=active.size) * -heading[active, 2]
        active = active[depths[active] > 0.0]
        on_ground = depths[active] >= optical_depth
        ground, air_rays = active[on_ground], active[~on_ground]
        radiance[ground] += weight[ground] * ground_albedo * up * np.exp(-optical_depth / up)
        weight[ground] *= ground_albedo
        depths[ground], heading[ground] = optical_depth, draw_upward(ground.size, rng)
        phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * heading[air_rays] @ to_sun) ** 1.5
        radiance[air_rays] += weight[air_rays] * scattering / 4.0 * phase * np.exp(-depths[air_rays] / up)
        weight[air_rays] *= scattering
        heading[air_rays] = _scatter(heading[air_rays], g, rng)
        active = active[weight[active] > MIN_WEIGHT]
    return radiance


@dataclass(frozen=True)
class Air:
    """Range of compared atmospheres and suns, which contains those of the campaigns of systems.

    - optical_depths: compared optical depths, the lowest first
    - elevations_deg: compared elevations of the sun, degrees, the lowest first
    """

    systems: tuple[str, ...]
    optical_depths: tuple[float, ...]
    elevations_deg: tuple[float, ...]

    def conditions(self, rows: str, range_m: tuple[float, float] | None = None) -> Conditions:
        """Conditions of rows with these atmospheres and suns."""
        depth, sun = ((values[0], values[-1]) for values in (self.optical_depths, self.elevations_deg))
        return Conditions(rows, self.systems, sun_elevation_deg=sun, optical_depth=depth, range_m=range_m)

    def suns(self) -> Iterator[tuple[Environment, Sun, float]]:
        """Yield atmospheres and suns, and the elevation of the sun in radians."""
        for depth, elevation_deg in product(self.optical_depths, self.elevations_deg):
            elevation = float(np.radians(elevation_deg))
            yield Environment(optical_depth=depth), Sun(direction(np.pi / 2.0, elevation)), elevation


GROUND = Air(("dimes", "localisation", "vtt", "hda"), (0.1, 0.3, 0.6, 0.9, 1.2), (20.0, 30.0, 45.0, 60.0, 75.0))
DESCENTS = {
    "dimes-gusev": Air(("dimes",), (0.6, 0.9, 1.2), (30.0, 45.0, 60.0, 75.0)),
    "loc-jezero": Air(("localisation",), (0.3, 0.6, 0.9), (20.0, 30.0, 45.0)),
}
#: Altitudes of the camera, metres, above the ground of each descent.
ALTITUDES_M = {"dimes-gusev": (1300.0, 2100.0), "loc-jezero": (500.0, 2000.0, 4200.0)}


def compare_light(quick: bool) -> Iterator[Measure]:
    """Compare the light on level ground, and its fraction in a shadow, with the simulation."""
    count, rng = 20000 if quick else 200000, np.random.default_rng(61)
    total, shaded = [], []
    for air, sun, elevation in GROUND.suns():
        up, direct = float(sun.direction[2]), air.direct_fraction(elevation)
        sky = air.sky_fraction(elevation, FLAT_ALBEDO)
        diffuse = simulate_radiance(air, sun, FLAT_ALBEDO, air.optical_depth, draw_upward(count, rng), rng).mean()
        expected = up * np.exp(-air.optical_depth / up) + diffuse
        total.append(direct * (up + sky) / expected - 1.0)
        disc = DustySky(air.optical_depth, air.single_scattering_albedo, air.asymmetry).disc_fraction(up)
        shaded.append((sky + (1.0 - disc) * up) / (up + sky) - diffuse / expected)
    how = f"{len(total)} atmospheres and suns, {count:,} rays each; from {min(total):+.1%} to {max(total):+.1%}"
    claim = "light on level ground compared with simulated scattering, maximum difference"
    yield Measure(claim, float(np.abs(total).max()), "", LIGHT_LIMIT, how)
    how = f"the same; from {min(shaded):+.3f} to {max(shaded):+.3f}"
    claim = "light in the shadow of a thin body over that next to it, maximum difference from simulated scattering"
    yield Measure(claim, float(np.abs(shaded).max()), "", SHADOW_LIMIT, how)


def compare_haze(quick: bool) -> Iterator[Measure]:
    """Compare descent images of flat ground through dusty air with the simulation.

    Both attenuate the light from a point of the ground equally, so that the contrast is inversely proportional to the
    radiance, which includes the light of the air.
    """
    count, rng = 5000 if quick else 50000, np.random.default_rng(62)
    camera = cameras()["MER descent camera, CAHVOR, 45 deg"]
    columns, rows = (np.array(PIXELS) * camera.size).astype(int).T
    looking = camera.rays(np.column_stack([columns, rows]).astype(np.float64))[1]
    for name, domain in DESCENTS.items():
        ratios = []
        for (air, sun, elevation), altitude in product(domain.suns(), ALTITUDES_M[name]):
            law = Photometry(
                lunar_fraction=0.0,
                surge_amplitude=0.0,
                sky_fraction=air.sky_fraction(elevation, FLAT_ALBEDO),
                surrounding_albedo=FLAT_ALBEDO,
                sky=DustySky(air.optical_depth, air.single_scattering_albedo, air.asymmetry),
            )
            scene = Scene(make_flat_surface(), (0.0, 0.0), sun, law)
            frame = render(renderer(), View(scene, camera, level_pose(np.array([0.0, 0.0, altitude]))))
            image = add_haze(frame, air, sun, air.mean_extinction_m(altitude)) * air.direct_fraction(elevation)
            above = air.optical_depth * np.exp(-altitude / air.scale_height_m)
            simulated = simulate_radiance(air, sun, FLAT_ALBEDO, above, np.repeat(looking, count, axis=0), rng)
            ratios.extend(simulated.reshape(-1, count).mean(axis=1) / image[rows, columns] - 1.0)
        heights = " and ".join(f"{altitude:g}" for altitude in (ALTITUDES_M[name][0], ALTITUDES_M[name][-1]))
        how = (
            f"{len(ratios)} pixels at altitudes between {heights} m, {count:,} rays each; from {min(ratios):+.1%} to "
            f"{max(ratios):+.1%}"
        )
        claim = f"contrast of ground through dusty air compared with simulated scattering, maximum difference, {name}"
        yield Measure(claim, float(np.abs(ratios).max()), "", CONTRAST_LIMIT, how)


CHECKS = (
    Check("light", "Light", compare_light, conditions=(GROUND.conditions("*"),)),
    Check(
        "haze",
        "Light",
        compare_haze,
        conditions=tuple(
            domain.conditions(f"*{name}", (ALTITUDES_M[name][0], ALTITUDES_M[name][-1]))
            for name, domain in DESCENTS.items()
        ),
    ),
)
