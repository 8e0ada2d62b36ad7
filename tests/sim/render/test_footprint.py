"""Tests of shadow footprints, grids that mark the ground that objects may shade, and of the culling of objects."""

from dataclasses import replace

import numpy as np
import pytest

from marsyard.scenarios.views import SiteGround, Viewpoint, mast_pose, nadir_pose, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, PixelRays, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.kernels.structs import Footprint
from marsyard.sim.render.scene import ALL_GROUND, shadow_footprint
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import RockParameters, TerrainParameters, site

ROCKY = TerrainParameters(samples=512, spacing_m=3.0, rocks=RockParameters(abundance=0.15, smallest_m=1.0))


def _is_inside(footprint: Footprint, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether the footprint marks the cells of the positions (m)."""
    cells, west, south, per_metre = footprint
    column = np.floor((x - west) * per_metre).astype(int)
    row = np.floor((y - south) * per_metre).astype(int)
    is_in_grid = (column >= 0) & (column < cells.shape[1]) & (row >= 0) & (row < cells.shape[0])
    is_shaded = np.zeros(x.shape, dtype=bool)
    is_shaded[is_in_grid] = cells[row[is_in_grid], column[is_in_grid]]
    return is_shaded


@pytest.mark.parametrize("elevation", [0.2, 0.7, 1.5])
def test_footprint_contains_every_shaded_position(elevation: float) -> None:
    """The footprint contains all ground points whose ray to the sun intersects a sphere, and few other points."""
    rng = np.random.default_rng(0)
    spheres = np.column_stack(
        [rng.uniform(-900.0, 900.0, (40, 2)), rng.uniform(-30.0, 30.0, 40), rng.uniform(0.5, 3.0, 40)]
    )
    sun = direction(rng.uniform(0.0, 6.0), elevation)
    footprint = shadow_footprint(spheres, sun, -40.0)
    # Random points in the spheres, projected along the sun direction to random lower heights, down to -40 m.
    sphere_of_point = np.repeat(spheres, 500, axis=0)
    offset = rng.standard_normal((len(sphere_of_point), 3))
    offset *= (rng.random(len(sphere_of_point)) ** (1.0 / 3.0) / np.linalg.norm(offset, axis=1))[:, None]
    points = sphere_of_point[:, :3] + sphere_of_point[:, 3:] * offset
    height_drop = rng.random(len(points)) * (points[:, 2] + 40.0)
    ground = points - (height_drop / sun[2])[:, None] * sun
    assert _is_inside(footprint, ground[:, 0], ground[:, 1]).all()
    random_positions = rng.uniform(-1000.0, 1000.0, (20000, 2))
    # The bound allows 40 shadows on 4 km2, each up to 70 m / tan(elevation) long and a few cells wide.
    assert _is_inside(footprint, *random_positions.T).mean() < 0.15 + 0.1 / np.tan(elevation)


def test_footprint_without_objects_or_sun_is_everywhere() -> None:
    sphere = np.array([[0.0, 0.0, 0.0, 1.0]])
    assert shadow_footprint(np.empty((0, 4)), direction(0.0, 1.0), 0.0) is ALL_GROUND
    assert shadow_footprint(sphere, direction(0.0, -0.1), 0.0) is ALL_GROUND


def test_footprint_does_not_change_images() -> None:
    """The images of ground with many rocks under a low sun are bitwise equal."""
    ground = SiteGround.from_site(site("gusev").model_copy(update={"descent": ROCKY}))
    rays = PixelRays.from_camera(preset("mer-descent-flown").cameras()[0].bin(4, 4))
    pose = nadir_pose(ground.surface, 300.0, 200.0, 400.0)
    scene = site_scene(ground, Viewpoint.from_pose(rays, pose, ground.surface), Sun(direction(1.0, 0.3)))
    assert len(scene.objects) > 50
    frame = process_renderer(default_backend()).render(scene, rays, pose)
    # Replace the cached property: no pixel is excluded from the shadow test.
    full_scene = replace(scene)
    full_scene.__dict__["footprint"] = ALL_GROUND
    full_frame = process_renderer(default_backend()).render(full_scene, rays, pose)
    np.testing.assert_array_equal(frame.radiance, full_frame.radiance)
    assert not scene.footprint.cells.all()


@pytest.mark.parametrize("elevation", [0.25, 1.0])
def test_culling_does_not_change_images(elevation: float) -> None:
    """A mast subframe among rocks is bitwise equal with and without culling, for two sun elevations and azimuths."""
    terrain = ROCKY.model_copy(update={"spacing_m": 0.05, "rms_slope_deg": 5.0, "slope_baseline_m": 1.0})
    terrain = terrain.model_copy(update={"outer_scale_m": 10.0, "craters_per_km2": 0.0})
    rocks = RockParameters(abundance=0.1, smallest_m=0.05)
    ground = SiteGround.from_site(
        site("gusev").model_copy(update={"descent": terrain.model_copy(update={"rocks": rocks})})
    )
    rays = PixelRays.from_camera(preset("research-navcam").cameras()[0].crop(400, 380, (161, 161)))
    pose = mast_pose(ground.surface, 12.0, 11.0, 1.5, 30.0, -14.0)
    for azimuth in (0.5, 3.0):
        viewpoint = Viewpoint(12.0, 11.0, 1.5, rays.pixel_rad, azimuth_rad=0.5, half_width_rad=1.2, max_distance_m=25.0)
        scene = site_scene(ground, viewpoint, Sun(direction(azimuth, elevation)))
        visible_scene = scene.restrict_to_cones([rays.cone(pose)])
        assert 0 < len(visible_scene.objects) < 0.5 * len(scene.objects)
        renderer = process_renderer(default_backend())
        full, subset = renderer.render(scene, rays, pose), renderer.render(visible_scene, rays, pose)
        np.testing.assert_array_equal(subset.radiance, full.radiance)
        np.testing.assert_array_equal(subset.range_m, full.range_m)
        # Culling keeps the spheres of the remaining objects.
        new_objects = Objects(**{name: getattr(visible_scene.objects, name) for name in Objects.__dataclass_fields__})
        np.testing.assert_array_equal(visible_scene.objects.spheres, new_objects.spheres)
