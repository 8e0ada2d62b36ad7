"""Tests of views of a site: camera poses, selection of rocks and rendered scenes."""

from dataclasses import replace

import numpy as np
import pytest

from marsyard.scenarios.views import (
    CAMERA_MOUNTINGS,
    SiteGround,
    Viewpoint,
    camera_pose,
    mast_pose,
    nadir_pose,
    site_scene,
)
from marsyard.scenarios.visible_rocks import DETAIL_TRIANGLES, ROCK_TRIANGLES, SMALLEST_ROCK_PX, select_rocks
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, PixelRays, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor import PRESETS, preset
from marsyard.sim.terrain import Site, site

SUN = Sun(direction(np.radians(250.0), np.radians(35.0)))


def _make_small_site(name: str, samples: int = 512) -> Site:
    """Return a preset site with fewer terrain samples, which is built quickly."""
    preset_site = site(name)
    return preset_site.model_copy(update={"ground": preset_site.ground.model_copy(update={"samples": samples})})


def _select_rocks(ground: SiteGround, viewpoint: Viewpoint) -> Objects:
    return select_rocks(ground.rocks, ground.site.photometry.rock_albedo, viewpoint)


@pytest.fixture(scope="module")
def ground() -> SiteGround:
    return SiteGround.from_site(_make_small_site("gusev", 1024), "ground", seed=3)


def test_each_camera_has_a_default_mounting() -> None:
    assert set(CAMERA_MOUNTINGS) == set(PRESETS)


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, -90.0), (70.0, -40.0), (200.0, -10.0)])
def test_camera_has_the_specified_direction(ground: SiteGround, name: str, azimuth: float, elevation: float) -> None:
    design = preset(name).design
    pose = camera_pose(ground.surface, design, 3.0, 4.0, 5.0, azimuth, elevation)
    axes = [camera.transform(pose).a for camera in preset(name).cameras()]
    # The direction of a stereo pair is the mean of its two axes, which have a toe-in.
    mean_axis = np.mean(axes, axis=0)
    expected = direction(np.radians(azimuth), np.radians(elevation))
    np.testing.assert_allclose(mean_axis / np.linalg.norm(mean_axis), expected, atol=1e-12)
    height = float(ground.surface.height(3.0, 4.0)) + 5.0
    np.testing.assert_allclose(pose.translation, [3.0, 4.0, height], atol=1e-12)


def test_upper_edge_of_nadir_image_faces_the_azimuth(ground: SiteGround) -> None:
    camera = preset("xc-55").cameras()[0].transform(nadir_pose(ground.surface, 0.0, 0.0, 10.0, azimuth_deg=70.0))
    np.testing.assert_allclose(-camera.down, direction(np.radians(70.0), 0.0), atol=1e-12)


def test_mast_pair_is_level_with_the_specified_baseline(ground: SiteGround) -> None:
    left, right = (
        camera.transform(mast_pose(ground.surface, 0.0, 0.0, 1.5, 120.0, -20.0))
        for camera in preset("mer-navcam").cameras()
    )
    assert abs(left.right[2]) < 1e-12
    # 0.20 m apart; for a view to 120 deg the right camera is south-west of the left camera.
    np.testing.assert_allclose(right.c - left.c, 0.20 * direction(np.radians(210.0), 0.0), atol=1e-9)


def test_horizontal_view_covers_sector_and_nadir_view_disc(ground: SiteGround) -> None:
    def make_viewpoint(name: str, height: float, azimuth: float, elevation: float) -> Viewpoint:
        camera_preset = preset(name)
        pose = camera_pose(ground.surface, camera_preset.design, 1.0, 2.0, height, azimuth, elevation)
        return Viewpoint.from_pose(PixelRays.from_camera(camera_preset.cameras()[0]), pose, ground.surface)

    pancam_viewpoint = make_viewpoint("research-pancam", 1.5, 90.0, -10.0)
    assert pancam_viewpoint.azimuth_rad == pytest.approx(np.radians(91.0), abs=0.01)  # left camera: 1 deg of toe-in
    assert pancam_viewpoint.half_width_rad < np.radians(20.0)
    assert np.isinf(pancam_viewpoint.max_distance_m)
    assert pancam_viewpoint.height_m == pytest.approx(1.5, abs=0.05)
    nadir_viewpoint = make_viewpoint("xc-55", 10.0, 0.0, -90.0)
    assert nadir_viewpoint.half_width_rad == np.pi
    # Half the diagonal field of view is 26 deg: 4.9 m at a height of 10 m.
    assert 4.9 < nadir_viewpoint.max_distance_m < 20.0


