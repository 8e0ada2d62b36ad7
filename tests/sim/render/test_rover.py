"""Tests of the rendered rover: shape, pose and extent of its shadow."""

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.validation.raycast import cast_triangles
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, Stance, settle
from marsyard.sim.frames import direction
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render import Objects, Renderer, Scene, Sun, may_cast_shadow
from marsyard.sim.render.rover import ROVER_NAME, rover_objects, rover_sphere
from marsyard.sim.sensor.mast import MER_MAST, RESEARCH_MAST, stereo_mast
from tests.sim.dynamics.grounds import Mounds, Plane, uphill_east
from tests.sim.scenes import LAMBERT, NEAR_MESH, flat_ground, look_down

EAST = 0.5 * np.pi


@pytest.fixture(scope="module")
def stance() -> Stance:
    """Return the stance of a rover on level ground, heading east."""
    return settle(MER, Plane(), 0.0, 0.0, EAST)


@pytest.fixture(scope="module")
def objects(stance: Stance) -> Objects:
    return rover_objects(MER, stance, MER_MAST, 0.0, 0.0)


@pytest.mark.parametrize(("rover", "mast"), [(MER, MER_MAST), (ROCKY_8, RESEARCH_MAST)])
def test_rover_stands_on_the_ground_with_specified_size(rover: RoverParameters, mast: MastGeometry) -> None:
    stance = settle(rover, Plane(height_m=2.0), 10.0, 20.0, EAST)
    objects = rover_objects(rover, stance, mast, 0.0, 0.0)
    low, high = objects.triangles.min(axis=(0, 1)), objects.triangles.max(axis=(0, 1))
    # The lowest point of a wheel is a cleat, or between two cleats 18 deg apart: at most 1.3 % of the radius higher.
    assert low[2] == pytest.approx(2.0, abs=0.013 * rover.wheel_radius_m)
    # The head extends 0.04 m above its centre.
    assert high[2] == pytest.approx(2.0 + (mast.base_m + mast.elbow_m + mast.head_m)[2] + 0.04, abs=1e-9)
    assert (low[1], high[1]) == pytest.approx(
        (20.0 - 0.5 * rover.body_width_m, 20.0 + 0.5 * rover.body_width_m), abs=0.2
    )
    # deck, body with legs and arm, six wheels, and mast
    assert len(objects) == 9
    assert set(objects.names.tolist()) == {ROVER_NAME}


def test_normals_point_outwards(stance: Stance) -> None:
    objects = rover_objects(MER, stance, MER_MAST, 0.3, -0.2)
    # For closed bodies the flux of the position vector through the faces is three times the volume, so it is positive.
    face_normals = np.cross(*(objects.triangles[:, corner] - objects.triangles[:, 0] for corner in (1, 2)))
    assert np.einsum("ti,ti->", objects.triangles[:, 0], face_normals) > 0.0
    lengths = np.linalg.norm(face_normals, axis=1, keepdims=True)
    # The sides of cylinders are smooth: at most 28 deg between the normals of a corner and of a face, on spokes.
    cosines = np.einsum("tci,ti->tc", objects.normals, face_normals / lengths)
    assert cosines.min() > np.cos(np.radians(28.0))


def test_wheels_have_cleats_and_are_open_between_their_spokes(stance: Stance, objects: Objects) -> None:
    centre = stance.world_from_rover.apply(MER.wheel_centres_m[0])
    # the rover faces east: the axis of a wheel is the y axis. Rays are not parallel to any face
    angles = np.radians(np.arange(0.1, 360.0, 1.5))
    radial = np.stack([np.cos(angles), np.full(angles.size, 1e-3), np.sin(angles)], axis=1)
    radii = 0.3 - cast_triangles(objects, centre + np.array([0.0, 0.03, 0.0]) + 0.3 * radial, -radial, nearest=1e-3)
    is_tread = (radii < 1.001 * MER.wheel_radius_m) & (radii > 0.9 * MER.wheel_radius_m)
    # 20 cleats stand 5 % of the radius above the tread; legs hide a part of it
    assert radii[is_tread].max() == pytest.approx(MER.wheel_radius_m, rel=0.01)
    assert np.percentile(radii[is_tread], 2) == pytest.approx(0.95 * MER.wheel_radius_m, rel=0.02)
    # along the axis, rays pass between the spokes
    outside = centre + np.array([0.0, 0.2, 0.0]) + 0.6 * MER.wheel_radius_m * radial
    through = cast_triangles(objects, outside, np.tile([1e-3, -1.0, 2e-3], (len(radial), 1)), nearest=1e-3)
    assert 0.3 < np.mean(through > 0.3) < 0.9


