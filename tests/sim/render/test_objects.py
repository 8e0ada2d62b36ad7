"""Tests of `Objects` (triangle meshes of several bodies), of the ground mesh, and of shadow footprints."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from marsyard.scenarios.views import SiteGround, Viewpoint, mast_pose, nadir_pose, site_scene
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Objects, PixelRays, Renderer, Scene, Sun, process_renderer
from marsyard.sim.render.arrays import to_device, to_host
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.device import Float64
from marsyard.sim.render.mesh import cell_spans_in_hull, graded_offsets, ground_mesh
from marsyard.sim.render.pinhole import depth_in_metres
from marsyard.sim.render.shadows import Footprint
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import RockParameters, Surface, TerrainParameters, site
from tests.sim.scenes import LAMBERT, make_ground, mesh_body

#: Number of triangles of each body.
COUNTS = (5, 1, 80, 3)


def _make_bodies() -> Objects:
    rng = np.random.default_rng(4)
    body_ids = np.repeat(np.array([7, 3, 12, 3], dtype=np.int32), COUNTS)
    faces = np.arange(3 * body_ids.size, dtype=np.int32).reshape(-1, 3)
    positions = np.repeat(50.0 * rng.normal(size=(4, 3)), 3 * np.array(COUNTS), axis=0)
    vertices = positions + rng.normal(0.0, 1.0, (3 * body_ids.size, 3))
    return Objects.of_mesh(vertices, rng.normal(size=vertices.shape), faces, body_ids, albedo=0.2)


def test_spheres_enclose_their_bodies_tightly() -> None:
    objects = _make_bodies()
    for body, sphere in enumerate(objects.spheres):
        corners = objects.triangles[objects.body_of_triangle == body].reshape(-1, 3)
        np.testing.assert_array_equal(sphere[:3], 0.5 * (corners.min(axis=0) + corners.max(axis=0)))
        assert np.linalg.norm(corners - sphere[:3], axis=1).max() == np.float64(sphere[3])
    assert Objects.none().spheres.shape == (0, 4)


def test_subset_contains_the_selected_bodies() -> None:
    objects = _make_bodies()
    is_selected = np.array([True, False, False, True])
    subset = objects.select(is_selected)
    is_expected = is_selected[objects.body_of_triangle]
    np.testing.assert_array_equal(subset.triangles, objects.triangles[is_expected])
    np.testing.assert_array_equal(subset.normals, objects.normals[is_expected])
    assert subset.first_triangle.tolist() == [0, 5, 8]
    assert subset.names.tolist() == [7, 3]
    np.testing.assert_array_equal(subset.spheres, objects.spheres[is_selected])
    assert len(objects.select(np.zeros(4, dtype=bool))) == 0


@pytest.mark.parametrize("radius_m", [0.0, 3.0])
def test_cone_selects_triangles_that_face_a_point_near_its_apex(radius_m: float) -> None:
    """A triangle faces a point if its corners appear counter-clockwise from there."""
    objects = _make_bodies()
    eye = objects.spheres[2, :3] + np.array([0.0, 0.0, 20.0])
    first, second, third = objects.triangles.transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # the point of the sphere around the apex that is most in front of a triangle
    is_facing = np.einsum("ij,ij->i", normals, eye + radius_m * normals - first) > 0.0
    is_candidate = objects.body_of_triangle == 2
    result = objects.in_cone(eye, np.array([0.0, 0.0, -1.0]), 1e-2, radius_m)
    np.testing.assert_array_equal(result[is_candidate[result]], np.flatnonzero(is_facing & is_candidate))
    assert is_facing[result].all()
    assert 20 < np.count_nonzero(is_facing & is_candidate) < 80
    # bodies that are tens of metres from the axis are not in the cone
    assert not np.isin(objects.body_of_triangle[result], (0, 1)).all()


@given(finest=st.floats(0.5, 20.0), stretch=st.floats(1.01, 1000.0), count=st.integers(8, 200).map(lambda n: 2 * n + 1))
def test_offsets_have_the_given_extent_and_spacing(finest: float, stretch: float, count: int) -> None:
    half_width = stretch * finest * (count - 1) / 2
    # Grid lines relative to the viewpoint, m: dense near it, and sparser with distance.
    offsets = graded_offsets(half_width, finest, count)
    gaps = np.diff(offsets)
    assert offsets[-1] == pytest.approx(half_width, rel=1e-6)
    np.testing.assert_allclose(offsets, -offsets[::-1], atol=1e-9 * half_width)
    assert gaps.min() == pytest.approx(finest, rel=1e-6)
    assert (np.diff(gaps[count // 2 :]) > -1e-9 * half_width).all()


def test_too_many_grid_lines_are_rejected() -> None:
    with pytest.raises(ValueError, match="exceed"):
        graded_offsets(100.0, 10.0, 101)


def test_mesh_has_no_cracks_and_upward_normals_and_follows_the_ground(terrain: Surface) -> None:
    offsets = graded_offsets(2000.0, 6.0, 65)
    mesh = trimesh.Trimesh(*ground_mesh(terrain, 120.0 + offsets, -40.0 + offsets), process=False)
    assert len(mesh.faces) == 2 * 64 * 64
    assert (mesh.face_normals[:, 2] > 0.0).all()
    # A mesh of n x n cells with diagonals has 3 n^2 + 2 n different edges; a crack would add edges.
    assert len(mesh.edges_unique) == 3 * 64 * 64 + 2 * 64
    is_inner = np.abs(mesh.vertices[:, :2] - [120.0, -40.0]).max(axis=1) < 50.0
    x, y, z = mesh.vertices[is_inner].T
    np.testing.assert_allclose(z, terrain.height(x, y, level=2), atol=1e-9)


@given(st.lists(st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0)), min_size=3, max_size=9), st.integers(0, 9))
def test_cell_spans_cover_the_hull(corners: list[tuple[float, float]], seed: int) -> None:
    """Random hulls can extend beyond the grid or lie between two grid lines."""
    positions = np.array(corners) + np.array([[0.0, 0.0], [0.3, 0.1], [0.1, 0.4], *[[0.0, 0.0]] * (len(corners) - 3)])
    assume(np.linalg.matrix_rank(positions - positions[0], tol=1e-3) == 2)
    lines = graded_offsets(20.0, 0.2, 61)
    spans = cell_spans_in_hull(lines, lines, positions)
    weights = np.random.default_rng(seed).dirichlet(np.ones(len(positions)), 500)
    positions_in_hull = weights @ positions
    positions_in_hull = positions_in_hull[np.abs(positions_in_hull).max(axis=1) < 20.0]
    column, row = (np.searchsorted(lines, positions_in_hull) - 1).T
    assert np.all((spans[row, 0] <= column) & (column < spans[row, 1]))
    # Each selected cell overlaps the bounding box of the positions.
    low, high = positions.min(axis=0), positions.max(axis=0)
    for row_index in np.flatnonzero(spans[:, 1] > spans[:, 0]):
        assert lines[row_index] <= high[1]
        assert lines[row_index + 1] >= low[1]
        assert lines[spans[row_index, 0]] <= high[0]
        assert lines[spans[row_index, 1]] >= low[0]


def test_partial_mesh_equals_the_cells_of_the_full_mesh(terrain: Surface) -> None:
    """The spans include empty rows, adjacent rows with disjoint and with common columns, and an isolated row."""
    lines = graded_offsets(300.0, 5.0, 17)
    spans = np.zeros((16, 2), dtype=int)
    spans[3:6] = [[2, 5], [7, 9], [0, 16]]
    spans[15] = [15, 16]
    subset, full = (
        trimesh.Trimesh(*ground_mesh(terrain, lines, lines, cells), process=False) for cells in (spans, None)
    )
    expected = [row * 16 + column for row, (first, end) in enumerate(spans) for column in range(first, end)]
    triangles_of_cells = full.triangles.reshape(256, 2, 3, 3)
    np.testing.assert_array_equal(subset.triangles.reshape(-1, 2, 3, 3), triangles_of_cells[expected])


ROCKY = TerrainParameters(samples=512, spacing_m=3.0, rocks=RockParameters(abundance=0.15, smallest_m=1.0))


def _is_inside(footprint: Footprint | None, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether the footprint contains positions (m)."""
    return to_host(footprint.contains(to_device(Float64, x), to_device(Float64, y)))