def test_min_rock_size_grows_with_distance(ground: SiteGround) -> None:
    field = ground.rocks
    # The radius is less than half a terrain period, so that no rock occurs twice.
    viewpoint = Viewpoint(2.0, 3.0, 1.5, pixel_rad=5e-3, max_distance_m=12.0)
    objects = _select_rocks(ground, viewpoint)
    assert len(objects) > 100
    # Each body is at the horizontal position of its rock plus a multiple of the period.
    offsets_m = objects.spheres[:, :2] - field.position_m[objects.names, :2]
    offsets_m -= field.period_m * np.rint(offsets_m / field.period_m)
    diameter = field.diameter_m[objects.names]
    assert (np.hypot(*offsets_m.T) <= diameter).all()
    # Selected rocks have at least 0.8 of the minimum size; all rocks above 1.25 of the minimum size are selected.
    distance = np.hypot(np.hypot(objects.spheres[:, 0] - 2.0, objects.spheres[:, 1] - 3.0), 1.5)
    limit = SMALLEST_ROCK_PX * viewpoint.pixel_rad
    assert (diameter / distance > 0.8 * limit).all()
    assert distance.max() <= 13.0
    all_rocks = field.near(2.0, 3.0, 11.9, detail=0)
    centres = all_rocks.vertices[all_rocks.faces].mean(axis=1)[::20]
    slant = np.hypot(np.hypot(*(centres[:, :2] - (2.0, 3.0)).T), 1.5)
    is_required = field.diameter_m[all_rocks.rock_of_face[::20]] > 1.25 * limit * slant
    assert set(all_rocks.rock_of_face[::20][is_required]) <= set(objects.names)


@pytest.mark.slow
def test_triangle_count_is_near_its_limit() -> None:
    rocky_ground = SiteGround.from_site(_make_small_site("pisgah", 1024), "ground")
    viewpoint = Viewpoint(0.0, 0.0, 1.5, pixel_rad=3e-4, half_width_rad=np.radians(30.0))
    # The limits are approximate.
    max_triangles = ROCK_TRIANGLES + DETAIL_TRIANGLES
    assert 0.25 * max_triangles < len(_select_rocks(rocky_ground, viewpoint).triangles) < 1.7 * max_triangles


def test_ground_without_rocks_has_no_objects() -> None:
    ground_without_rocks = SiteGround.from_site(_make_small_site("ivanpah"), "ground")
    assert ground_without_rocks.rocks is None
    assert len(_select_rocks(ground_without_rocks, Viewpoint(0.0, 0.0, 1.5, 1e-3))) == 0


def test_photometry_has_the_sky_radiance_of_the_environment(ground: SiteGround) -> None:
    photometry = ground.photometry(SUN)
    sky_fraction = ground.site.environment.sky_fraction(np.radians(35.0), ground.terrain.albedo)
    assert photometry.sky_fraction == photometry.sky_radiance == sky_fraction
    assert photometry.surrounding_albedo == ground.terrain.albedo


def test_scene_from_mast_and_nadir_has_the_terrain_heights(ground: SiteGround) -> None:
    renderer = process_renderer(default_backend())
    for axis, pose in (
        ((1.0, 0.0, 0.0), mast_pose(ground.surface, 5.0, 6.0, 1.5, 40.0, -15.0)),
        ((0.0, 0.0, -1.0), nadir_pose(ground.surface, 5.0, 6.0, 10.0)),
    ):
        camera = Cahv.from_field_of_view(np.radians(45.0), (160, 120), axis=axis, right=(0.0, -1.0, 0.0))
        rays = PixelRays.from_camera(camera)
        frame = renderer.render(site_scene(ground, Viewpoint.from_pose(rays, pose, ground.surface), SUN), rays, pose)
        # Distant ground is smoothed.
        points = frame.points_world()[(frame.body == -1) & (frame.range_m < 12.0)]
        assert len(points) > 5000
        # A few pixels at grazing angles use a smoothed terrain level and have larger errors.
        height_errors = np.abs(points[:, 2] - ground.surface.height(*points[:, :2].T))
        assert np.mean(height_errors > 0.02) < 0.005
        assert np.isfinite(frame.radiance).all()
        assert (frame.body >= 0).any()


@pytest.mark.parametrize("azimuth", [0.4, -2.8])
def test_sector_contains_the_rocks_of_the_full_circle(azimuth: float) -> None:
    """The sector has the same triangles as the full circle, also for rocks that repeat with the terrain period."""
    ground = SiteGround.from_site(_make_small_site("gusev", 512), "ground", seed=3)
    full_viewpoint = Viewpoint(0.4, 1.0, 1.2, 4e-3, max_distance_m=1.4 * ground.surface.period_m)
    sector_viewpoint = replace(full_viewpoint, azimuth_rad=azimuth, half_width_rad=0.3)
    full_circle, sector = (_select_rocks(ground, viewpoint) for viewpoint in (full_viewpoint, sector_viewpoint))
    offsets_m = full_circle.triangles[:, 0, :2] - (0.4, 1.0)
    angle_from_axis = np.abs((np.arctan2(offsets_m[:, 0], offsets_m[:, 1]) - azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    # Within 5 m of the viewpoint, rocks outside the sector are included for their shadows.
    is_in_sector = (angle_from_axis <= 0.3) | (np.hypot(*offsets_m.T) <= 5.0)
    assert 0.05 < np.mean(is_in_sector) < 0.6
    np.testing.assert_array_equal(sector.triangles, full_circle.triangles[is_in_sector])
    np.testing.assert_array_equal(sector.normals, full_circle.normals[is_in_sector])
    names = np.repeat(full_circle.names, np.diff(full_circle.first_triangle))[is_in_sector]
    np.testing.assert_array_equal(np.repeat(sector.names, np.diff(sector.first_triangle)), names)