def test_deck_has_gaps_between_its_panels_and_carries_antennas(objects: Objects) -> None:
    # along the front edges of the left panels, seen from above, the deck is interrupted
    y = np.linspace(0.0, 0.75, 301)
    above = np.column_stack([np.full(y.size, 0.58), y, np.full(y.size, 2.0)])
    heights = 2.0 - cast_triangles(objects, above, np.tile([1e-3, 2e-3, -1.0], (y.size, 1)), nearest=1e-3)
    is_deck = heights > MER.deck_m
    assert np.count_nonzero(np.diff(is_deck.astype(int))) >= 3
    # the low-gain antenna stands 0.55 m above the deck, behind the mast
    corners = objects.triangles.reshape(-1, 3)
    behind = corners[corners[:, 0] < 0.2]
    assert behind[:, 2].max() == pytest.approx(MER.deck_m + 0.55, abs=1e-6)


def test_only_front_wheels_turn(stance: Stance, objects: Objects) -> None:
    steering = 0.2
    turned = rover_objects(MER, stance, MER_MAST, 0.0, 0.0, steering_rad=steering)
    bodies = list(pairwise(objects.first_triangle))
    has_moved = [not np.allclose(objects.triangles[a:b], turned.triangles[a:b]) for a, b in bodies]
    # deck, body, wheels in the order of `WHEELS`, mast
    assert has_moved == [False, False, True, False, False, True, False, False, False]
    wheel = turned.triangles[turned.first_triangle[2] : turned.first_triangle[3]].reshape(-1, 3)
    # positive angles turn the wheel to the left, here from east to north: its rim is long along this direction
    across = (wheel - wheel.mean(axis=0)) @ np.array([-np.sin(steering), np.cos(steering), 0.0])
    assert np.ptp(across) == pytest.approx(MER.wheel_width_m, abs=0.01)


def test_wheels_follow_the_suspension() -> None:
    # The left front wheel stands on a block: its lowest points are at the height of the block.
    stance = settle(MER, Mounds(((0.705, 0.53, 0.1),)), 0.0, 0.0, EAST)
    corners = rover_objects(MER, stance, MER_MAST, 0.0, 0.0).triangles.reshape(-1, 3)
    for x, y, height in ((0.705, 0.53, 0.1), (0.705, -0.53, 0.0), (-0.705, 0.53, 0.0)):
        near_wheel = corners[np.hypot(corners[:, 0] - x, corners[:, 1] - y) < 0.15]
        assert near_wheel[:, 2].min() == pytest.approx(height, abs=0.01)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0.0, 10.0), (0.0, -35.0), (70.0, -20.0), (-150.0, -35.0)])
def test_head_does_not_occlude_its_cameras(azimuth_deg: float, elevation_deg: float, stance: Stance) -> None:
    angles = (float(np.radians(azimuth_deg)), float(np.radians(elevation_deg)))
    pair = stereo_mast("mer-navcam")
    objects = rover_objects(MER, stance, pair.geometry, *angles, baseline_m=0.2)
    world_from_head = stance.world_from_rover * pair.geometry.rover_from_head(*angles)
    for camera in (pair.left.transform(world_from_head), pair.right.transform(world_from_head)):
        # Only the central part of the image is tested, because targets appear there.
        u, v = np.meshgrid(np.linspace(430.0, 590.0, 9), np.linspace(430.0, 590.0, 9))
        origins, directions = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
        hit_distances = cast_triangles(objects, origins, directions, nearest=1e-3)
        # Views to the side and down show the deck 0.9 m below, views ahead do not.
        assert hit_distances.min() > (0.9 if azimuth_deg else 100.0)


