"""Tests of the sky's light on surfaces against numerical integration over directions."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from benchmarks.validation.raycast import cast_triangles
from marsyard.scenarios.views import nadir_pose
from marsyard.sim.camera import Cahv
from marsyard.sim.dynamics.rover import MER, settle
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import DustySky, Objects, Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_host, vectors_to_device
from marsyard.sim.render.device import Array3f, Array3f64, Bool
from marsyard.sim.render.obstructions import Mounds, Shelter
from marsyard.sim.render.rover import rover_objects
from marsyard.sim.render.shadows import AUREOLE_BEHIND_BODY
from marsyard.sim.render.sky import AUREOLE_RADIUS_RAD, SkyLight
from marsyard.sim.sensor.mast import MER_MAST
from marsyard.sim.terrain import Environment
from tests.sim.scenes import DOWN, LAMBERT, flat_ground, make_ground, mesh_body

SUN = Sun(direction(0.4, np.radians(40.0)))


def _draw_sphere(log2_count: int) -> Float64[np.ndarray, "n 3"]:
    """Draw directions that are distributed uniformly over the sphere."""
    up, turns = qmc.Sobol(2, rng=np.random.default_rng(1)).random_base2(log2_count).T
    z = 2.0 * up - 1.0
    horizontal, azimuth = np.sqrt(1.0 - z * z), 2.0 * np.pi * turns
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), z], axis=1)


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 90.0, 150.0])
def test_tilted_surfaces_receive_the_light_of_a_linear_sky(tilt_deg: float) -> None:
    light = SkyLight.of(0.4, mean_radiance=1.1, towards_sun=0.15, sun=SUN.direction)
    normal = direction(2.0, np.radians(90.0 - tilt_deg))
    directions = _draw_sphere(16)
    gradient = to_host(light.gradient)[0].astype(np.float64)
    radiance = 0.4 * (to_host(light.base)[0] + directions @ gradient) * (directions[:, 2] > 0.0)
    # 1 / pi times the solid angle 4 pi of the sphere
    expected = 4.0 * float(np.mean(radiance * np.maximum(directions @ normal, 0.0)))
    surface = vectors_to_device(Array3f, normal[None])
    assert to_host(light.irradiance(surface, Array3f(0.0)))[0] == pytest.approx(expected, abs=1e-3)


def test_moments_of_the_linear_sky_are_those_of_the_dusty_sky() -> None:
    light = DustySky(0.9, 0.94, 0.65).light(SUN, 0.45)
    gradient, base = to_host(light.gradient)[0], to_host(light.base)[0]
    # level ground receives the specified irradiance: base + 2/3 of the vertical gradient is 1
    assert base + gradient[2] / 1.5 == pytest.approx(1.0, abs=1e-6)
    azimuth = SUN.direction[:2] / np.linalg.norm(SUN.direction[:2])
    towards_sun = gradient[:2] @ azimuth
    assert gradient[:2] == pytest.approx(towards_sun * azimuth, abs=1e-6)
    # light scattered once, and not forwards, is brighter on the side of the sun: in the plane of the sun
    # P(g') = 1 + 3 * 0.39 cos(g) + ..., so the relative gradient is about 3 * 0.39 cos(40 deg) = 0.9
    assert 0.5 < towards_sun < 1.2


@pytest.mark.parametrize("elevation_deg", [0.05, 1.0])
def test_light_of_a_dusty_sky_under_a_very_low_sun_is_finite(elevation_deg: float) -> None:
    sun = Sun(direction(0.4, np.radians(elevation_deg)))
    light = DustySky(10.0, 0.94, 0.65).light(sun, 0.45)
    assert np.isfinite(to_host(light.gradient)).all()
    assert 0.0 < DustySky(10.0, 0.94, 0.65).disc_fraction(float(sun.direction[2])) < 1.0


def _draw_aureole(log2_count: int) -> Float64[np.ndarray, "n 3"]:
    """Draw directions that are distributed uniformly over the aureole."""
    directions = _draw_sphere(log2_count)
    return directions[directions @ SUN.direction > np.cos(AUREOLE_RADIUS_RAD)]


def _is_hit_by_half_sphere(position: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return which directions from a point on the ground meet the sphere around (2, 0, 0) with the radius 0.5."""
    offset = np.array([2.0, 0.0, 0.0]) - position
    along = directions @ offset
    return (along > 0.0) & (offset @ offset - along**2 < 0.25)


