"""Tests of statistics of two-dimensional errors: error ellipse and circular error probable."""

import math
from dataclasses import replace

import numpy as np
import pytest

from marsyard.reports.statistics.error_summary import ErrorEllipse, circular_error, error_ellipse


def _draw_errors(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw normal errors with standard deviations 3 and 1 about (2, -1), rotated by 30 degrees."""
    angle = 0.5236  # 30 degrees in radians
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.asarray(np.array([2.0, -1.0]) + (rng.normal(size=(n, 2)) * [3.0, 1.0]) @ rotation.T)


def test_error_ellipse_of_normal_errors_has_the_true_axes() -> None:
    ellipse = error_ellipse(_draw_errors(np.random.default_rng(1), 40_000), 0.95)
    # chi-square quantile with two degrees of freedom: -2 ln 0.05 = 5.991 = 2.4477^2
    assert (ellipse.semi_major, ellipse.semi_minor) == pytest.approx((3 * 2.4477, 2.4477), rel=0.015)
    assert ellipse.centre == pytest.approx((2.0, -1.0), abs=0.06)
    assert ellipse.angle_deg == pytest.approx(30.0, abs=0.5)
    assert ellipse.inside == pytest.approx(0.95, abs=0.004)


@pytest.mark.slow
def test_error_ellipse_of_ten_errors_contains_the_next_error_with_95_percent() -> None:
    # 4000 trials: standard deviation of the fraction 0.34 %
    rng = np.random.default_rng(2)
    n_inside = 0
    for _ in range(4000):
        points = _draw_errors(rng, 11)
        ellipse = error_ellipse(points[:10], 0.95)
        angle = math.radians(ellipse.angle_deg)
        x, y = points[10] - ellipse.centre
        major, minor = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        n_inside += (major / ellipse.semi_major) ** 2 + (minor / ellipse.semi_minor) ** 2 <= 1.0
    assert n_inside / 4000 == pytest.approx(0.95, abs=3 * 0.0034)


def test_too_few_or_equal_points_have_no_ellipse() -> None:
    assert error_ellipse(np.ones((4, 2)), 0.95) is None
    assert error_ellipse(np.ones((50, 2)), 0.95) is None
    line = error_ellipse(np.column_stack([np.arange(50.0), np.zeros(50)]), 0.95)
    assert (line.semi_minor, line.angle_deg) == (0.0, 0.0)


def test_circular_error_probable_of_normal_errors_is_the_median_radius() -> None:
    # median radius of two independent standard normal components: sqrt(2 ln 2) = 1.1774
    points = np.random.default_rng(3).normal(size=(20_000, 2))
    median_radius = circular_error(points, 0.5, 0.95)
    assert median_radius.estimate == pytest.approx(math.sqrt(2 * math.log(2)), abs=0.03)
    assert median_radius.lower < math.sqrt(2 * math.log(2)) < median_radius.upper


def test_half_extent_of_an_ellipse_covers_its_bounding_box() -> None:
    # semi-axes 3 and 1 rotated by 30 deg: half width sqrt((3 cos 30)^2 + (sin 30)^2) = sqrt(7), half height sqrt(3).
    # The half extent is the largest absolute coordinate of the box: 2 + sqrt(3) along y, 1.5 + sqrt(7) along x.
    ellipse = ErrorEllipse((0.5, -2.0), 3.0, 1.0, 30.0, 0.95, 0.9)
    assert ellipse.half_extent == pytest.approx(2.0 + math.sqrt(3.0))
    assert replace(ellipse, centre=(-1.5, 0.0)).half_extent == pytest.approx(1.5 + math.sqrt(7.0))
