"""Tests of the margins of requirements: bound minus metric of a case, negative if the case violates."""

from __future__ import annotations

import math

import pytest

from marsyard.campaigns.definition.configuration import Requirement
from marsyard.campaigns.definition.margins import compute_margin


def test_margin_of_a_scaled_sum_of_columns() -> None:
    requirement = Requirement(
        id="TIME",
        statement="An image and a map take at most 2 s on the flight processor.",
        metric="image_time_s + map_time_s",
        scale=60.0,
        bound=2.0,
        probability=0.95,
        confidence=0.9,
        population="all",
    )
    # the flight processor is 60 times slower than the workstation: 60 x 0.03 s = 1.8 s, 60 x 0.04 s = 2.4 s
    row = {"outcome": "VALID", "answered": True, "image_time_s": 0.02, "map_time_s": 0.01}
    assert compute_margin(row, requirement) == pytest.approx(0.2)
    assert compute_margin({**row, "map_time_s": 0.02}, requirement) == pytest.approx(-0.4)
    assert compute_margin({**row, "map_time_s": float("nan")}, requirement) == -math.inf
    assert compute_margin({"outcome": "VALID", "answered": True, "image_time_s": 0.02}, requirement) == -math.inf
