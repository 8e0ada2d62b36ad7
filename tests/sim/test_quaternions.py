"""Tests of products of arrays of quaternions, by comparison with SciPy's `Rotation`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import accumulate_quaternions, multiply_quaternions


def test_quaternion_products_match_rotations() -> None:
    left, right = Rotation.random(50, rng=1), Rotation.random(50, rng=2)
    product = Rotation.from_quat(multiply_quaternions(left.as_quat(), right.as_quat()))
    np.testing.assert_allclose(product.as_matrix(), (left * right).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 100])
def test_accumulated_quaternions_equal_rotation_products(count: int) -> None:
    steps = Rotation.random(count, rng=count)
    product, expected = Rotation.identity(), []
    for step in steps:
        product = product * step
        expected.append(product.as_matrix())
    result = Rotation.from_quat(accumulate_quaternions(steps.as_quat()))
    np.testing.assert_allclose(result.as_matrix(), expected, atol=1e-12)