def test_light_hidden_by_a_convex_body_equals_ray_casting() -> None:
    corners = np.array([[-1.0, -0.6], [1.0, -0.6], [1.0, 0.6], [-1.0, 0.6]])
    bottom, top = np.column_stack([0.5 * corners, np.full(4, 0.3)]), np.column_stack([corners, np.full(4, 0.7)])
    body = np.concatenate([bottom, top])
    quads = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))], dtype=np.int32)
    objects = Objects.of_mesh(body, body, faces, np.zeros(len(faces), dtype=np.int32), albedo=0.2)
    positions = np.array([[0.1, -0.2, 0.0], [0.9, 0.5, 0.0], [1.6, -0.3, 0.1], [-0.2, 2.5, 0.0], [0.0, 0.3, 1.2]])
    # in the body's shadow, and next to it
    shaded = np.array([[-0.8, -0.35, 0.0], [-0.6, 0.2, 0.0], [-1.2, -0.2, 0.0]])
    positions = np.concatenate([positions, shaded])
    shelter = Shelter.of(body, SUN.direction)
    hidden = shelter.hide_light(vectors_to_device(Array3f64, positions), Bool([True] * len(positions)))
    vectors, aureoles = to_host(hidden.sky), to_host(hidden.aureole)
    assert np.ptp(aureoles) > 0.4

    def is_hit(position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.isfinite(cast_triangles(objects, np.broadcast_to(position, directions.shape), directions))

    sphere, aureole = _draw_sphere(14), _draw_aureole(14)
    for position, vector, fraction in zip(positions, vectors, aureoles, strict=True):
        expected = 4.0 * np.mean(sphere * is_hit(position, sphere)[:, None], axis=0)
        assert vector == pytest.approx(expected, abs=6e-3)
        # two edges that meet on the aureole hide less than the product of what each would hide
        assert fraction == pytest.approx(np.mean(is_hit(position, aureole)), abs=0.1)
    inside = shelter.hide_light(vectors_to_device(Array3f64, np.array([[0.0, 0.0, 0.5]])), Bool([True]))
    assert to_host(inside.sky)[0] == pytest.approx(0.0)
    assert to_host(inside.aureole)[0] == 0.0


def test_light_hidden_by_a_half_sphere_equals_integration() -> None:
    # x, y, radius and top
    mounds = Mounds.of(np.array([[2.0, 0.0, 0.5, 0.5]]), SUN.direction)
    directions = _draw_sphere(17)
    directions = directions[directions[:, 2] > 0.0]
    positions = np.array([[1.3, 0.0, 0.0], [2.0, 1.2, 0.0], [0.5, -0.6, 0.0], [7.0, 0.0, 0.0]])
    # in the sphere's shadow, and at its edge
    positions = np.concatenate([positions, [[1.6, -0.4, 0.0], [2.0, -0.7, 0.0], [1.4, -0.2, 0.0]]])
    hidden = mounds.hide_light(vectors_to_device(Array3f64, positions), Bool([True] * len(positions)))
    vectors, aureoles, aureole = to_host(hidden.sky), to_host(hidden.aureole), _draw_aureole(16)
    assert np.ptp(aureoles) > 0.4
    for position, vector, fraction in zip(positions, vectors, aureoles, strict=True):
        if position[0] == 7.0:
            assert vector == pytest.approx(0.0)
            assert fraction == 0.0
            continue
        is_hit = _is_hit_by_half_sphere(position, directions)
        # half of the sphere: 2 pi / pi
        assert vector == pytest.approx(2.0 * np.mean(directions * is_hit[:, None], axis=0), abs=4e-3)
        assert fraction == pytest.approx(np.mean(_is_hit_by_half_sphere(position, aureole)), abs=0.02)


@pytest.mark.parametrize("elevation_deg", [25.0, 45.0, 65.0])
def test_a_half_sphere_leaves_the_stated_fraction_of_the_aureole_in_its_shadow(elevation_deg: float) -> None:
    sun = direction(0.4, np.radians(elevation_deg))
    x, y = np.random.default_rng(3).uniform(-3.0, 3.0, (2, 40000))
    positions = np.column_stack([x + 2.0, y, np.zeros_like(x)])
    is_outside = np.hypot(x, y) > 0.5
    along = -(x * sun[0] + y * sun[1])
    is_shaded = is_outside & (along > 0.0) & (x**2 + y**2 - along**2 < 0.25)
    hidden = Mounds.of(np.array([[2.0, 0.0, 0.5, 0.5]]), sun).hide_light(
        vectors_to_device(Array3f64, positions[is_shaded]), Bool([True] * int(is_shaded.sum()))
    )
    assert 1.0 - to_host(hidden.aureole).mean() == pytest.approx(AUREOLE_BEHIND_BODY, abs=0.1)


@pytest.mark.parametrize("depth", [0.3, 0.9])
def test_thin_body_hides_the_disc_of_the_sun_only(renderer: Renderer, depth: float) -> None:
    """The shadow of a pole has the light of the sky and of the aureole."""
    air = Environment(optical_depth=depth)
    sky = DustySky(depth, air.single_scattering_albedo, air.asymmetry)
    sky_fraction = air.sky_fraction(np.radians(40.0))
    photometry = Photometry(0.0, 0.0, sky_fraction=sky_fraction, surrounding_albedo=0.0, sky=sky)
    pole = trimesh.creation.box((0.02, 0.02, 4.0))
    pole.apply_translation([6.4, 6.4, 2.0])
    objects = mesh_body(pole, -1)  # a part of a rover, not a body on the ground
    scene = Scene(
        flat_ground(256, 0.05),
        (6.4, 6.4),
        SUN,
        photometry,
        objects,
        mesh_finest_m=0.02,
        mesh_half_width_m=30.0,
        among_objects=True,
        edge_rays=1,
    )
    middle = np.array([6.4, 6.4, 0.0]) - 1.0 * SUN.direction / np.hypot(*SUN.direction[:2])
    rays = PixelRays.from_camera(Cahv.from_field_of_view(np.radians(5.0), (64, 64), **DOWN))
    image = renderer.render(scene, rays, nadir_pose(scene.surface, middle[0], middle[1], 3.0)).radiance
    up = SUN.direction[2]
    disc = np.exp(-air.single_scattering_albedo * air.asymmetry**2 * depth / up)
    expected = (sky_fraction + (1.0 - disc) * up) / (sky_fraction + up)
    assert image.min() / image.max() == pytest.approx(expected, rel=1e-3)


def test_rock_outside_of_the_image_hides_its_sky_also_next_to_a_rover(renderer: Renderer) -> None:
    """A rock without triangles in the restricted scene darkens the visible ground as it does in the full scene."""
    surface, middle = make_ground(np.zeros((256, 256)), 0.05), 6.4
    rover = rover_objects(MER, settle(MER, flat_ground(64, 0.2), middle, middle, 0.0), MER_MAST, 0.0, 0.0)
    rock = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    rock.apply_translation([middle + 2.35, middle, 0.0])
    objects = mesh_body(rock)
    photometry = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.45, sky=DustySky(0.9, 0.94, 0.65))
    # the shadows of rock and rover fall to the east, the image is north-west of the rock's centre
    sun = Sun(direction(1.5 * np.pi, np.radians(60.0)))
    scene = Scene(
        surface,
        (middle, middle),
        sun,
        photometry,
        objects,
        mesh_finest_m=0.02,
        mesh_half_width_m=30.0,
        among_objects=True,
    )
    rays = PixelRays.from_camera(Cahv.from_field_of_view(np.radians(5.0), (48, 48), **DOWN))
    pose = nadir_pose(surface, middle + 1.6, middle + 0.3, 3.0)
    restricted = scene.restrict_to_cones([rays.cone(pose)])
    assert len(restricted.objects) == 0
    views = [
        renderer.render(item.with_objects(Objects.join([item.objects, rover])), rays, pose).radiance
        for item in (scene, restricted, restricted.with_objects(Objects.none()))
    ]
    np.testing.assert_array_equal(views[1], views[0])
    # without the mound the ground is visibly brighter
    assert views[2].mean() > 1.005 * views[0].mean()


