"""Tests of hills on the horizon, of unresolved rocks, and of the rover in hazard-camera images."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from marsyard.scenarios.horizon import horizon_relief
from marsyard.scenarios.views import SiteGround
from marsyard.scenarios.visible_rocks import add_unresolved_rocks
from marsyard.sim.render import Frame, Scene, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.render.rover import ROVER_NAME
from marsyard.sim.terrain import RockField, Surface, site
from marsyard.sim.terrain.sites import Hill
from marsyard.site_images import ImageRequest, RenderedImage, render_images
from tests.sim.scenes import flat_ground

LEVEL = flat_ground(64, 1.0)
HILL = Hill(azimuth_deg=60.0, distance_m=3000.0, width_m=800.0, depth_m=600.0, height_m=90.0)
MARS_RADIUS_M = 3.39e6
#: Values of `Frame.body` for pixels without an object. As negative indices they select the last two object names.
SKY, GROUND = -2, -1


def _tangents(hill: Hill, surface: Surface = LEVEL) -> np.ndarray:
    """Return the tangents of elevation of a hill's upper edge, by azimuth in equal steps."""
    return horizon_relief([hill], surface, 0.0, 0.2).elevations[0]


def test_hill_stands_at_its_azimuth_and_elevation() -> None:
    tangents = _tangents(HILL)
    top = np.argmax(tangents)
    assert 360.0 * top / len(tangents) == pytest.approx(60.0, abs=4.0)
    # the irregularity, with an RMS of a quarter, raises or lowers the top of the dome
    assert 0.5 * 90.0 / 3000.0 < tangents[top] < 2.0 * 90.0 / 3000.0


def test_hill_is_lower_by_the_curvature_of_the_planet() -> None:
    distant_hill = HILL.model_copy(
        update={"distance_m": 9000.0, "width_m": 2400.0, "depth_m": 1800.0, "height_m": 270.0}
    )
    # seen from the site, both hills are equal without curvature
    drop = (9000.0 - 3000.0) / (2.0 * MARS_RADIUS_M)
    assert _tangents(HILL) - _tangents(distant_hill) == pytest.approx(drop, rel=1e-2)


def test_relief_is_equal_in_all_images_of_a_terrain_and_differs_between_terrains() -> None:
    samples = np.full((64, 64, 2), 0.2, dtype=np.float32)
    other = Surface.from_samples(samples, 1.0)
    assert np.array_equal(_tangents(HILL), _tangents(HILL))
    assert np.abs(_tangents(HILL) - _tangents(HILL, other)).max() > 1e-3


@pytest.fixture(scope="module")
def gusev_image() -> RenderedImage:
    """Return the image of a navigation camera towards the Columbia Hills."""
    request = ImageRequest.from_defaults("gusev", "mer-navcam", azimuth_deg=100.0, elevation_deg=-12.0)
    return render_images(request, detector=False, both=False)[0]


@pytest.mark.slow
def test_navigation_camera_sees_the_hills_of_gusev_above_the_horizon(gusev_image: RenderedImage) -> None:
    frame = gusev_image.frame
    plain = process_renderer(default_backend()).render(
        replace(gusev_image.scene, horizon=None), frame.rays, frame.world_from_body
    )
    is_hill = np.isinf(frame.range_m) & (np.abs(frame.radiance / plain.radiance - 1.0) > 0.05)
    up_components = frame.rays.directions.reshape(*is_hill.shape, 3) @ frame.world_from_body.rotation.as_matrix()[2]
    # The hill at this azimuth is 85 m high, at a distance of 2900 m.
    assert np.degrees(np.arcsin(up_components[is_hill].max())) == pytest.approx(np.degrees(85.0 / 2900.0), abs=1.0)


@pytest.mark.slow
def test_rover_is_visible_at_the_sides_of_its_hazard_camera() -> None:
    request = ImageRequest.from_defaults("meridiani", "mer-hazcam")
    image = render_images(request, detector=False, both=False)[0]
    is_rover = np.append(image.scene.objects.names, [SKY, GROUND])[image.frame.body] == ROVER_NAME
    columns = is_rover.shape[1]
    assert is_rover[:, : columns // 4].any()
    assert is_rover[:, -columns // 4 :].any()
    middle = is_rover[is_rover.shape[0] // 4 : 3 * is_rover.shape[0] // 4, columns // 3 : 2 * columns // 3]
    assert not middle.any()


@pytest.mark.slow
def test_unresolved_rocks_occlude_distant_ground_by_their_frontal_area(gusev_image: RenderedImage) -> None:
    image = gusev_image
    frame, ground = image.frame, SiteGround.from_site(site("gusev"), "ground")
    rocks, limit_rad, rms_slope = ground.rocks, 1.2e-3, 0.02
    # With black ground and white rocks the radiance is the occluded fraction.
    is_ground = frame.body == GROUND
    black_ground = replace(frame, radiance=np.where(is_ground, 0.0, 1.0).astype(np.float32))
    blended = add_unresolved_rocks(black_ground, image.scene, rocks, limit_rad, rms_slope)
    row, column = np.argwhere(is_ground & (frame.range_m > 100.0))[0]
    is_unresolved = rocks.diameter_m < limit_rad * frame.range_m[row, column]
    # A silhouette has 0.85 of the area of its bounding rectangle.
    area_fraction = 0.85 * np.sum((rocks.diameter_m * rocks.height_m)[is_unresolved]) / rocks.period_m**2
    ray = frame.rays.directions.reshape(*is_ground.shape, 3)[row, column]
    elevation = np.arcsin(frame.world_from_body.rotation.apply(ray)[2])
    expected = 1.0 - np.exp(-area_fraction / np.hypot(np.tan(elevation), rms_slope))
    assert blended.radiance[row, column] == pytest.approx(expected, rel=1e-3)
    assert expected > 0.3
    is_near = is_ground & (frame.range_m < 3.0)
    assert blended.radiance[is_near].max() < 0.01
    np.testing.assert_array_equal(blended.radiance[~is_ground], black_ground.radiance[~is_ground])


def test_meshes_of_users_are_not_rocks() -> None:
    """An image without rocks has no mean radiance of rocks, even if it shows a lander."""
    frame = cast(Frame, SimpleNamespace(body=np.array([[GROUND, 0]]), radiance=np.ones((1, 2))))
    scene = SimpleNamespace(objects=SimpleNamespace(names=np.array([FIRST_MESH_NUMBER])))
    assert add_unresolved_rocks(frame, cast(Scene, scene), cast(RockField, [None]), 1e-3, 0.0) is frame


def test_ground_without_rocks_is_unchanged() -> None:
    frame = SimpleNamespace(body=np.full((2, 2), GROUND), radiance=np.ones((2, 2)))
    scene = SimpleNamespace(objects=SimpleNamespace(names=np.empty(0, dtype=np.int64)))
    unchanged = add_unresolved_rocks(cast(Frame, frame), cast(Scene, scene), None, 1e-3, 0.0)
    np.testing.assert_array_equal(unchanged.radiance, frame.radiance)
