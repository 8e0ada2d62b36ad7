"""The exact ground under a lander: planes, rocks and what is off them."""

import numpy as np
import pytest

from scenarios.landing import kernels
from scenarios.landing.relief import Limits, Relief

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
    np.testing.assert_allclose(under.roughness_m, [0.3, 0.3, 0.0], atol=1e-6)
    np.testing.assert_array_equal(under.safe, [False, False, True])
    # eight points each way are within 10 cm, less the edges
    assert under.exceeding_m2[0] == pytest.approx(0.04, rel=0.15)


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
