"""Checks of the sky and the aureole that a rover, rocks and relief hide from the ground, by casting rays."""

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
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, Scene, Sun
from marsyard.sim.render.arrays import to_host, vectors_to_device
from marsyard.sim.render.device import Array3f64, Bool
from marsyard.sim.render.rover import rover_objects
from marsyard.sim.render.sky import AUREOLE_RADIUS_RAD
from marsyard.sim.sensor.mast import MER_MAST
from marsyard.sim.terrain import RockField, RockParameters, Surface, TerrainParameters, sites, synthesise

#: Maximum RMS differences of the hidden fractions of the sky and of the aureole: wheels, legs, mast and arm are not
#: part of a rover's shelter, and rocks are no half spheroids. Between 1.1 times (rover) and twice (rocks) the measured
#: values.
LIMITS = {("sky", "a rover"): 0.1, ("sky", "rocks"): 0.06, ("aureole", "a rover"): 0.2, ("aureole", "rocks"): 0.16}
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


def _draw_aureole(log2_count: int, sun: Sun) -> Float64[np.ndarray, "n 3"]:
    """Draw directions that are distributed uniformly over the aureole."""
    fractions, turns = qmc.Sobol(2, rng=np.random.default_rng(4)).random_base2(log2_count).T
    cosine, turns = 1.0 - fractions * (1.0 - np.cos(AUREOLE_RADIUS_RAD)), 2.0 * np.pi * turns
    sine, towards = np.sqrt(1.0 - cosine**2), sun.direction
    first = np.cross(towards, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    sideways = np.outer(np.cos(turns), first) + np.outer(np.sin(turns), np.cross(towards, first))
    return cosine[:, None] * towards + sine[:, None] * sideways


def _make_objects(ground: Surface) -> dict[str, Objects]:
    """Place a rover, and rocks, in the middle of the ground."""
    middle = 0.5 * SIDE_M
    rover = rover_objects(MER, settle(MER, ground, middle, middle, 0.0), MER_MAST, 0.0, 0.0)
    parameters = RockParameters(abundance=0.1, smallest_m=0.1, largest_m=1.0)
    mesh = RockField.draw(ground, parameters, np.random.default_rng(5)).near(middle, middle, 4.0, detail=2)
    rocks = Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, FLAT_ALBEDO)
    return {"a rover": rover, "rocks": rocks}


def compare_hidden_sky(quick: bool) -> Iterator[Measure]:
    """Compare the light of sky and aureole that is hidden from points on level ground with ray casting."""
    sun = Sun(direction(2.0, np.radians(45.0)))
    count, log2_rays = (40, 7) if quick else (200, 9)
    directions = {"sky": _draw_directions(log2_rays), "aureole": _draw_aureole(log2_rays, sun)}
    samples = np.zeros((SIDE_M, SIDE_M, 2), dtype=np.float32)
    ground = Surface.from_samples(samples, 1.0)
    points = np.zeros((count, 3))
    points[:, :2] = 0.5 * SIDE_M + np.random.default_rng(6).uniform(-HALF_WIDTH_M, HALF_WIDTH_M, (count, 2))
    for name, objects in _make_objects(ground).items():
        scene = Scene(ground, (0.5 * SIDE_M, 0.5 * SIDE_M), sun, LAMBERT, objects, among_objects=True)
        assert scene.obstructions is not None
        is_ground, is_object = (Bool([value] * count) for value in (True, False))
        light = scene.obstructions.hide_light(vectors_to_device(Array3f64, points), is_ground, is_object)
        hidden = {"sky": to_host(light.sky)[:, 2], "aureole": to_host(light.aureole)}
        expected = {}
        for what, rays in directions.items():
            origins = np.repeat(points, len(rays), axis=0)
            ranges = cast_triangles(objects, origins, np.tile(rays, (count, 1)), nearest=1e-4)
            expected[what] = np.isfinite(ranges).reshape(count, -1).mean(axis=1)
        # points inside a body see no sky at all
        outside = expected["sky"] < 1.0
        for what, fraction in expected.items():
            difference = (hidden[what] - fraction)[outside]
            how = (
                f"{outside.sum()} points within {HALF_WIDTH_M} m, {len(directions[what])} rays each; ray casting: "
                f"{fraction[outside].mean():.0%} hidden in the mean; mean difference {difference.mean():+.1%}"
            )
            claim = f"fraction of the {what} that {name} hides, RMS difference from ray casting"
            yield Measure(claim, float(np.sqrt(np.mean(difference**2))), "", LIMITS[what, name], how)


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
