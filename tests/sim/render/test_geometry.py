"""Tests of the geometry of rendered images against analytic truth and an independent ray cast."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from benchmarks.validation.raycast import Ground
from marsyard.sim.camera import Cahvor
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Objects, Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_device, to_host, vectors_to_device
from marsyard.sim.render.backend import RenderingError
from marsyard.sim.render.device import Array3f64, Bool, Float64, Int32
from marsyard.sim.render.ground import Extent, first_crossing, skip_empty_blocks
from marsyard.sim.render.rays import Ray
from marsyard.sim.render.spline import Terrain
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.kernels import CEILING_BLOCK
from tests.sim.scenes import descent_camera, flat_ground

OVERHEAD = Sun(np.array([0.0, 0.0, 1.0]))
#: Lambert reflectance: under the overhead sun, the radiance factor of level ground equals its albedo.
ALBEDO_ONLY = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
#: Tilted by 25 deg and rolled.
ATTITUDE = Rotation.from_euler("zxy", [30.0, 20.0, 15.0], degrees=True)


@pytest.mark.slow
@pytest.mark.parametrize("height_m", [500.0, 2000.0])
def test_world_points_are_on_the_plane_and_on_rays(renderer: Renderer, height_m: float) -> None:
    camera, pose = descent_camera(r=(0.01, -0.25, 0.08)), rigid(ATTITUDE, np.array([100.0, 50.0, height_m]))
    scene = Scene(flat_ground(512, 1.5), (100.0, 50.0), OVERHEAD, ALBEDO_ONLY)
    frame = renderer.render(scene, PixelRays.from_camera(camera), pose)
    points = frame.points_world()
    assert np.isfinite(points).all()
    assert np.abs(points[..., 2] / frame.range_m).max() < 1e-5
    np.testing.assert_allclose(frame.points_world(np.s_[::100, ::100]), points[::100, ::100], rtol=0.0, atol=1e-9)
    pixels, visible = camera.transform(pose).project(points)
    assert visible.all()
    # Rays have single precision: 6e-8 rad is 1e-4 px.
    assert np.abs(pixels - camera.pixel_grid()).max() < 1e-3


def _cast_ray(surface: Surface, origin: np.ndarray, ray: np.ndarray, expected_m: float) -> float:
    """Find the distance t along a ray to the ground, m: march in steps of a fifth of a sample, then refine the root."""
    control = surface.levels[0][..., 0].astype(np.float64)

    def clearance(t: np.ndarray) -> np.ndarray:
        x, y, z = origin[:, None] + np.outer(ray, np.atleast_1d(t))
        ground = map_coordinates(
            control, [y / surface.spacing_m, x / surface.spacing_m], order=3, mode="grid-wrap", prefilter=False
        )
        return np.asarray(z - ground)

    t = np.arange(0.5 * expected_m, 1.5 * expected_m, 0.3)
    first_below = int(np.argmax(clearance(t) < 0.0))
    assert first_below > 0
    return float(brentq(lambda t: clearance(t).item(), t[first_below - 1], t[first_below], xtol=1e-9))


def test_rough_ground_ranges_match_independent_ray_cast(renderer: Renderer, terrain: Surface) -> None:
    rays = PixelRays.from_camera(descent_camera())
    pose = rigid(ATTITUDE, np.array([380.0, 200.0, 1500.0]))
    frame = renderer.render(Scene(terrain, (380.0, 200.0), OVERHEAD, ALBEDO_ONLY), rays, pose)
    rng = np.random.default_rng(8)
    pixels = rng.integers(0, frame.range_m.size, 300)
    directions = pose.rotation.apply(rays.directions[pixels].astype(np.float64))
    actual = frame.range_m.ravel()[pixels]
    expected = np.array(
        [_cast_ray(terrain, pose.translation, ray, range_m) for ray, range_m in zip(directions, actual, strict=True)]
    )
    assert np.mean(np.abs(actual / expected - 1.0) < 1e-6) >= 0.99
    assert np.abs(actual / expected - 1.0).max() < 1e-4


def _find_crossings(
    surface: Surface, origins: np.ndarray, rays: np.ndarray, start: np.ndarray, end: np.ndarray, *, use_ceilings: bool
) -> np.ndarray:
    """Search the finest level of the ground along rays between two distances (m)."""
    ray = Ray(vectors_to_device(Array3f64, origins), vectors_to_device(Array3f64, rays))
    start_m, end_m = (to_device(Float64, distance) for distance in (start, end))
    ground = Terrain.of_surface(surface, ceilings=use_ceilings)
    return to_host(first_crossing(ground, Int32(0), ray, start_m, end_m, Bool(True)))


@pytest.mark.parametrize("use_ceilings", [True, False], ids=["by ceilings", "by steps"])
def test_grazing_rays_intersect_the_first_occluding_crest(terrain: Surface, use_ceilings: bool) -> None:
    """Rays graze rough ground at distances of hundreds of samples. The reference marches in steps of 1/30 sample.

    Ceilings are upper bounds of the ground height in blocks of samples; blocks below a ray are skipped. Without
    ceilings a step can be longer than the remaining distance; the search must still stop at its end.
    """
    rng = np.random.default_rng(3)
    count, ground = 400, Ground(terrain)
    origins = np.column_stack([rng.uniform(0.0, terrain.period_m, (count, 2)), np.full(count, ground.highest + 60.0)])
    angles = rng.uniform([-np.pi, 2.5], [np.pi, 5.0], (count, 2))
    rays = np.array([direction(azimuth, -np.radians(elevation_deg)) for azimuth, elevation_deg in angles])
    expected = ground.cast(origins, rays, 4000.0, 0.05)
    # With ceilings the search of the complete ray is fast. Without them it starts near the intersection.
    begin = (0.0 if use_ceilings else 0.8) * expected
    result = _find_crossings(terrain, origins, rays, begin, 1.25 * expected, use_ceilings=use_ceilings)
    assert np.median(expected) > 500.0 * terrain.spacing_m
    assert np.mean(np.abs(result / expected - 1.0) < 1e-4) > 0.99
    # The search ends within a thousandth of a sample of the ground. One Newton step then squares the error.
    # The heights have the precision of the samples.
    assert np.abs(ground.clearance(origins, rays, result)).max() < 1e-5 * terrain.spacing_m
    begin = result - 4.0 * terrain.spacing_m
    beyond, before = (
        _find_crossings(terrain, origins, rays, begin, result + offset, use_ceilings=use_ceilings)
        for offset in (1e-3, -1e-3)
    )
    # a start behind a crest finds another intersection of the same ray
    assert np.mean(np.isclose(beyond, result, rtol=1e-6)) > 0.98
    assert np.mean(np.isinf(before)) > 0.98


def test_rays_enter_at_the_height_of_the_highest_ground_and_leave_at_the_extent() -> None:
    # Minimum and maximum x, then y, and maximum height.
    extent = Extent(*map(Float64, (-10.0, 10.0, -20.0, 20.0, 3.0)))

    def ray(origin: tuple[float, float, float], towards: tuple[float, float, float]) -> Ray:
        return Ray(Array3f64(*origin), Array3f64(*towards))

    def entry_distance(height_m: float, dz: float) -> float:
        return float(to_host(extent.entry_distance(ray((0.0, 0.0, height_m), (1.0, 0.0, dz))))[0])

    assert entry_distance(5.0, -0.1) == pytest.approx(20.0)
    assert entry_distance(3.0, -0.1) == 0.0
    assert entry_distance(1.0, 0.1) == 0.0
    assert entry_distance(5.0, 0.1) == np.inf
    assert entry_distance(5.0, 0.0) == np.inf
    exits = [((2.0, -1.0, 0.0), (0.5, -0.1, 0.0), 16.0), ((2.0, -1.0, 0.0), (0.0, -0.5, 0.0), 38.0)]
    exits += [((0.0, 0.0, 0.0), (-2.0, 0.0, 0.5), 5.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), np.inf)]
    for origin, towards, expected in exits:
        assert to_host(extent.exit_distance(ray(origin, towards)))[0] == pytest.approx(expected)


def test_mesh_resolution_does_not_change_the_image(renderer: Renderer, terrain: Surface) -> None:
    """The mesh only defines the start of the search: a mesh three times as coarse gives the same image."""
    rays = PixelRays.from_camera(descent_camera(256))
    pose = rigid(ATTITUDE, np.array([380.0, 200.0, 1500.0]))
    fine = renderer.render(Scene(terrain, (380.0, 200.0), OVERHEAD, ALBEDO_ONLY), rays, pose)
    coarse = renderer.render(Scene(terrain, (380.0, 200.0), OVERHEAD, ALBEDO_ONLY, mesh_finest_m=36.0), rays, pose)
    is_equal = np.abs(fine.range_m / coarse.range_m - 1.0) < 1e-6
    assert is_equal.mean() > 0.995


def test_sky_is_above_the_horizon(renderer: Renderer, terrain: Surface) -> None:
    level_pose = rigid(Rotation.from_euler("x", 90.0, degrees=True), np.array([0.0, 0.0, 500.0]))
    scene = Scene(terrain, (0.0, 0.0), OVERHEAD, ALBEDO_ONLY)
    frame = renderer.render(scene, PixelRays.from_camera(descent_camera(128)), level_pose)
    upper, lower = frame.range_m[:60], frame.range_m[-40:]
    assert np.isinf(upper).all()
    assert np.isfinite(lower).all()
    assert (frame.radiance[:60] == np.float32(ALBEDO_ONLY.sky_radiance)).all()
    assert np.isnan(frame.points_world()[:60]).all()


def test_objects_out_of_view_do_not_change_the_image(renderer: Renderer, terrain: Surface) -> None:
    """Without visible objects OpenGL draws no triangle, and the search must not read triangle numbers."""
    position = np.array([100.0, 200.0, 300.0])
    corners = position + np.array([[0.0, 0.0, 100.0], [1.0, 0.0, 100.0], [0.0, 1.0, 100.0]])
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    object_above = Objects.of_mesh(corners, np.tile([0.0, 0.0, 1.0], (3, 1)), faces, np.zeros(1, np.int32), albedo=0.1)
    sun = Sun(direction(0.3, np.radians(5.0)))
    rays, pose = PixelRays.from_camera(descent_camera(256)), rigid(ATTITUDE, position)
    scenes = (
        Scene(terrain, (100.0, 200.0), sun, ALBEDO_ONLY, objects, among_objects=True)
        for objects in (object_above, Objects.none())
    )
    with_object, without_objects = (renderer.render(scene, rays, pose) for scene in scenes)
    assert (with_object.body == -1).all()
    np.testing.assert_array_equal(with_object.range_m, without_objects.range_m)
    np.testing.assert_array_equal(with_object.radiance, without_objects.radiance)


def test_camera_below_ground_fails(renderer: Renderer, terrain: Surface) -> None:
    pose = rigid(Rotation.identity(), np.array([0.0, 0.0, -1000.0]))
    scene = Scene(terrain, (0.0, 0.0), OVERHEAD, ALBEDO_ONLY)
    with pytest.raises(RenderingError, match="below the ground"):
        renderer.render(scene, PixelRays.from_camera(descent_camera(64)), pose)


def test_image_does_not_depend_on_earlier_images(renderer: Renderer, terrain: Surface) -> None:
    rays = PixelRays.from_camera(descent_camera(256))
    sun = Sun(direction(np.radians(100.0), np.radians(40.0)))
    pose = rigid(ATTITUDE, np.array([380.0, 200.0, 1500.0]))
    first = renderer.render(Scene(terrain, (380.0, 200.0), sun, Photometry()), rays, pose)
    other_pose = rigid(ATTITUDE, np.array([0.0, 0.0, 900.0]))
    renderer.render(Scene(terrain, (0.0, 0.0), OVERHEAD, ALBEDO_ONLY), rays, other_pose)
    repetition = renderer.render(Scene(terrain, (380.0, 200.0), sun, Photometry()), rays, pose)
    assert first.radiance.tobytes() == repetition.radiance.tobytes()
    assert first.range_m.tobytes() == repetition.range_m.tobytes()


STRONG_DISTORTION = (0.01, -0.25, 0.08)


def _compute_centroid(radiance: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Compute the centroid (column, row) of brightness above the background within 8 pixels of a position."""
    u0, v0 = np.rint(position).astype(int)
    patch = radiance[v0 - 8 : v0 + 9, u0 - 8 : u0 + 9].astype(np.float64)
    border = np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])
    weight = np.clip(patch - np.median(border), 0.0, None)
    v, u = np.mgrid[v0 - 8 : v0 + 9, u0 - 8 : u0 + 9]
    return np.asarray(np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum())


