"""Tests of pixels with edges: subpixel rays, ray intersection, and images against 256 rays per pixel."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.motion import View, supersample
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun, Texture
from marsyard.sim.render.arrays import to_host
from marsyard.sim.render.renderer import supersample_rays
from marsyard.sim.terrain import TerrainParameters, synthesise
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from marsyard.sim.terrain.sites import SitePebbles
from tests.sim.scenes import DOWN, FORWARD, flat_ground, rocks_near

SUN = Sun(direction(np.radians(110.0), np.radians(40.0)))


def _make_camera(size: tuple[int, int], focal_m: float = 16e-3) -> Cahv:
    return Cahv.from_focal_length(focal_m, 12e-6, size, **FORWARD)


@pytest.fixture(scope="module")
def rocky_view() -> View:
    """Return a view of a rock of 1 m among others at 5 m, with rolling ground and sky."""
    parameters = TerrainParameters(
        samples=512, spacing_m=0.05, rms_slope_deg=3.0, slope_baseline_m=1.0, outer_scale_m=10.0, craters_per_km2=0.0
    )
    surface = synthesise(parameters, np.random.default_rng(5))
    target = PlacedRock(name="target", east_m=10.0, north_m=10.0, diameter_m=1.0, shape=3, yaw_deg=20.0)
    field = RockField.draw(surface, RockParameters(abundance=0.05, placed=(target,)), np.random.default_rng(1))
    eye = np.array([5.0, 10.0, float(surface.height(10.0, 10.0)) + 1.0])
    rocks = rocks_near(field, eye[0], eye[1], 9.0, 1.0, albedo=0.08)
    mesh: dict[str, Any] = {"mesh_finest_m": 0.04, "mesh_half_width_m": 3000.0, "mesh_lines": 801}
    scene = Scene(surface, (eye[0], eye[1]), SUN, Photometry(), rocks, among_objects=True, **mesh)
    return View(scene, _make_camera((192, 160), 6e-3), rigid(Rotation.from_euler("y", 8.0, degrees=True), eye))


def test_subpixel_rays_are_evenly_distributed() -> None:
    camera = _make_camera((7, 5))
    rays = PixelRays.from_camera(camera)
    pixels = np.array([0, 17, 34])
    _, subpixel_rays = supersample_rays(rays, pixels, 3)
    result, _ = camera.project(to_host(subpixel_rays.directions).astype(np.float64))
    centres = np.stack([pixels % 7, pixels // 7], axis=-1)
    positions = result.reshape(3, 9, 2) - centres[:, None]
    assert np.abs(positions.mean(axis=1)).max() < 1e-3
    # No two of the nine rays share a row or column.
    for axis in range(2):
        steps = np.diff(np.sort(positions[..., axis], axis=1), axis=1)
        np.testing.assert_allclose(steps, 1.0 / 9.0, atol=2e-3)


def test_truth_is_at_pixel_centres(renderer: Renderer, rocky_view: View) -> None:
    rays = rocky_view.rays(rocky_view.camera)
    single_ray = renderer.render(replace(rocky_view.scene, edge_rays=1), rays, rocky_view.world_from_body)
    multiple_rays = renderer.render(rocky_view.scene, rays, rocky_view.world_from_body)
    for layer in ("range_m", "body", "normal"):
        assert getattr(single_ray, layer).tobytes() == getattr(multiple_rays, layer).tobytes()
    assert 0.02 < np.mean(single_ray.radiance != multiple_rays.radiance) < 0.2


def test_texture_and_pebbles_are_no_edges(renderer: Renderer) -> None:
    """They are smooth over a pixel: more rays with the pixel's footprint would only blur them."""
    surface = flat_ground(64, 0.5)
    scene = Scene(
        surface,
        (0.0, 0.0),
        SUN,
        Photometry(),
        ground_texture=Texture(0.2, (0.1, 0.1, 0.1)),
        pebbles=SitePebbles(coverage=0.3, largest_m=0.05, smallest_m=0.01, log_albedo=-0.5),
        mesh_finest_m=0.04,
        mesh_half_width_m=200.0,
        mesh_lines=801,
    )
    pose = rigid(Rotation.identity(), np.array([0.0, 0.0, 4.0]))
    rays = PixelRays.from_camera(Cahv.from_focal_length(16e-3, 12e-6, (96, 96), **DOWN))
    images = [renderer.render(replace(scene, edge_rays=side), rays, pose).radiance for side in (1, 2)]
    # the contrast between neighbours is that of the edges of shadows
    assert np.mean(np.abs(np.diff(images[0])) > 0.25 * images[0][:, 1:]) > 0.01
    np.testing.assert_array_equal(images[0], images[1])


