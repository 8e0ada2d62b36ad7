"""Tests of the ground mesh: extent, absence of cracks, and partial meshes."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from marsyard.sim.render.renderer import cell_spans_in_hull, ground_mesh
from marsyard.sim.render.scene import graded_offsets
from marsyard.sim.terrain import Surface


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
    mesh = ground_mesh(terrain, 120.0 + offsets, -40.0 + offsets)
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
    subset, full = ground_mesh(terrain, lines, lines, spans), ground_mesh(terrain, lines, lines)
    expected = [row * 16 + column for row, (first, end) in enumerate(spans) for column in range(first, end)]
    triangles_of_cells = full.triangles.reshape(256, 2, 3, 3)
    np.testing.assert_array_equal(subset.triangles.reshape(-1, 2, 3, 3), triangles_of_cells[expected])