def _compute_expected_centroid(camera: Cahvor, spot: np.ndarray) -> np.ndarray:
    """Compute the centroid of a spot's image: the mean pixel of its points, weighted by brightness and image area.

    Perspective shifts it by about 0.01 px from the pixel of the centre.
    """
    offset = np.linspace(-15.0, 15.0, 31)
    dx, dy = np.meshgrid(offset, offset)
    points = spot + np.stack([dx, dy, np.zeros_like(dx)], axis=-1)
    area = np.abs(np.linalg.det(camera.projection_jacobian(points)[..., :2]))
    # The B-spline adds a variance of 1/3 sample^2 to the spot of 2.5 samples; a sample is 1.5 m.
    variance = (2.5**2 + 1.0 / 3.0) * 1.5**2
    weight = area * np.exp(-(dx**2 + dy**2) / (2.0 * variance))
    pixels, _ = camera.project(points)
    return np.asarray((weight[..., None] * pixels).sum(axis=(0, 1)) / weight.sum())


def _make_spotted_plane(height_m: float) -> tuple[Surface, np.ndarray]:
    """Make a plane with bright spots; return the surface and the spot positions in world axes, m, shape (n, 3).

    A spot is a Gaussian of 2.5 samples in the control values. The symmetric B-spline preserves its centre.
    """
    side, spacing = 512, 1.5
    rng = np.random.default_rng(4)
    grid = (np.arange(13) + 0.5) * side / 13
    x, y = (centre + rng.uniform(-5, 5, (13, 13)) for centre in np.meshgrid(grid, grid))
    samples = np.zeros((side, side, 2), dtype=np.float32)
    samples[..., 0] = height_m
    samples[..., 1] = 0.05
    rows, columns = np.mgrid[:side, :side]
    for spot_x, spot_y in zip(x.ravel(), y.ravel(), strict=True):
        samples[..., 1] += 0.4 * np.exp(-((columns - spot_x) ** 2 + (rows - spot_y) ** 2) / (2 * 2.5**2))
    spots = np.stack([x.ravel() * spacing, y.ravel() * spacing, np.full(x.size, height_m)], axis=-1)
    return Surface.from_samples(samples, spacing), spots


