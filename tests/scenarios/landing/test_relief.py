"""Tests of the true slope and roughness of the ground under a footprint: planes, blocks and uneven ground."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import linprog

from marsyard.scenarios.landing import kernels
from marsyard.scenarios.landing.relief import Limits, Relief

LIMITS = Limits(diameter_m=2.0, max_slope_rad=float(np.radians(15.0)), max_roughness_m=0.2)
SPACING_M = 0.025


def _make_relief(slope: float = 0.0, block_height_m: float = 0.0, half_width_m: float = 0.1) -> Relief:
    """Return a 6 m x 6 m relief that rises to the east, with a block at its centre."""
    x, y = np.meshgrid(np.arange(-3.0, 3.0, SPACING_M), np.arange(-3.0, 3.0, SPACING_M))
    heights = slope * x + block_height_m * ((abs(x) < half_width_m) & (abs(y) < half_width_m))
    return Relief(heights, -3.0, -3.0, SPACING_M)


def test_plane_has_exact_slope_and_no_roughness() -> None:
    footprints = _make_relief(slope=np.tan(np.radians(10.0))).footprints(np.array([[0.0, 0.0], [1.2, -0.7]]), LIMITS)
    np.testing.assert_allclose(np.degrees(footprints.slope_rad), 10.0, atol=1e-9)
    np.testing.assert_allclose(footprints.roughness_m, 0.0, atol=1e-9)
    assert footprints.safe.all()
    assert not _make_relief(slope=np.tan(np.radians(15.1))).footprints(np.array([[0.0, 0.0]]), LIMITS).safe.any()


def test_block_is_a_hazard_only_inside_the_footprint() -> None:
    relief = _make_relief(slope=0.1, block_height_m=0.3)
    footprints = relief.footprints(np.array([[0.0, 0.0], [1.0, 0.0], [1.2, 0.0]]), LIMITS)
    # The fitted plane is nearly the ground, because the block is small. The cost of deviations below
    # 0.1 mm is quadratic, so the block tilts the plane slightly.
    np.testing.assert_allclose(footprints.roughness_m, [0.3, 0.3, 0.0], atol=1e-5)
    np.testing.assert_array_equal(footprints.safe, [False, False, True])
    # The block is 0.2 m x 0.2 m: 8 x 8 points of 25 mm, without those at its edges.
    assert footprints.exceeding_m2[0] == pytest.approx(0.04, rel=0.15)


def _make_uneven_relief(height_m: float = 0.3) -> Relief:
    """Return a 6 m x 6 m relief with mounds and hollows of half a metre width."""
    noise = np.random.default_rng(3).standard_normal((240, 240))
    smooth_noise = gaussian_filter(noise, 20.0)
    return Relief(height_m * smooth_noise / abs(smooth_noise).max(), -3.0, -3.0, SPACING_M)


def test_plane_minimises_absolute_deviations() -> None:
    relief = _make_uneven_relief()
    position = np.array([0.4, -0.3])
    footprints = relief.footprints(position[None], LIMITS)
    row, column = np.rint(relief.cells(position)).astype(int)
    # The lander radius of 1 m is 40 grid points.
    row_offset, column_offset = (index.ravel() for index in np.mgrid[-40:41, -40:41])
    in_footprint = np.hypot(row_offset, column_offset) <= 40
    row_offset, column_offset = row_offset[in_footprint], column_offset[in_footprint]
    heights = relief.heights_m[row + row_offset, column + column_offset]
    # Independent method: linear program for the same points, minimise sum t with -t <= z - plane <= t.
    # The fit uses every fourth row and column.
    in_fit = (row_offset % 4 == 0) & (column_offset % 4 == 0)
    design = np.stack([np.ones(len(row_offset)), column_offset * SPACING_M, row_offset * SPACING_M], axis=-1)
    fit_design, n_fit = design[in_fit], int(in_fit.sum())
    bounds = np.block([[fit_design, -np.eye(n_fit)], [-fit_design, -np.eye(n_fit)]])
    solution = linprog(
        np.r_[np.zeros(3), np.ones(n_fit)],
        bounds,
        np.r_[heights[in_fit], -heights[in_fit]],
        bounds=[(None, None)] * (3 + n_fit),
    )
    assert solution.x is not None
    plane = solution.x[:3]
    assert footprints.slope_rad[0] == pytest.approx(np.arctan(np.hypot(*plane[1:])), abs=1e-3)
    assert footprints.roughness_m[0] == pytest.approx(abs(heights - design @ plane).max(), abs=1e-3)


def test_footprint_plane_is_continuous_in_position() -> None:
    steps = np.arange(-1.5, 1.5, SPACING_M)
    for x, y in ((steps, np.full_like(steps, 0.2)), (np.full_like(steps, -0.4), steps)):
        footprints = _make_uneven_relief().footprints(np.stack([x, y], axis=-1), LIMITS)
        # The slope is at most 0.5: one step changes a height, and therefore the plane, by at most 1.3 cm.
        assert np.abs(np.diff(footprints.roughness_m)).max() < 0.02
        assert np.abs(np.diff(np.tan(footprints.slope_rad))).max() < 0.02


def test_rock_on_a_fifth_of_the_footprint_does_not_tilt_the_plane() -> None:
    # A square of 0.8 m at the centre: 0.64 of 3.14 m2.
    footprints = _make_relief(slope=0.1, block_height_m=0.3, half_width_m=0.4).footprints(np.zeros((1, 2)), LIMITS)
    assert np.tan(footprints.slope_rad[0]) == pytest.approx(0.1, abs=1e-3)
    assert footprints.roughness_m[0] == pytest.approx(0.3, abs=1e-3)


def test_footprint_outside_the_height_grid_is_rejected() -> None:
    with pytest.raises(ValueError, match="beyond the grid of exact heights"):
        _make_relief().footprints(np.array([[2.5, 0.0]]), LIMITS)


def test_triangles_raise_the_ground() -> None:
    """Heights below a triangle with corners at 1, 1 and 3 m are raised to it; the other heights do not change."""
    heights = np.zeros((5, 5))
    vertices = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 4.0, 3.0]])
    faces = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    kernels.raise_by_triangles(heights, 0.0, 0.0, 1.0, vertices, faces)
    row, column = np.indices((5, 5))
    np.testing.assert_allclose(heights, np.where(row + column <= 4, 1.0 + 0.5 * row, 0.0))
