"""Tests of the selection of an image pair against analytic solutions for level ground and straight flight."""

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
HEIGHT_M = 10.0
#: Measured range at each of 40 images.
RANGES_M = np.full(40, HEIGHT_M)


def _make_poses(step_m: float, count: int = 40, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> list[PoseMeasurement]:
    """Return nadir poses that are `step_m` apart along x; all poses but the first are rotated by yaw and pitch."""
    poses = []
    for number in range(count):
        angles = [yaw_deg * (number > 0), pitch_deg * (number > 0)]
        rotation = Rotation.from_euler("zy", angles, degrees=True)
        poses.append(PoseMeasurement(rigid(rotation, np.array([number * step_m, 0.0, HEIGHT_M])), 0.1 * number))
    return poses


def test_shortest_sufficient_baseline_has_max_overlap() -> None:
    choice = choose_pair(_make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=0.2), HEIGHT_M)
    # the maximum baseline, 0.2 x 10 m, is 16 steps of 0.125 m
    assert (choice.first, choice.second) == (0, 16)
    assert choice.baseline_m == pytest.approx(2.0)
    # Field width at 10 m: 640 px of 7.4 um and a focal length of 6 mm give 7.89 m, with lens distortion 8.04 m.
    assert choice.overlap == pytest.approx(1.0 - 2.0 / 8.0, abs=0.006)


def test_product_of_baseline_and_overlap_is_maximal_without_baseline_limit() -> None:
    """With the field width w, b (1 - b / w) is maximal at b = w / 2 = 4.0 m, where the overlap is one half."""
    choice = choose_pair(
        _make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.1), HEIGHT_M
    )
    assert choice.baseline_m == pytest.approx(4.0, abs=0.13)
    # A larger required overlap limits the baseline.
    choice = choose_pair(
        _make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.7), HEIGHT_M
    )
    assert choice.baseline_m == pytest.approx(0.3 * 8.0, abs=0.13)


def test_rotation_reduces_overlap() -> None:
    """A pitch of 10 deg shifts the footprint of the second image by 10 m tan 10 deg = 1.76 m."""
    no_pitch, pitch_with_motion, pitch_against_motion = (
        choose_pair(_make_poses(0.5, 2, pitch_deg=deg), RANGES_M[:2], CAMERA, PairParameters(), HEIGHT_M).overlap
        for deg in (0.0, -10.0, 10.0)
    )
    assert no_pitch == pytest.approx(1.0 - 0.5 / 8.0, abs=0.005)
    for overlap, sign in ((pitch_with_motion, 1.0), (pitch_against_motion, -1.0)):
        assert overlap == pytest.approx(1.0 - abs(0.5 + sign * 1.76) / 8.0, abs=0.03)


def test_rotation_that_cancels_the_motion_in_the_image_is_not_preferred() -> None:
    """The baseline decides: with the default parameters it is 0.2 of the range, as without the rotation."""
    choice = choose_pair(_make_poses(0.125, yaw_deg=10.0), RANGES_M, CAMERA, PairParameters(), HEIGHT_M)
    assert choice.baseline_m == pytest.approx(2.0, abs=0.13)
    assert "max_shift_px" not in PairParameters.model_fields


def test_missing_range_uses_commanded_height() -> None:
    choice = choose_pair(_make_poses(0.125), np.full(40, np.nan), CAMERA, PairParameters(), HEIGHT_M)
    assert (choice.first, choice.second) == (0, 16)


def test_pair_with_too_small_overlap_is_accepted_without_alternative() -> None:
    choice = choose_pair(_make_poses(5.0, 3), RANGES_M[:3], CAMERA, PairParameters(min_overlap=0.9), HEIGHT_M)
    assert (choice.first, choice.second) == (0, 1)
    with pytest.raises(ValueError, match="at least 2"):
        choose_pair(_make_poses(1.0, 1), RANGES_M[:1], CAMERA, PairParameters(), HEIGHT_M)