def test_rover_darkens_its_shadow_and_slopes_remain_visible_in_it(renderer: Renderer) -> None:
    """Below a rover the ground has a fraction of the sky's light, which comes from the side."""
    x = np.arange(256) * 0.05
    heights = 0.01 * np.sin(2.0 * np.pi * x / 0.4) * np.ones((256, 1))
    surface = make_ground(heights, 0.05)
    stance = settle(MER, flat_ground(64, 0.2), 6.4, 6.4, 0.5 * np.pi)
    photometry = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.45, sky=DustySky(0.9, 0.94, 0.65))
    objects = rover_objects(MER, stance, MER_MAST, 0.0, 0.0)
    sun = Sun(direction(1.5 * np.pi, np.radians(30.0)))
    scene = Scene(surface, (6.4, 6.4), sun, photometry, objects, mesh_finest_m=0.02, mesh_half_width_m=30.0)
    camera = Cahv.from_field_of_view(np.radians(70.0), (160, 160), axis=(-1.0, 0.0, -0.25), right=(0.0, 1.0, 0.0))
    pose = rigid(Rotation.identity(), np.array([8.3, 6.4, 0.5]))
    rays = PixelRays.from_camera(camera)
    direct = renderer.render(scene.with_photometry(LAMBERT), rays, pose)
    frames = [renderer.render(replace(scene, among_objects=among), rays, pose).radiance for among in (False, True)]
    points = direct.points_world()
    shaded = (direct.body == -1) & (direct.radiance == 0.0)
    below = shaded & (np.abs(points[..., 0] - 6.4) < 0.6) & (np.abs(points[..., 1] - 6.4) < 0.3)
    assert below.sum() > 200
    open_sky, sheltered = (frame[below].astype(np.float64) for frame in frames)
    assert sheltered.mean() < 0.5 * open_sky.mean()
    # slopes of +-0.16: light from the side changes more with them
    assert sheltered.std() / sheltered.mean() > 2.0 * open_sky.std() / open_sky.mean()
