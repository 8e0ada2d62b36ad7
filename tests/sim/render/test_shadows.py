"""Cast shadows against an independent ray cast: SciPy's B-spline for the ground, brute force for triangles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.raycast import Ground, meet_triangles
from sim.camera import Cahv
from sim.frames import direction, rigid
from sim.render import Frame, Objects, Photometry, PixelRays, Scene, Sun
from sim.terrain import Surface, TerrainParameters, synthesise
from sim.terrain.rocks import RockField, RockParameters

ALBEDO = 0.2
#: Brightness is then albedo times the cosine of incidence in the sun, and 0 in shadow.
LAMBERT = Photometry(lunar_share=0.0, surge_amplitude=0.0, sky_share=0.0, surrounding_albedo=0.0)
#: Share of pixels on which the two agree: the bar of docs/validation.md.
BAR = 0.995


def _even(surface: Surface) -> Surface:
    """The same ground, all of one albedo."""
    samples = surface.levels[0].copy()
    samples[..., 1] = ALBEDO
    return Surface.from_samples(samples, surface.spacing_m)


def _agreement(frame: Frame, scene: Scene, count: int, step: float) -> tuple[float, float]:
    """Share of random pixels on which picture and ray cast agree that the sun shines, and the share in cast shadow."""
    pixels = np.random.default_rng(6).integers(0, frame.radiance.size, count)
    points = frame.points_world().reshape(-1, 3)[pixels]
    towards = scene.sun.direction
    facing = frame.normal.reshape(-1, 3)[pixels].astype(np.float64) @ towards
    share = frame.radiance.ravel()[pixels] / (ALBEDO * np.maximum(facing, 1e-6))
    hidden = Ground(scene.surface).hides(points, towards, step)
    rays = np.broadcast_to(towards, points.shape)
    hidden |= np.isfinite(meet_triangles(scene.objects, points, rays, nearest=2e-3))
    ours, theirs = (facing > 0.0) & (share > 0.5), (facing > 0.0) & ~hidden
    return float(np.mean(ours == theirs)), float(np.mean((facing > 0.0) & hidden))


@pytest.mark.parametrize("azimuth_deg", [110.0, 200.0])
def test_shadows_of_rough_ground_under_a_low_sun(renderer, rough, descent_camera, azimuth_deg) -> None:
    sun = Sun(direction(np.radians(azimuth_deg), np.radians(12.0)))
    scene = Scene(_even(rough), (380.0, 200.0), sun, LAMBERT, edge_rays=1)
    pose = rigid(Rotation.from_euler("zxy", [30.0, 12.0, 5.0], degrees=True), np.array([380.0, 200.0, 1500.0]))
    frame = renderer.render(scene, PixelRays.of(descent_camera(512)), pose)
    agree, in_shadow = _agreement(frame, scene, 4000, 0.3)
    assert in_shadow > 0.02
    assert agree >= BAR


def test_shadows_of_rocks(renderer) -> None:
    parameters = TerrainParameters(
        samples=256, spacing_m=0.1, rms_slope_deg=2.0, slope_baseline_m=2.0, outer_scale_m=15.0, craters_per_km2=0.0
    )
    surface = _even(synthesise(parameters, np.random.default_rng(5)))
    field = RockField.on(surface, RockParameters(abundance=0.1, smallest_m=0.15), np.random.default_rng(1))
    mesh = field.near(10.0, 10.0, 7.0, above_m=8.0)
    rocks = Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=ALBEDO)
    camera = Cahv.from_field_of_view(
        horizontal_rad=0.3,
        size=(256, 256),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    sun = Sun(direction(np.radians(200.0), np.radians(35.0)))
    scene = Scene(surface, (10.0, 10.0), sun, LAMBERT, rocks, mesh_finest_m=0.1, mesh_reach_m=100.0, edge_rays=1)
    eye = np.array([10.0, 10.0, float(surface.height(10.0, 10.0)) + 8.0])
    frame = renderer.render(scene, PixelRays.of(camera), rigid(Rotation.from_euler("x", 15.0, degrees=True), eye))
    agree, in_shadow = _agreement(frame, scene, 3000, 0.02)
    assert in_shadow > 0.02
    assert agree >= BAR


def test_penumbra_of_a_ridge(renderer, descent_camera) -> None:
    """The edge of a shadow 55 m long is as soft as the part of the sun's disc above the ridge says."""
    spacing, elevation = 0.5, np.radians(20.0)
    heights = np.zeros((256, 256)) + np.maximum(20.0 - spacing * np.abs(np.arange(256.0) - 60.0), 0.0)
    samples = np.stack([heights, np.full_like(heights, ALBEDO)], axis=-1).astype(np.float32)
    surface = Surface.from_samples(samples, spacing)
    sun = Sun(direction(np.radians(270.0), elevation))
    profile = np.arange(28.0, 32.0, 0.01)
    crest = surface.height(profile, 0.0)
    ground = np.linspace(75.0, 95.0, 2001)
    skyline = np.arctan2(crest, ground[:, None] - profile).max(axis=1)
    edge = float(np.interp(elevation, skyline[::-1], ground[::-1]))
    pose = rigid(Rotation.identity(), np.array([edge, 64.0, 8.0]))
    frame = renderer.render(Scene(surface, (edge, 64.0), sun, LAMBERT), PixelRays.of(descent_camera(256)), pose)
    at = frame.points_world()[..., 0].ravel()
    offset = np.clip((elevation - np.interp(at, ground, skyline)) / sun.angular_radius_rad, -1.0, 1.0)
    expected = 0.5 + (offset * np.sqrt(1.0 - offset**2) + np.arcsin(offset)) / np.pi
    lit = frame.radiance.ravel() / (ALBEDO * np.sin(elevation))
    # a metre wide, pixels of 3 cm
    assert 0.1 < np.mean((expected > 0.0) & (expected < 1.0)) < 0.3
    np.testing.assert_allclose(lit, expected, atol=0.01)
