"""Views of a site: poses, the rocks that are drawn, and scenes that render."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marsyard.scenarios.views import (
    DETAIL_TRIANGLES,
    ROCK_TRIANGLES,
    SMALLEST_ROCK_PX,
    STANCES,
    Eye,
    SiteGround,
    camera_pose,
    mast_pose,
    nadir_pose,
    select_rocks,
    site_scene,
)
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction
from marsyard.sim.render import PixelRays, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor import PRESETS, preset
from marsyard.sim.terrain import Site, site

SUN = Sun(direction(np.radians(250.0), np.radians(35.0)))


def _small(name: str, samples: int = 512) -> Site:
    """A preset whose ground is built in a moment."""
    full = site(name)
    assert full.ground is not None
    return full.model_copy(update={"ground": full.ground.model_copy(update={"samples": samples})})


@pytest.fixture(scope="module")
def ground() -> SiteGround:
    return SiteGround.of(_small("gusev", 1024), "ground", seed=3)


def test_every_camera_has_a_usual_stance() -> None:
    assert set(STANCES) == set(PRESETS)


def test_site_without_this_scale_is_refused() -> None:
    with pytest.raises(ValueError, match="no terrain at the scale 'descent'"):
        SiteGround.of(site("mars-yard"), "descent")


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, -90.0), (70.0, -40.0), (200.0, -10.0)])
def test_camera_looks_where_it_is_reported(ground: SiteGround, name: str, azimuth: float, elevation: float) -> None:
    design = preset(name).design
    pose = camera_pose(ground.surface, design, 3.0, 4.0, 5.0, azimuth, elevation)
    axes = [camera.moved(pose).a for camera in preset(name).cameras()]
    # the axes of a pair that toes in look to both sides of the middle
    middle = np.mean(axes, axis=0)
    expected = direction(np.radians(azimuth), np.radians(elevation))
    np.testing.assert_allclose(middle / np.linalg.norm(middle), expected, atol=1e-12)
    height = float(ground.surface.height(3.0, 4.0)) + 5.0
    np.testing.assert_allclose(pose.translation, [3.0, 4.0, height], atol=1e-12)


def test_upper_edge_of_a_picture_from_above_faces_the_azimuth(ground: SiteGround) -> None:
    camera = preset("xc-55").cameras()[0].moved(nadir_pose(ground.surface, 0.0, 0.0, 10.0, azimuth_deg=70.0))
    np.testing.assert_allclose(-camera.down, direction(np.radians(70.0), 0.0), atol=1e-12)


def test_mast_is_upright(ground: SiteGround) -> None:
    left, right = (
        camera.moved(mast_pose(ground.surface, 0.0, 0.0, 1.5, 120.0, -20.0))
        for camera in preset("mer-navcam").cameras()
    )
    assert abs(left.right[2]) < 1e-12
    # 0.20 m apart, the right one to the right: south-west of the left one when looking to 120 deg
    np.testing.assert_allclose(right.c - left.c, 0.20 * direction(np.radians(210.0), 0.0), atol=1e-9)


def test_eye_facing_the_horizon_sees_a_sector_and_one_from_above_a_disc(ground: SiteGround) -> None:
    def eye(name: str, height: float, azimuth: float, elevation: float) -> Eye:
        of_camera = preset(name)
        pose = camera_pose(ground.surface, of_camera.design, 1.0, 2.0, height, azimuth, elevation)
        return Eye.of(PixelRays.of(of_camera.cameras()[0]), pose, ground.surface)

    pancam = eye("research-pancam", 1.5, 90.0, -10.0)
    assert pancam.azimuth_rad == pytest.approx(np.radians(91.0), abs=0.01)  # the left one, toed in by 1 deg
    assert pancam.half_width_rad < np.radians(20.0)
    assert np.isinf(pancam.reach_m)
    assert pancam.height_m == pytest.approx(1.5, abs=0.05)
    above = eye("xc-55", 10.0, 0.0, -90.0)
    assert above.half_width_rad == np.pi
    # 26 deg to the corner: 4.9 m
    assert 4.9 < above.reach_m < 20.0


def test_rocks_shrink_with_distance_and_keep_their_numbers(ground: SiteGround) -> None:
    field = ground.rocks
    assert field is not None
    # within half a period, so that no rock is there twice
    eye = Eye(2.0, 3.0, 1.5, pixel_rad=5e-3, reach_m=12.0)
    seen = select_rocks(ground, eye)
    assert len(seen) > 100
    # each body lies over its rock's place, in some period
    apart = seen.spheres[:, :2] - field.position_m[seen.names, :2]
    apart -= field.period_m * np.rint(apart / field.period_m)
    diameter = field.diameter_m[seen.names]
    assert (np.hypot(*apart.T) <= diameter).all()
    # none is far too small; all that are larger by the width of a class are there
    distance = np.hypot(np.hypot(seen.spheres[:, 0] - 2.0, seen.spheres[:, 1] - 3.0), 1.5)
    limit = SMALLEST_ROCK_PX * eye.pixel_rad
    assert (diameter / distance > 0.8 * limit).all()
    assert distance.max() <= 13.0
    every = field.near(2.0, 3.0, 11.9, detail=0)
    centres = every.vertices[every.faces].mean(axis=1)[::80]
    sure = field.diameter_m[every.rock_of_face[::80]] > 1.25 * limit * np.hypot(*(centres[:, :2] - (2.0, 3.0)).T)
    assert set(every.rock_of_face[::80][sure]) <= set(seen.names)


def test_triangles_stay_within_their_budget() -> None:
    crowded = SiteGround.of(_small("pisgah", 1024), "ground")
    eye = Eye(0.0, 0.0, 1.5, pixel_rad=3e-4, half_width_rad=np.radians(30.0))
    most = ROCK_TRIANGLES + DETAIL_TRIANGLES
    assert 0.25 * most < len(select_rocks(crowded, eye).triangles) < 1.7 * most


def test_ground_without_rocks_has_no_objects() -> None:
    bare = SiteGround.of(_small("ivanpah"), "ground")
    assert bare.rocks is None
    assert len(select_rocks(bare, Eye(0.0, 0.0, 1.5, 1e-3))) == 0


def test_sky_is_as_bright_as_its_light(ground: SiteGround) -> None:
    light = ground.photometry(SUN)
    assert light.sky_share == light.sky_radiance == ground.site.environment.sky_share(np.radians(35.0))
    assert light.surrounding_albedo == ground.terrain.albedo


def test_scene_renders_from_mast_and_from_above(ground: SiteGround) -> None:
    renderer = process_renderer(default_backend())
    for axis, pose in (
        ((1.0, 0.0, 0.0), mast_pose(ground.surface, 5.0, 6.0, 1.5, 40.0, -15.0)),
        ((0.0, 0.0, -1.0), nadir_pose(ground.surface, 5.0, 6.0, 10.0)),
    ):
        camera = Cahv.from_field_of_view(np.radians(45.0), (160, 120), axis=axis, right=(0.0, -1.0, 0.0))
        rays = PixelRays.of(camera)
        frame = renderer.render(site_scene(ground, Eye.of(rays, pose, ground.surface), SUN), rays, pose)
        # farther away the ground is seen smoothed
        points = frame.points_world()[(frame.body == -1) & (frame.range_m < 12.0)]
        assert len(points) > 5000
        # a few pixels at flat angles take a smoothed level, or the mesh's own height
        off = np.abs(points[:, 2] - ground.surface.height(*points[:, :2].T))
        assert np.mean(off > 0.02) < 0.005
        assert np.isfinite(frame.radiance).all()
        assert (frame.body >= 0).any()


@pytest.mark.parametrize("azimuth", [0.4, -2.8])
def test_a_sector_s_rocks_are_those_of_the_whole_circle_that_lie_in_it(azimuth: float) -> None:
    """Triangle for triangle, also where rocks repeat after the terrain's period."""
    ground = SiteGround.of(_small("gusev", 512), "ground", seed=3)
    all_round = Eye(0.4, 1.0, 1.2, 4e-3, reach_m=1.4 * ground.surface.period_m)
    eye = replace(all_round, azimuth_rad=azimuth, half_width_rad=0.3)
    whole, some = (select_rocks(ground, one) for one in (all_round, eye))
    away = whole.triangles[:, 0, :2] - (0.4, 1.0)
    turned = np.abs((np.arctan2(away[:, 0], away[:, 1]) - azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    inside = (turned <= 0.3) | (np.hypot(*away.T) <= 5.0)
    assert 0.05 < np.mean(inside) < 0.6
    np.testing.assert_array_equal(some.triangles, whole.triangles[inside])
    np.testing.assert_array_equal(some.normals, whole.normals[inside])
    names = np.repeat(whole.names, np.diff(whole.first_triangle))[inside]
    np.testing.assert_array_equal(np.repeat(some.names, np.diff(some.first_triangle)), names)
