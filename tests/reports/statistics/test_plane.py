from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marsyard.reports.statistics.samples import ErrorEllipse, circular_error, error_ellipse


def _turned(rng: np.random.Generator, n: int) -> np.ndarray:
    """Normal errors of deviations 3 and 1 about (2, -1), the long axis 30 degrees from the first part's."""
    turn = np.array([[math.cos(0.5236), -math.sin(0.5236)], [math.sin(0.5236), math.cos(0.5236)]])
    return np.asarray(np.array([2.0, -1.0]) + (rng.normal(size=(n, 2)) * [3.0, 1.0]) @ turn.T)


def test_ellipse_of_many_normal_errors() -> None:
    ellipse = error_ellipse(_turned(np.random.default_rng(1), 40_000), 0.95)
    assert ellipse is not None
    # chi-square with two degrees of freedom: -2 ln 0.05 = 5.991.
    assert (ellipse.semi_major, ellipse.semi_minor) == pytest.approx((3 * 2.4477, 2.4477), rel=0.015)
    assert ellipse.centre == pytest.approx((2.0, -1.0), abs=0.06)
    assert ellipse.angle_deg == pytest.approx(30.0, abs=0.5)
    assert ellipse.inside == pytest.approx(0.95, abs=0.004)


def test_the_next_error_lies_inside_as_often_as_stated() -> None:
    # From ten errors; 4,000 trials: one standard deviation of the share is 0.34 %.
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(4000):
        points = _turned(rng, 11)
        ellipse = error_ellipse(points[:10], 0.95)
        assert ellipse is not None
        angle = math.radians(ellipse.angle_deg)
        x, y = points[10] - ellipse.centre
        along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        inside += (along / ellipse.semi_major) ** 2 + (across / ellipse.semi_minor) ** 2 <= 1.0
    assert inside / 4000 == pytest.approx(0.95, abs=3 * 0.0034)


def test_too_few_points_have_no_ellipse() -> None:
    assert error_ellipse(np.ones((4, 2)), 0.95) is None
    assert error_ellipse(np.ones((50, 2)), 0.95) is None
    line = error_ellipse(np.column_stack([np.arange(50.0), np.zeros(50)]), 0.95)
    assert line is not None
    assert (line.semi_minor, line.angle_deg) == (0.0, 0.0)


def test_circular_error_probable_of_a_normal_scatter() -> None:
    # For two independent normal parts of unit deviation the median radius is sqrt(2 ln 2) = 1.1774.
    points = np.random.default_rng(3).normal(size=(20_000, 2))
    found = circular_error(points, 0.5, 0.95)
    assert found.estimate == pytest.approx(math.sqrt(2 * math.log(2)), abs=0.03)
    assert found.lower < math.sqrt(2 * math.log(2)) < found.upper


def test_the_square_about_an_ellipse_touches_it() -> None:
    # Half axes 3 and 1, turned by 30 deg: sqrt((3 cos 30)^2 + (sin 30)^2) = 2.6458 across, 1.7321 up.
    ellipse = ErrorEllipse((0.5, -2.0), 3.0, 1.0, 30.0, 0.95, 0.9)
    assert ellipse.reach == pytest.approx(2.0 + math.sqrt(3.0))
    assert replace(ellipse, centre=(-1.5, 0.0)).reach == pytest.approx(1.5 + math.sqrt(7.0))