def test_plane_horizon_is_at_the_mesh_border(renderer: Renderer) -> None:
    """For a rolled camera over a plane, the ground fraction per column is the part below the mesh border.

    The mesh ends 200 m away, 5 mrad or 3.3 pixels below the horizon.
    """
    surface = flat_ground(64, 0.5)
    photometry = Photometry(lunar_fraction=0.0, surge_amplitude=0.0)
    scene = Scene(surface, (0.0, 0.0), SUN, photometry, mesh_finest_m=0.04, mesh_half_width_m=200.0, mesh_lines=801)
    camera = _make_camera((128, 64), 8e-3)
    pose = rigid(Rotation.from_euler("x", 7.0, degrees=True), np.array([0.0, 0.0, 1.0]))
    border, _ = camera.transform(pose).project(np.array([[200.0, -30.0, 0.0], [200.0, 30.0, 0.0]]))
    # The last row, 63, ends at 63.5.
    expected = 63.5 - np.interp(np.arange(128), *border[np.argsort(border[:, 0])].T)
    errors = []
    for edge_rays in (1, 3):
        frame = renderer.render(replace(scene, edge_rays=edge_rays), PixelRays.from_camera(camera), pose)
        ground, sky = frame.radiance[-1].mean(), frame.radiance[0].mean()
        fraction = ((frame.radiance - sky) / (ground - sky)).sum(axis=0)
        errors.append(float(np.sqrt(np.mean((fraction - expected) ** 2))))
    # With one ray per pixel the error of a straight edge is uniform up to half a pixel: 0.29 px RMS.
    assert errors[0] > 0.2
    assert errors[1] < 0.1


#: Rays along each side of a pixel in the reference image.
RAYS_PER_SIDE = 16


@pytest.fixture(scope="module")
def reference(renderer: Renderer, rocky_view: View) -> np.ndarray:
    """Render the radiance with 256 rays per pixel; ground and texture are smoothed over a pixel."""
    one_ray_view = replace(rocky_view, scene=replace(rocky_view.scene, edge_rays=1))
    return supersample(renderer, replace(one_ray_view, footprint=float(RAYS_PER_SIDE)), RAYS_PER_SIDE)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "max_error_ratio"), [(2, 0.5), (3, 0.4)])
def test_outlines_match_256_rays_per_pixel(
    renderer: Renderer, rocky_view: View, reference: np.ndarray, side: int, max_error_ratio: float
) -> None:
    one_ray_view = replace(rocky_view, scene=replace(rocky_view.scene, edge_rays=1))
    rays = rocky_view.rays(rocky_view.camera)
    single_ray = renderer.render(one_ray_view.scene, rays, rocky_view.world_from_body)
    multiple_rays = renderer.render(replace(rocky_view.scene, edge_rays=side), rays, rocky_view.world_from_body)
    edges = np.flatnonzero(single_ray.radiance != multiple_rays.radiance)
    assert 500 < edges.size < 0.2 * single_ray.radiance.size

    def compute_error(radiance: np.ndarray) -> float:
        return float(np.sqrt(np.mean((radiance - reference).ravel()[edges] ** 2)) / reference.mean())

    assert compute_error(multiple_rays.radiance) < max_error_ratio * compute_error(single_ray.radiance)
    # The mean brightness at outlines is unbiased.
    mean_error = (multiple_rays.radiance - reference).ravel()[edges].mean() / reference.mean()
    assert abs(mean_error) < 0.1 * compute_error(single_ray.radiance)
