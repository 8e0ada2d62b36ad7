"""The choice of two pictures, against the closed form of level ground seen from a straight line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.landing.flight import choose_pair
from marsyard.scenarios.landing.parameters import PairParameters
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor import preset

CAMERA = preset("xc-55").cameras()[0]
HEIGHT = 10.0
RANGES = np.full(40, HEIGHT)


def _poses(step_m: float, count: int = 40, turned_deg: float = 0.0, pitched_deg: float = 0.0) -> list[PoseMeasurement]:
    """Nadir views `step_m` apart along the picture's columns' direction, the later ones turned."""
    poses = []
    for number in range(count):
        angles = [turned_deg * (number > 0), pitched_deg * (number > 0)]
        turn = Rotation.from_euler("zy", angles, degrees=True)
        poses.append(PoseMeasurement(rigid(turn, np.array([number * step_m, 0.0, HEIGHT])), 0.1 * number))
    return poses


def test_the_shortest_baseline_that_is_wanted_has_the_most_overlap() -> None:
    choice = choose_pair(_poses(0.125), RANGES, CAMERA, PairParameters(max_baseline_fraction=0.2), HEIGHT)
    assert (choice.first, choice.second) == (0, 16)
    assert choice.baseline_m == pytest.approx(2.0)
    # 640 px of 7.4 um behind 6 mm are 7.89 m wide from 10 m; distortion, 1.8 % in the corners, makes it 8.04 m there
    assert choice.overlap == pytest.approx(1.0 - 2.0 / 8.0, abs=0.006)


def test_where_overlap_falls_before_the_baseline_is_there_their_product_is_greatest() -> None:
    """Of b (1 - b / w) the greatest is at half the width, 4.0 m, if so much is wanted."""
    choice = choose_pair(
        _poses(0.125), RANGES, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.1), HEIGHT
    )
    assert choice.baseline_m == pytest.approx(4.0, abs=0.13)
    # with more overlap asked for, as much baseline as that leaves
    choice = choose_pair(
        _poses(0.125), RANGES, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.7), HEIGHT
    )
    assert choice.baseline_m == pytest.approx(0.3 * 8.0, abs=0.13)


def test_turns_cost_overlap() -> None:
    """A pitch of 10 deg moves the second picture's ground by 10 m tan 10 deg = 1.76 m, along or against the motion."""
    straight, with_it, against = (
        choose_pair(_poses(0.5, 2, pitched_deg=deg), RANGES[:2], CAMERA, PairParameters(), HEIGHT).overlap
        for deg in (0.0, -10.0, 10.0)
    )
    assert straight == pytest.approx(1.0 - 0.5 / 8.0, abs=0.005)
    for overlap, sign in ((with_it, 1.0), (against, -1.0)):
        assert overlap == pytest.approx(1.0 - abs(0.5 + sign * 1.76) / 8.0, abs=0.03)


def test_pictures_without_a_range_count_by_the_commanded_height() -> None:
    silent = choose_pair(_poses(0.125), np.full(40, np.nan), CAMERA, PairParameters(), HEIGHT)
    assert (silent.first, silent.second) == (0, 16)


def test_too_little_overlap_is_taken_if_there_is_nothing_else() -> None:
    choice = choose_pair(_poses(5.0, 3), RANGES[:3], CAMERA, PairParameters(min_overlap=0.9), HEIGHT)
    assert (choice.first, choice.second) == (0, 1)
    with pytest.raises(ValueError, match="at least 2"):
        choose_pair(_poses(1.0, 1), RANGES[:1], CAMERA, PairParameters(), HEIGHT)
