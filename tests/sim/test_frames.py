"""Tests of reference frames (world: east, north, up; site: north, east, down), transforms and quaternions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import (
    SITE_FROM_WORLD,
    accumulate_quaternions,
    compose,
    direction,
    multiply_quaternions,
    rigid,
    rigid_from_axes,
)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "expected"),
    [(0, 0, [0, 1, 0]), (90, 0, [1, 0, 0]), (180, 0, [0, -1, 0]), (123, 90, [0, 0, 1]), (0, -90, [0, 0, -1])],
)
def test_directions_are_clockwise_from_north(azimuth_deg: float, elevation_deg: float, expected: list[float]) -> None:
    assert_allclose(direction(np.radians(azimuth_deg), np.radians(elevation_deg)), expected, atol=1e-15)


def test_site_axes_are_north_east_down() -> None:
    north, east, up = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    site_axes = SITE_FROM_WORLD.apply(np.stack([north, east, up]))
    assert_allclose(site_axes, np.diag([1.0, 1.0, -1.0]), atol=1e-15)
    assert np.linalg.det(SITE_FROM_WORLD.as_matrix()) == pytest.approx(1.0)


def test_rigid_transform_rotates_then_translates() -> None:
    quarter_turn = Rotation.from_euler("z", 90, degrees=True)
    point = rigid(quarter_turn, np.array([10.0, 0.0, 0.0])).apply([1.0, 0.0, 0.0])
    assert_allclose(point, [10.0, 1.0, 0.0], atol=1e-15)


def test_unchecked_transforms_match_scipy() -> None:
    """`rigid_from_axes` and `compose` omit the checks and the normalisation of SciPy's transforms."""
    rotations, positions = Rotation.random(20, rng=1), np.random.default_rng(1).normal(size=(20, 3))
    for rotation, position in zip(rotations, positions, strict=True):
        transform = RigidTransform.from_components(position, rotation)
        assert_allclose(rigid_from_axes(rotation.as_matrix(), position).as_matrix(), transform.as_matrix(), atol=1e-15)
        composition = compose(transform, rigid(rotations[0], positions[0]))
        assert_allclose(
            composition.as_matrix(), (transform * rigid(rotations[0], positions[0])).as_matrix(), rtol=0.0, atol=4e-15
        )


def test_quaternion_products_match_rotations() -> None:
    left, right = Rotation.random(50, rng=1), Rotation.random(50, rng=2)
    product = Rotation.from_quat(multiply_quaternions(left.as_quat(), right.as_quat()))
    assert_allclose(product.as_matrix(), (left * right).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 100])
def test_accumulated_quaternions_equal_rotation_products(count: int) -> None:
    steps = Rotation.random(count, rng=count)
    product, expected = Rotation.identity(), []
    for step in steps:
        product = product * step
        expected.append(product.as_matrix())
    result = Rotation.from_quat(accumulate_quaternions(steps.as_quat()))
    assert_allclose(result.as_matrix(), expected, atol=1e-12)
    assert accumulate_quaternions(np.empty((0, 4))).shape == (0, 4)


def test_no_quaternions_accumulate_to_none() -> None:
    assert accumulate_quaternions(np.empty((0, 4))).shape == (0, 4)