@pytest.mark.parametrize(("rover", "mast"), [(MER, MER_MAST), (ROCKY_8, RESEARCH_MAST)])
def test_sphere_contains_the_rover_in_any_stance(rover: RoverParameters, mast: MastGeometry) -> None:
    rng = np.random.default_rng(2)
    relative_radii = []
    for _ in range(20):
        blocks = Mounds(tuple((float(x), float(y), 0.25) for x, y in rng.uniform(-0.8, 0.8, (3, 2))))
        stance = settle(rover, blocks, 0.0, 0.0, float(rng.uniform(0.0, 6.0)))
        corners = rover_objects(rover, stance, mast, *rng.uniform(-1.5, 1.5, 2)).triangles.reshape(-1, 3)
        *centre, radius = rover_sphere(rover, stance, mast)[0]
        relative_radii.append(np.linalg.norm(corners - centre, axis=1).max() / radius)
    # The sphere is not much larger than necessary.
    assert 0.7 < max(relative_radii) <= 1.0


def test_rover_casts_shadows_only_away_from_the_sun(objects: Objects) -> None:
    sun_direction = direction(EAST, np.radians(20.0))
    # The mast top at 1.6 m has a shadow 4.4 m to the west and none to the east.
    corners = objects.triangles.reshape(-1, 3)
    shadow = corners - corners[:, 2:] / sun_direction[2] * sun_direction
    for position in shadow[:: len(shadow) // 50]:
        assert may_cast_shadow(objects.spheres, sun_direction, position, 0.0)
    assert not may_cast_shadow(objects.spheres, sun_direction, np.array([2.5, 0.0, 0.0]), 0.3)
    assert may_cast_shadow(objects.spheres, sun_direction, np.array([2.5, 0.0, 0.0]), 2.0)
    assert not may_cast_shadow(objects.spheres, sun_direction, np.array([-8.0, 0.0, 0.0]), 0.3)
    assert not may_cast_shadow(objects.spheres, sun_direction, np.array([-2.0, 4.0, 0.0]), 0.3)


def test_mast_shadow_is_opposite_the_sun(renderer: Renderer) -> None:
    surface = flat_ground(64, 1.0)
    stance = settle(MER, surface, 32.0, 32.0, 0.0)
    elevation = np.radians(25.0)
    sun = Sun(direction(EAST, elevation))
    objects = rover_objects(MER, stance, MER_MAST, 0.0, 0.0)
    scene = Scene(surface, (32.0, 32.0), sun, LAMBERT, objects, edge_rays=1, **NEAR_MESH)
    # A point high on the mast, whose shadow is outside that of the deck: in the west at height / tan(elevation).
    mast = stance.world_from_rover.apply(np.array([*MER_MAST.base_m[:2], 0.0]))
    height_m = 1.28
    expected = mast + np.array([-height_m / np.tan(elevation), 0.0, 0.0])
    frame = look_down(renderer, scene, tuple(expected + np.array([0.0, 0.0, 6.0])), 0.1, 101)
    points = frame.points_world()
    is_shaded = frame.radiance < 0.1 * frame.radiance.max()
    assert 0.1 < np.mean(is_shaded) < 0.5
    # The shadow is a band along the east-west direction, as wide as the mast (radius 0.028 m).
    band_points = points[is_shaded & (np.abs(points[..., 0] - expected[0]) < 0.1)]
    assert band_points[:, 1].mean() == pytest.approx(expected[1], abs=0.01)
    assert np.ptp(band_points[:, 1]) == pytest.approx(2 * 0.028, abs=0.02)


def test_rover_tilts_with_the_ground() -> None:
    stance = settle(MER, uphill_east(10.0), 0.0, 0.0, EAST)
    objects = rover_objects(MER, stance, MER_MAST, 0.0, 0.0)
    on_level_ground = rover_objects(MER, settle(MER, Plane(), 0.0, 0.0, EAST), MER_MAST, 0.0, 0.0)
    assert objects.triangles.reshape(-1, 3) == pytest.approx(
        stance.world_from_rover.apply(on_level_ground.triangles.reshape(-1, 3)), abs=1e-9
    )