def test_blocks_below_a_ray_are_skipped(terrain: Surface) -> None:
    """Rays skip to the first block whose ceiling is above the ray, in all directions and across the period."""
    ceiling = terrain.ceilings[0]
    device_terrain = Terrain.of_surface(terrain, ceilings=True)
    block = CEILING_BLOCK * terrain.spacing_m
    rng = np.random.default_rng(5)
    for azimuth in [*rng.uniform(-np.pi, np.pi, 60), 0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi]:
        origin = np.array([*rng.uniform(0.0, terrain.period_m, 2), float(ceiling.max()) + 5.0])
        ray = direction(azimuth, -np.radians(rng.uniform(1.0, 20.0)))
        start = rng.uniform(0.0, 50.0)
        device_ray = Ray(Array3f64(*origin.tolist()), Array3f64(*ray.tolist()))
        limits = Float64(start), Float64(5000.0)
        skip_end_m = to_host(skip_empty_blocks(device_terrain, Int32(0), device_ray, *limits, Bool(True)))[0]
        distances_m = np.arange(start, skip_end_m + 3.0 * block, 0.01 * block)
        positions = origin + distances_m[:, None] * ray
        block_row, block_column = (np.floor(positions[:, axis] / block).astype(int) % len(ceiling) for axis in (1, 0))
        is_below_ceiling = positions[:, 2] <= ceiling[block_row, block_column]
        assert not is_below_ceiling[distances_m < skip_end_m - 1e-6].any()
        assert is_below_ceiling[(distances_m > skip_end_m) & (distances_m < skip_end_m + 2.0 * block)].any()