@pytest.mark.parametrize("elevation", [0.2, 0.7, 1.5])
def test_footprint_contains_every_shaded_position(elevation: float) -> None:
    """The footprint contains all ground points whose ray to the sun intersects a sphere, and few other points."""
    rng = np.random.default_rng(0)
    spheres = np.column_stack(
        [rng.uniform(-900.0, 900.0, (40, 2)), rng.uniform(-30.0, 30.0, 40), rng.uniform(0.5, 3.0, 40)]
    )
    sun = direction(rng.uniform(0.0, 6.0), elevation)
    footprint = Footprint.of(spheres, sun, -40.0)
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
    assert Footprint.of(np.empty((0, 4)), direction(0.0, 1.0), 0.0) is None
    assert Footprint.of(sphere, direction(0.0, -0.1), 0.0) is None


def test_culling_does_not_change_images() -> None:
    """A mast subframe among rocks is equal with and without culling, for two sun elevations and azimuths.

    A ray that meets the common edge of two triangles can hit either: the surface of its rock differs by rounding there.
    """
    terrain = ROCKY.model_copy(update={"spacing_m": 0.05, "rms_slope_deg": 5.0, "slope_baseline_m": 1.0})
    terrain = terrain.model_copy(update={"outer_scale_m": 10.0, "craters_per_km2": 0.0})
    rocks = RockParameters(abundance=0.1, smallest_m=0.05)
    ground = SiteGround.from_site(
        site("gusev").model_copy(update={"descent": terrain.model_copy(update={"rocks": rocks})})
    )
    rays = PixelRays.from_camera(preset("research-navcam").cameras()[0].crop(420, 400, (121, 121)))
    pose = mast_pose(ground.surface, 12.0, 11.0, 1.5, 30.0, -14.0)
    for azimuth, elevation in ((0.5, 1.0), (3.0, 0.25)):
        viewpoint = Viewpoint(12.0, 11.0, 1.5, rays.pixel_rad, azimuth_rad=0.5, half_width_rad=1.2, max_distance_m=25.0)
        scene = site_scene(ground, viewpoint, Sun(direction(azimuth, elevation)))
        visible_scene = scene.restrict_to_cones([rays.cone(pose)])
        assert 0 < len(visible_scene.objects) < 0.5 * len(scene.objects)
        renderer = process_renderer(default_backend())
        full, subset = renderer.render(scene, rays, pose), renderer.render(visible_scene, rays, pose)
        assert np.mean(subset.radiance != full.radiance) < 1e-3
        np.testing.assert_allclose(subset.radiance, full.radiance, rtol=1e-5)
        np.testing.assert_array_equal(subset.range_m, full.range_m)
        # Culling keeps the spheres of the remaining objects.
        new_objects = Objects(**{name: getattr(visible_scene.objects, name) for name in Objects.__dataclass_fields__})
        np.testing.assert_array_equal(visible_scene.objects.spheres, new_objects.spheres)


