"""Tests of rock shapes, size distribution, placement and level of detail."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from pydantic import ValidationError
from scipy.integrate import quad
from scipy.spatial import cKDTree

from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, Surface
from marsyard.sim.terrain.rocks import shapes
from marsyard.sim.terrain.rocks.field import decay_per_m, draw_diameters
from marsyard.sim.terrain.rocks.kernels import place_discs
from marsyard.sim.terrain.rocks.shapes import (
    COARSE,
    COARSEST,
    FINE,
    FINEST,
    MEDIUM,
    SHAPES,
    SHAPES_OF_FORM,
    UNIT_HEIGHT,
    ShapeSet,
    _all_shapes,
    max_pixels,
    rock_shapes,
)
from tests.sim.scenes import make_ground

TARGET = PlacedRock(name="target", east_m=3.0, north_m=60.0, diameter_m=1.5, shape=4, yaw_deg=30.0)


@pytest.fixture(scope="module")
def ground() -> Surface:
    """Return ground of 64 m with waves and slopes up to 20 deg."""
    side, spacing = 256, 0.25
    phase = 2 * np.pi * np.arange(side) / side
    return make_ground(np.sin(3 * phase)[None, :] * 0.9 + np.cos(2 * phase)[:, None] * 0.8, spacing)


def make_field(ground: Surface, seed: int = 1, **changes: object) -> RockField:
    values = {"abundance": 0.2, "smallest_m": 0.1, "placed": (TARGET,), **changes}
    parameters = RockParameters.model_validate(values)
    return RockField.draw(ground, parameters, np.random.default_rng(seed))


def make_mesh(shapes: ShapeSet, number: int) -> trimesh.Trimesh:
    return trimesh.Trimesh(shapes.vertices[number], shapes.faces, process=False, validate=False)


@pytest.fixture(scope="module")
def field(ground: Surface) -> RockField:
    return make_field(ground)


@pytest.mark.parametrize(
    ("detail", "triangles"), [(COARSEST, 20), (COARSE, 80), (MEDIUM, 320), (FINE, 1280), (FINEST, 5120)]
)
def test_shapes_are_closed_and_of_unit_size(detail: int, triangles: int) -> None:
    shapes = rock_shapes(detail)
    for number in range(SHAPES):
        mesh = make_mesh(shapes, number)
        assert len(mesh.faces) == triangles
        assert mesh.is_watertight
        assert mesh.volume > 0.0
        assert mesh.bounds[0, 2] < -0.02, "the lower part is buried"
        above_ground = shapes.vertices[number][shapes.vertices[number, :, 2] >= 0.0]
        assert np.hypot(*above_ground[:, :2].T).max() <= shapes.max_radius[number] + 1e-12
    np.testing.assert_allclose(np.linalg.norm(shapes.normals, axis=2), 1.0, atol=1e-12)


def test_overhangs_are_buried() -> None:
    """Faces that look down are 5 % of the visible area in the mean; without the fill of overhangs they are 20 %."""
    shapes = rock_shapes(FINEST)
    fractions = []
    for number in range(SHAPES):
        mesh = make_mesh(shapes, number)
        is_visible, looks_down = mesh.triangles[..., 2].mean(axis=1) > 0.0, mesh.face_normals[:, 2] < -0.1
        fractions.append(mesh.area_faces[is_visible & looks_down].sum() / mesh.area_faces[is_visible].sum())
    assert np.mean(fractions) < 0.05


def test_finest_shapes_have_specified_height_diameter_and_normals() -> None:
    shapes = rock_shapes(FINEST)
    azimuth = np.radians(np.arange(0, 180, 5))
    for number in range(SHAPES):
        vertices = shapes.vertices[number]
        assert vertices[:, 2].max() == pytest.approx(UNIT_HEIGHT)
        above_ground = vertices[vertices[:, 2] >= 0.0, :2]
        widths = np.ptp(above_ground @ np.stack([np.cos(azimuth), np.sin(azimuth)]), axis=0)
        assert (widths.max() + widths.min()) / 2 == pytest.approx(1.0, abs=0.005 if number < SHAPES_OF_FORM else 0.01)
        # The stored normals agree with means of triangle normals, except at the edges of the rock.
        agreement = np.sum(make_mesh(shapes, number).vertex_normals * shapes.normals[number], axis=1)
        assert np.median(agreement) > (0.999 if number < SHAPES_OF_FORM else 0.96)


def _compute_rocks_per_m2(abundance: float, smallest_m: float, largest_m: float) -> float:
    """Compute the number of rocks between two diameters by integration over the diameter d.

    Rocks of at least the diameter d cover the fraction abundance exp(-q d) of the ground. Its density divided by the
    area of a rock is the number density.
    """
    q = decay_per_m(abundance)
    return float(quad(lambda d: abundance * q * np.exp(-q * d) / (0.25 * np.pi * d * d), smallest_m, largest_m)[0])


@pytest.mark.parametrize("abundance", [0.02, 0.1, 0.4])
def test_rock_sizes_follow_golombek(abundance: float) -> None:
    """The area of rocks above each diameter matches the model within 10 % or three standard deviations."""
    parameters = RockParameters(abundance=abundance, smallest_m=0.05, largest_m=10.0)
    area = 1.5e4 if abundance > 0.02 else 1.0e5
    diameters = draw_diameters(parameters, area, np.random.default_rng(3))
    for min_diameter in (0.05, 0.1, 0.2, 0.4):
        large_diameters = diameters[diameters >= min_diameter]
        fraction = np.sum(np.pi / 4 * large_diameters**2) / area
        # Standard deviation of a compound Poisson sum.
        sigma = np.sqrt(np.sum((np.pi / 4 * large_diameters**2) ** 2)) / area
        expected = abundance * np.exp(-decay_per_m(abundance) * min_diameter)
        assert fraction == pytest.approx(expected, abs=max(0.1 * expected, 3 * sigma))
        if min_diameter < 0.2:
            assert 3 * sigma < 0.1 * expected, "enough rocks for a tolerance of 10 %"
        number = area * _compute_rocks_per_m2(abundance, min_diameter, 10.0)
        assert large_diameters.size == pytest.approx(number, abs=max(0.02 * number, 4 * np.sqrt(number)))


def test_no_two_rocks_overlap(field: RockField) -> None:
    """Rocks do not overlap in plan view; neighbours across the periodic border are included."""
    radius_m = rock_shapes(COARSE).max_radius[field.shape] * field.diameter_m
    tree = cKDTree(field.position_m[:, :2], boxsize=np.full(2, field.period_m))
    pairs = tree.query_pairs(2 * radius_m.max(), output_type="ndarray")
    offsets_m = np.abs(field.position_m[pairs[:, 0], :2] - field.position_m[pairs[:, 1], :2])
    offsets_m = np.minimum(offsets_m, field.period_m - offsets_m)
    assert len(pairs) > 1000
    assert np.all(np.hypot(*offsets_m.T) >= radius_m[pairs].sum(axis=1))


def test_fragments_lie_next_to_larger_rocks(ground: Surface) -> None:
    near_larger = []
    for fragments in (0.0, 0.5):
        field = make_field(ground, abundance=0.05, smallest_m=0.05, fragments=fragments, placed=())
        is_larger, is_small = field.diameter_m > 0.3, field.diameter_m < 0.1
        larger = cKDTree(field.position_m[is_larger, :2], boxsize=np.full(2, field.period_m))
        distance, nearest = larger.query(field.position_m[is_small, :2])
        near_larger.append(np.mean(distance < field.diameter_m[is_larger][nearest]))
    assert near_larger[1] > 2.0 * near_larger[0]


def test_fragments_without_a_place_next_to_larger_rocks_lie_elsewhere() -> None:
    radii = np.array([1.0] + [0.3] * 300)
    positions = place_discs(
        radii, np.empty((0, 3)), np.ones((1, 1), dtype=np.float32), 30.0, 1.0, 2000, 1.0, np.random.default_rng(1)
    )
    assert np.isfinite(positions).all()


def test_rocks_of_max_abundance_cover_the_specified_fraction(ground: Surface) -> None:
    field = make_field(ground, abundance=0.4, smallest_m=0.06, placed=())
    covered_fraction = np.sum(np.pi / 4 * field.diameter_m**2) / field.period_m**2
    assert covered_fraction == pytest.approx(0.4 * np.exp(-0.06 * decay_per_m(0.4)), rel=0.1)


def test_equal_seeds_produce_equal_rocks(ground: Surface, field: RockField) -> None:
    same_seed, other_seed = make_field(ground), make_field(ground, seed=2)
    for name in ("shape", "position_m", "diameter_m", "height_m", "yaw_rad", "up"):
        assert getattr(field, name).tobytes() == getattr(same_seed, name).tobytes()
    assert len(other_seed) != len(field) or not np.array_equal(other_seed.position_m, field.position_m)


def test_rocks_stand_on_the_ground_along_its_normal(ground: Surface, field: RockField) -> None:
    x, y, z = field.position_m.T
    np.testing.assert_allclose(z, ground.height(x, y), atol=1e-12)
    is_small = field.diameter_m < 0.4
    normal = np.column_stack([-ground.gradient(x, y)[is_small], np.ones(is_small.sum())])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(field.up[is_small], normal, atol=1e-9)
    assert np.all(
        (field.height_m[1:] / field.diameter_m[1:] >= 0.35) & (field.height_m[1:] / field.diameter_m[1:] <= 0.65)
    )


def test_placed_rock_has_its_name_and_position(ground: Surface, field: RockField) -> None:
    number = field.by_name("target")
    assert field.diameter_m[number] == 1.5
    np.testing.assert_allclose(field.position_m[number, :2], [3.0, 60.0])
    mesh = field.rock(number)
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert body.is_watertight
    assert body.volume > 0.0, "faces point outwards"
    # Along the local vertical its height is half its diameter.
    heights_m = (mesh.vertices - field.position_m[number]) @ field.up[number]
    assert heights_m.max() == pytest.approx(0.75)
    assert heights_m.min() < -0.1
    with pytest.raises(KeyError, match="named rocks: target"):
        field.by_name("adirondack")


def test_near_returns_rocks_around_a_position_in_any_period(field: RockField) -> None:
    mesh = field.near(2.0, 1.0, 9.0, detail=COARSE)
    assert set(np.unique(mesh.rock_of_face)) == {
        n
        for n, (x, y) in enumerate(field.position_m[:, :2])
        if np.hypot((x - 2 + 32) % 64 - 32, (y - 1 + 32) % 64 - 32) <= 9.0
    }
    shifted_mesh = field.near(2.0 - 64.0, 1.0 + 128.0, 9.0, detail=COARSE)
    np.testing.assert_array_equal(shifted_mesh.rock_of_face, mesh.rock_of_face)
    np.testing.assert_allclose(shifted_mesh.vertices - [-64.0, 128.0, 0.0], mesh.vertices, atol=1e-9)
    assert mesh.faces.max() == len(mesh.vertices) - 1
    assert len(mesh.rock_of_face) == len(mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1.0, atol=1e-12)


def test_clinker_has_rougher_shapes_than_blocks(ground: Surface) -> None:
    """The roughness is the angle between neighbouring triangles. The faces of a block are flat."""
    shapes = rock_shapes(FINEST)
    meshes = [trimesh.Trimesh(vertices, shapes.faces, process=False) for vertices in shapes.vertices]
    median_angles = [float(np.median(mesh.face_adjacency_angles)) for mesh in meshes]
    clinker = slice(SHAPES_OF_FORM, 2 * SHAPES_OF_FORM)
    assert max(median_angles[:SHAPES_OF_FORM]) < 0.07 < 0.18 < min(median_angles[clinker])
    field = make_field(ground, form="clinker", placed=())
    assert set(np.unique(field.shape)) == set(range(SHAPES_OF_FORM, 2 * SHAPES_OF_FORM))
    assert set(np.unique(make_field(ground, placed=()).shape)) == set(range(SHAPES_OF_FORM))


def test_small_terrain_repeats_in_the_view(field: RockField) -> None:
    """Each copy of a rock is a separate body with the number of the rock."""
    mesh = field.near(10.0, 10.0, 100.0, smallest_m=1.4, detail=COARSE)
    rocks, triangles = np.unique(mesh.rock_of_face, return_counts=True)
    assert triangles.max() > 80 * 4
    bodies, first, triangles = np.unique(mesh.body_of_face, return_index=True, return_counts=True)
    assert len(bodies) > 2 * len(rocks)
    assert np.all(triangles == 80)
    for body, start in zip(bodies, first, strict=True):
        faces = mesh.faces[mesh.body_of_face == body]
        number = int(mesh.rock_of_face[start])
        offset = mesh.vertices[faces].mean(axis=(0, 1))[:2] - field.position_m[number, :2]
        np.testing.assert_allclose(offset - 64.0 * np.round(offset / 64.0), 0.0, atol=0.3 * field.diameter_m[number])
        assert np.all(mesh.rock_of_face[mesh.body_of_face == body] == number)


@pytest.mark.parametrize(
    ("invalid", "message"),
    [
        ({"abundance": 0.5}, "less than or equal to 0.4"),
        ({"smallest_m": 4.0}, "must be larger than smallest_m"),
        ({"placed": (TARGET, TARGET)}, "names must be unique"),
    ],
)
def test_invalid_rocks_are_rejected(invalid: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        RockParameters.model_validate(invalid)


def test_too_many_rocks_and_unknown_shapes_are_rejected(ground: Surface) -> None:
    with pytest.raises(ValueError, match=r"choose a larger rocks\.smallest_m"):
        draw_diameters(RockParameters(abundance=0.4, smallest_m=0.01), 1.0e6, np.random.default_rng(0))
    unknown = PlacedRock(name="strange", east_m=0.0, north_m=0.0, diameter_m=1.0, shape=99)
    with pytest.raises(ValueError, match="'strange' has shape 99"):
        make_field(ground, placed=(unknown,))


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 9, 15, 16, 27, 32, 47, 50, 63, 70])
@pytest.mark.parametrize("detail", [COARSEST, COARSE, MEDIUM, FINE])
def test_coarse_rock_deviates_from_the_finest_by_a_quarter_pixel(number: int, detail: int) -> None:
    """At the largest apparent diameter for which a level of detail is used, it deviates by about 0.25 px (requirement).

    The deviation is the RMS distance from points above the ground to the plane of the nearest coarse triangle.
    """
    coarse = make_mesh(rock_shapes(detail), number)
    samples, triangles = trimesh.sample.sample_surface(coarse, 200_000, seed=1)
    finest = trimesh.sample.sample_surface(make_mesh(rock_shapes(FINEST), number), 4_000, seed=2)[0]
    finest = finest[finest[:, 2] > 0.0]
    nearest = cKDTree(samples).query(finest)[1]
    distances = np.sum((finest - samples[nearest]) * coarse.face_normals[triangles[nearest]], axis=1)
    assert 0.15 < np.sqrt(np.mean(distances**2)) * max_pixels()[number, detail] < 0.3


def test_rock_detail_follows_camera_resolution(field: RockField) -> None:
    faces = [rock_shapes(detail).faces.shape[0] for detail in (COARSEST, COARSE, MEDIUM, FINE, FINEST)]
    for pixel_rad in (3e-4, 1e-3, 1e-2):
        mesh = field.near(32.0, 32.0, 25.0, smallest_m=0.3, above_m=1.5, pixel_rad=pixel_rad)
        for rock, count in zip(*np.unique(mesh.rock_of_face, return_counts=True), strict=True):
            detail = faces.index(int(count))
            distance = np.hypot(np.hypot(*(field.position_m[rock, :2] - 32.0)), 1.5)
            diameter_px = field.diameter_m[rock] / (distance - 0.5 * field.diameter_m[rock]) / pixel_rad
            thresholds = np.concatenate([[0.0], max_pixels()[field.shape[rock]], [np.inf]])
            assert thresholds[detail] < diameter_px <= thresholds[detail + 1]
        assert field.diameter_m[mesh.rock_of_face].min() >= 0.3
    empty_mesh = field.near(3.0, 58.0, 20.0, smallest_m=90.0)
    assert empty_mesh.faces.shape == empty_mesh.vertices.shape == (0, 3)


def _edge_radii(number: int) -> Float64[np.ndarray, "n"]:
    """Radii of curvature along a circle around a shape's vertical at 45 deg, in radii of the rock."""
    shape = _all_shapes()[number]
    azimuth = np.radians(np.arange(0.0, 360.0, 0.1))
    directions = np.sqrt(0.5) * np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(azimuth.size)], axis=1)
    points = shape.to_unit_shape(directions * shape.radius(directions)[:, None])
    normals = shape.normals(directions)
    turns = np.arccos(np.clip(np.sum(normals[1:] * normals[:-1], axis=1), -1.0, 1.0))
    return np.asarray(np.linalg.norm(np.diff(points, axis=0), axis=1) / np.maximum(turns, 1e-9) / 0.5)


def test_abrasion_rounds_the_edges_of_rocks_by_different_radii() -> None:
    # vesicles and the ridges of clinker have edges. A circle crosses all but the shortest edges of a shape
    blocks, ventifacts = ([_edge_radii(first + k).min() for k in range(16)] for first in (0, 64))
    assert min(blocks) > 0.02
    assert max(blocks) > 8.0 * min(blocks)
    assert np.median(ventifacts) > 0.03


@pytest.mark.slow
def test_stored_shapes_equal_the_built_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    cache_clears = [
        function.cache_clear for function in (rock_shapes, max_pixels, shapes._vertices, shapes._compute_max_radius)
    ]
    results = []
    for _ in range(2):
        for clear_cache in cache_clears:
            clear_cache()
        coarse = rock_shapes(COARSE)
        results.append([coarse.vertices, coarse.normals, coarse.max_radius, max_pixels()])
        files = sorted((tmp_path / "terrain").glob("rocks-*.npy"))
    # The files contain vertices of five levels, normals of two levels, and the sizes in pixels.
    assert len(files) == 8
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)
    assert not any(array.flags.writeable for array in results[1][:2])