@pytest.mark.slow
def test_spots_on_a_plane_are_at_projected_pixels(renderer: Renderer) -> None:
    """Requirement: 0.05 px rms through a strongly distorted CAHVOR camera, tilted and rolled."""
    surface, spots = _make_spotted_plane(height_m=7.0)
    camera = descent_camera(r=STRONG_DISTORTION)
    pose = rigid(ATTITUDE, np.array([300.0, 700.0, 1207.0]))
    scene = Scene(surface, (300.0, 400.0), OVERHEAD, ALBEDO_ONLY)
    frame = renderer.render(scene, PixelRays.from_camera(camera), pose)
    copies = np.arange(-2, 3) * surface.period_m
    all_spots = np.concatenate([spots + np.array([dx, dy, 0.0]) for dx in copies for dy in copies])
    pixels, visible = camera.transform(pose).project(all_spots)
    is_in_image = visible & (np.abs(pixels - 511.5) < 495.0).all(axis=-1)
    result = np.stack([_compute_centroid(frame.radiance, position) for position in pixels[is_in_image]])
    expected = np.stack([_compute_expected_centroid(camera.transform(pose), spot) for spot in all_spots[is_in_image]])
    error = result - expected
    assert is_in_image.sum() > 400
    assert np.sqrt(np.mean(np.sum(error**2, axis=-1))) < 0.05
    assert np.sqrt(np.mean(np.sum((result - pixels[is_in_image]) ** 2, axis=-1))) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.003
    # The distortion is significant: a pinhole camera would shift the spots by pixels.
    pinhole, _ = descent_camera(r=(0.0, 0.0, 0.0)).transform(pose).project(all_spots[is_in_image])
    assert np.linalg.norm(pinhole - pixels[is_in_image], axis=-1).max() > 20.0
