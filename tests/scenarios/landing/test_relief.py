"""The exact ground under a lander: planes, rocks and what is off them."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import linprog

from marsyard.scenarios.landing import kernels
from marsyard.scenarios.landing.relief import Limits, Relief

LIMITS = Limits(diameter_m=2.0, max_slope_rad=float(np.radians(15.0)), max_roughness_m=0.2)
SPACING = 0.025


def _relief(slope: float = 0.0, block: float = 0.0, half_m: float = 0.1) -> Relief:
    """Ground of 6 m that climbs to the east, with a block of this height in its middle."""
    x, y = np.meshgrid(np.arange(-3.0, 3.0, SPACING), np.arange(-3.0, 3.0, SPACING))
    heights = slope * x + block * ((abs(x) < half_m) & (abs(y) < half_m))
    return Relief(heights, -3.0, -3.0, SPACING)


def test_a_plane_has_its_slope_and_no_roughness() -> None:
    under = _relief(slope=np.tan(np.radians(10.0))).footprints(np.array([[0.0, 0.0], [1.2, -0.7]]), LIMITS)
    np.testing.assert_allclose(np.degrees(under.slope_rad), 10.0, atol=1e-9)
    np.testing.assert_allclose(under.roughness_m, 0.0, atol=1e-9)
    assert under.safe.all()
    assert not _relief(slope=np.tan(np.radians(15.1))).footprints(np.array([[0.0, 0.0]]), LIMITS).safe.any()


def test_a_block_is_a_hazard_where_the_footprint_reaches_it_and_only_there() -> None:
    relief = _relief(slope=0.1, block=0.3)
    under = relief.footprints(np.array([[0.0, 0.0], [1.0, 0.0], [1.2, 0.0]]), LIMITS)
    # the plane is that of the ground: the block is two thousandths of the footprint
    # deviations below 0.1 mm count by their squares: the share of it that the block has of the points moves the plane
    np.testing.assert_allclose(under.roughness_m, [0.3, 0.3, 0.0], atol=1e-5)
    np.testing.assert_array_equal(under.safe, [False, False, True])
    # eight points each way are within 10 cm, less the edges
    assert under.exceeding_m2[0] == pytest.approx(0.04, rel=0.15)


def _uneven(height_m: float = 0.3) -> Relief:
    """Ground of 6 m with swells and hollows of half a metre across."""
    noise = np.random.default_rng(3).standard_normal((240, 240))
    swells = gaussian_filter(noise, 20.0)
    return Relief(height_m * swells / abs(swells).max(), -3.0, -3.0, SPACING)


def test_the_plane_is_that_of_least_absolute_deviations() -> None:
    relief = _uneven()
    place = np.array([0.4, -0.3])
    under = relief.footprints(place[None], LIMITS)
    row, column = np.rint(relief.cells(place)).astype(int)
    i, j = (index.ravel() for index in np.mgrid[-40:41, -40:41])
    inside = np.hypot(i, j) <= 40
    i, j = i[inside], j[inside]
    heights = relief.heights_m[row + i, column + j]
    # min sum t, with -t <= z - plane <= t: an exact solver's plane through the points that planes are laid through
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


def test_the_ground_under_a_lander_changes_continuously_with_the_place() -> None:
    steps = np.arange(-1.5, 1.5, SPACING)
    for x, y in ((steps, np.full_like(steps, 0.2)), (np.full_like(steps, -0.4), steps)):
        under = _uneven().footprints(np.stack([x, y], axis=-1), LIMITS)
        # the ground is no steeper than 0.5: a step of a point moves no height, and so no plane, by more than 1.3 cm
        assert np.abs(np.diff(under.roughness_m)).max() < 0.02
        assert np.abs(np.diff(np.tan(under.slope_rad))).max() < 0.02


def test_a_rock_under_a_fifth_of_the_footprint_does_not_tilt_the_plane() -> None:
    # 0.8 m square, in the middle: 0.64 of 3.14 m2
    under = _relief(slope=0.1, block=0.3, half_m=0.4).footprints(np.zeros((1, 2)), LIMITS)
    assert np.tan(under.slope_rad[0]) == pytest.approx(0.1, abs=1e-3)
    assert under.roughness_m[0] == pytest.approx(0.3, abs=1e-3)


def test_a_footprint_must_lie_on_known_ground() -> None:
    with pytest.raises(ValueError, match="beyond the ground"):
        _relief().footprints(np.array([[2.5, 0.0]]), LIMITS)


def test_triangles_raise_the_ground_to_their_planes() -> None:
    heights = np.zeros((5, 5))
    vertices = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 4.0, 3.0]])
    faces = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    kernels.raise_by_triangles(heights, 0.0, 0.0, 1.0, vertices, faces)
    i, j = np.indices((5, 5))
    np.testing.assert_allclose(heights, np.where(i + j <= 4, 1.0 + 0.5 * i, 0.0))
