"""Tests of the exact ground under a lander: planes, rocks and deviations from the plane."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import linprog

from marsyard.scenarios.landing import kernels
from marsyard.scenarios.landing.relief import Limits, Relief

LIMITS = Limits(diameter_m=2.0, max_slope_rad=float(np.radians(15.0)), max_roughness_m=0.2)
SPACING = 0.025


def _make_relief(slope: float = 0.0, block: float = 0.0, half_m: float = 0.1) -> Relief:
    """Ground of 6 m that rises to the east, with a block of this height at its centre."""
    x, y = np.meshgrid(np.arange(-3.0, 3.0, SPACING), np.arange(-3.0, 3.0, SPACING))
    heights = slope * x + block * ((abs(x) < half_m) & (abs(y) < half_m))
    return Relief(heights, -3.0, -3.0, SPACING)


def test_plane_has_exact_slope_and_no_roughness() -> None:
    under = _make_relief(slope=np.tan(np.radians(10.0))).footprints(np.array([[0.0, 0.0], [1.2, -0.7]]), LIMITS)
    np.testing.assert_allclose(np.degrees(under.slope_rad), 10.0, atol=1e-9)
    np.testing.assert_allclose(under.roughness_m, 0.0, atol=1e-9)
    assert under.safe.all()
    assert not _make_relief(slope=np.tan(np.radians(15.1))).footprints(np.array([[0.0, 0.0]]), LIMITS).safe.any()


def test_block_is_a_hazard_only_within_footprint_reach() -> None:
    relief = _make_relief(slope=0.1, block=0.3)
    under = relief.footprints(np.array([[0.0, 0.0], [1.0, 0.0], [1.2, 0.0]]), LIMITS)
    # The plane is that of the ground: the block covers 0.2 % of the footprint. Deviations below 0.1 mm have a quadratic
    # cost, so the block tilts the plane slightly.
    np.testing.assert_allclose(under.roughness_m, [0.3, 0.3, 0.0], atol=1e-5)
    np.testing.assert_array_equal(under.safe, [False, False, True])
    # Eight points in each direction are within 10 cm, except at the edges.
    assert under.exceeding_m2[0] == pytest.approx(0.04, rel=0.15)


def _make_uneven_relief(height_m: float = 0.3) -> Relief:
    """Ground of 6 m with mounds and hollows of half a metre width."""
    noise = np.random.default_rng(3).standard_normal((240, 240))
    swells = gaussian_filter(noise, 20.0)
    return Relief(height_m * swells / abs(swells).max(), -3.0, -3.0, SPACING)


def test_plane_minimises_absolute_deviations() -> None:
    relief = _make_uneven_relief()
    position = np.array([0.4, -0.3])
    under = relief.footprints(position[None], LIMITS)
    row, column = np.rint(relief.cells(position)).astype(int)
    i, j = (index.ravel() for index in np.mgrid[-40:41, -40:41])
    inside = np.hypot(i, j) <= 40
    i, j = i[inside], j[inside]
    heights = relief.heights_m[row + i, column + j]
    # Minimise sum t with -t <= z - plane <= t: an exact solver finds the plane through the same points.
    fitted = (i % 4 == 0) & (j % 4 == 0)
    design = np.stack([np.ones(len(i)), j * SPACING, i * SPACING], axis=-1)
    few, n = design[fitted], int(fitted.sum())
    bounds = np.block([[few, -np.eye(n)], [-few, -np.eye(n)]])
    solved = linprog(
        np.r_[np.zeros(3), np.ones(n)],
        bounds,
        np.r_[heights[fitted], -heights[fitted]],
        bounds=[(None, None)] * (3 + n),
    )
    assert solved.x is not None
    plane = solved.x[:3]
    assert under.slope_rad[0] == pytest.approx(np.arctan(np.hypot(*plane[1:])), abs=1e-3)
    assert under.roughness_m[0] == pytest.approx(abs(heights - design @ plane).max(), abs=1e-3)


def test_footprint_plane_is_continuous_in_position() -> None:
    steps = np.arange(-1.5, 1.5, SPACING)
    for x, y in ((steps, np.full_like(steps, 0.2)), (np.full_like(steps, -0.4), steps)):
        under = _make_uneven_relief().footprints(np.stack([x, y], axis=-1), LIMITS)
        # The slope is at most 0.5: one step changes a height, and so the plane, by at most 1.3 cm.
        assert np.abs(np.diff(under.roughness_m)).max() < 0.02
        assert np.abs(np.diff(np.tan(under.slope_rad))).max() < 0.02


def test_rock_under_a_fifth_of_footprint_does_not_tilt_plane() -> None:
    # A square of 0.8 m at the centre: 0.64 of 3.14 m2.
    under = _make_relief(slope=0.1, block=0.3, half_m=0.4).footprints(np.zeros((1, 2)), LIMITS)
    assert np.tan(under.slope_rad[0]) == pytest.approx(0.1, abs=1e-3)
    assert under.roughness_m[0] == pytest.approx(0.3, abs=1e-3)


def test_footprint_outside_known_ground_is_rejected() -> None:
    with pytest.raises(ValueError, match="beyond the grid of exact heights"):
        _make_relief().footprints(np.array([[2.5, 0.0]]), LIMITS)


def test_triangles_raise_the_ground() -> None:
    heights = np.zeros((5, 5))
    vertices = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 4.0, 3.0]])
    faces = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    kernels.raise_by_triangles(heights, 0.0, 0.0, 1.0, vertices, faces)
    i, j = np.indices((5, 5))
    np.testing.assert_allclose(heights, np.where(i + j <= 4, 1.0 + 0.5 * i, 0.0))
