"""Checks of the sky that a rover, rocks and relief hide from the ground, by casting rays."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64
from scipy.stats import qmc

from benchmarks.validation.light_checks import FLAT_ALBEDO, LAMBERT
from benchmarks.validation.raycast import cast_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import LANDING, MAST
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.dynamics.rover import MER, settle
from marsyard.sim.render import Objects, Scene, Sun
from marsyard.sim.render.arrays import to_host, vectors_to_device
from marsyard.sim.render.device import Array3f64, Bool
from marsyard.sim.render.rover import rover_objects
from marsyard.sim.sensor.mast import MER_MAST
from marsyard.sim.terrain import RockField, RockParameters, Surface, TerrainParameters, sites, synthesise

#: Maximum RMS differences of the hidden fraction of the sky: wheels, legs, mast and arm are not part of a rover's
#: shelter, and rocks are no half spheroids. About twice the measured values.
LIMITS = {"a rover": 0.1, "rocks": 0.06}
#: Side of the level ground, metres, and half width of the compared area around its middle.
SIDE_M, HALF_WIDTH_M = 64, 1.5
#: Sites whose relief hides a part of the sky.
SITES = ("gusev", "meridiani", "heli-hazardous")
#: Maximum distance of the relief that hides the sky, metres, and seed of the terrains.
HORIZON_M, FIRST_SEED = 30.0, 3920


def _draw_directions(log2_count: int) -> Float64[np.ndarray, "n 3"]:
    """Draw directions above the horizon with a density proportional to the sine of elevation."""
    up_squared, turns = qmc.Sobol(2, rng=np.random.default_rng(4)).random_base2(log2_count).T
    horizontal, azimuth = np.sqrt(1.0 - up_squared), 2.0 * np.pi * turns
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sqrt(up_squared)], axis=1)


def _make_objects(ground: Surface) -> dict[str, Objects]:
    """Place a rover, and rocks, in the middle of the ground."""
    middle = 0.5 * SIDE_M
    rover = rover_objects(MER, settle(MER, ground, middle, middle, 0.0), MER_MAST, 0.0, 0.0)
    parameters = RockParameters(abundance=0.1, smallest_m=0.1, largest_m=1.0)
    mesh = RockField.draw(ground, parameters, np.random.default_rng(5)).near(middle, middle, 4.0, detail=2)
    rocks = Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, FLAT_ALBEDO)
    return {"a rover": rover, "rocks": rocks}


def compare_hidden_sky(quick: bool) -> Iterator[Measure]:
    """Compare the fraction of the sky's light that is hidden from points on level ground with ray casting."""
    count, rays = (40, _draw_directions(7)) if quick else (200, _draw_directions(9))
    samples = np.zeros((SIDE_M, SIDE_M, 2), dtype=np.float32)
    ground = Surface.from_samples(samples, 1.0)
    points = np.zeros((count, 3))
    points[:, :2] = 0.5 * SIDE_M + np.random.default_rng(6).uniform(-HALF_WIDTH_M, HALF_WIDTH_M, (count, 2))
    for name, objects in _make_objects(ground).items():
        zenith = Sun(np.array([0.0, 0.0, 1.0]))
        scene = Scene(ground, (0.5 * SIDE_M, 0.5 * SIDE_M), zenith, LAMBERT, objects, among_objects=True)
        assert scene.obstructions is not None
        is_ground, is_object = (Bool([value] * count) for value in (True, False))
        vectors = scene.obstructions.hide_sky(vectors_to_device(Array3f64, points), is_ground, is_object)
        ranges = cast_triangles(objects, np.repeat(points, len(rays), axis=0), np.tile(rays, (count, 1)), nearest=1e-4)
        expected = np.isfinite(ranges).reshape(count, -1).mean(axis=1)
        # points inside a body see no sky at all
        outside = expected < 1.0
        difference = (to_host(vectors)[:, 2] - expected)[outside]
        how = (
            f"{outside.sum()} points within {HALF_WIDTH_M} m, {len(rays)} rays each; ray casting: "
            f"{expected[outside].mean():.0%} hidden in the mean; mean difference {difference.mean():+.1%}"
        )
        claim = f"fraction of the sky that {name} hides, RMS difference from ray casting"
        yield Measure(claim, float(np.sqrt(np.mean(difference**2))), "", LIMITS[name], how)


def measure_horizons(terrain: TerrainParameters, points: int) -> Float64[np.ndarray, "points"]:
    """Compute the fraction of the irradiance of a uniform sky that relief hides from random points of a terrain.

    Without relief a point sees the sky above its tangent plane. The horizon is the maximum elevation of the terrain up
    to `HORIZON_M` in 32 azimuths; the irradiance below an elevation h is in proportion to sin(h)**2.
    """
    surface, rng = synthesise(terrain, np.random.default_rng(FIRST_SEED)), np.random.default_rng(8)
    x, y = rng.uniform(0.0, terrain.samples * terrain.spacing_m, (2, points))
    z, step, hidden = surface.height(x, y), terrain.spacing_m, np.zeros(points)
    azimuths = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    for east, north in zip(np.cos(azimuths), np.sin(azimuths), strict=True):
        slopes = [(surface.height(x + r * east, y + r * north) - z) / r for r in np.geomspace(step, HORIZON_M, 60)]
        ahead, behind = (surface.height(x + s * step * east, y + s * step * north) for s in (1.0, -1.0))
        tangent = np.maximum((ahead - behind) / (2.0 * step), 0.0)
        horizon, plane = (np.arctan(slope) for slope in (np.maximum(np.max(slopes, axis=0), tangent), tangent))
        hidden += (np.sin(horizon) ** 2 - np.sin(plane) ** 2) / len(azimuths)
    return hidden


def report_horizons(quick: bool) -> Iterator[Measure]:
    """Report the light of the sky that relief hides from the ground, which images do not contain."""
    points = 500 if quick else 4000
    for name in SITES:
        hidden = measure_horizons(sites()[name].terrain("ground"), points)
        how = f"{points} points, horizons up to {HORIZON_M:g} m; 95 % have less than {np.quantile(hidden, 0.95):.1%}"
        yield Measure(f"light of the sky that relief hides, ground of {name}", float(hidden.mean()), "", None, how)


CHECKS = (
    Check("sky", "Light", compare_hidden_sky, conditions=(Conditions("*", (*MAST, *LANDING)),)),
    Check(
        "sky-relief",
        "Light",
        report_horizons,
        conditions=tuple(Conditions(f"*{name}", (*MAST, *LANDING), site=(name,)) for name in SITES),
    ),
)