def test_no_part_of_a_body_below_the_ground_is_visible(renderer: Renderer) -> None:
    """The mesh of the ground is too coarse for the ripples in front of a buried sphere."""
    ripples = 0.03 * np.sin(2.0 * np.pi * np.arange(256) * 0.05 / 0.4)
    surface = make_ground(np.broadcast_to(ripples, (256, 256)), 0.05)
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.6)
    sphere.apply_translation([6.4, 6.4, -0.35])
    sun, body = Sun(direction(0.5, 0.8)), mesh_body(sphere)
    scene = Scene(surface, (6.4, 6.4), sun, LAMBERT, body, mesh_finest_m=0.3, mesh_half_width_m=100.0)
    camera = Cahv.from_field_of_view(np.radians(25.0), (256, 256), axis=(1.0, 0.0, -0.35), right=(0.0, -1.0, 0.0))
    frame = renderer.render(scene, PixelRays.from_camera(camera), rigid(Rotation.identity(), np.array([3.0, 6.4, 1.2])))
    x, y, z = frame.points_world()[frame.body >= 0].T
    assert len(x) > 2000
    assert np.min(z - surface.height(x, y)) > -1e-4


def test_perspective_depths_convert_to_metres() -> None:
    """OpenGL stores `f (z - n) / (z (f - n))` for a depth z between n and f, lowest row first; 1 is empty."""
    near, far = 3.0, 900.0
    depths_m = np.geomspace(4.0, 60.0, 15).reshape(5, 3)
    opengl_depths = far * (depths_m - near) / (depths_m * (far - near))
    opengl_depths[1, 2] = 1.0
    result = depth_in_metres(opengl_depths[::-1].astype(np.float32), near, far)
    assert result[1, 2] == 0.0
    depths_m[1, 2] = 0.0
    # In single precision the rounding of 1 - n / z causes a relative error of 6e-8 z / n in z.
    np.testing.assert_allclose(result, depths_m, rtol=3e-6)


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
    full_scene.__dict__["footprint"] = None
    full_frame = process_renderer(default_backend()).render(full_scene, rays, pose)
    np.testing.assert_array_equal(frame.radiance, full_frame.radiance)
    assert not to_host(scene.footprint.cells).all()
