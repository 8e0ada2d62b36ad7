"""Tests of the accuracy formulas of tracking against Table I of the tracking paper."""

from __future__ import annotations

import pytest

from marsyard.algorithms.vtt.accuracy import (
    NAVCAM,
    PANCAM,
    StereoDesign,
    accuracy_row,
    drift_error_m,
    round_half_up,
    stereo_range_error_m,
    table_1,
    tracked_approach_error_m,
)


def test_table_1_matches_printed_digits() -> None:
    pancam, navcam = table_1()
    assert (pancam.designation_cm, pancam.untracked_cm) == (9.7, 18.7)
    assert (navcam.designation_cm, navcam.untracked_cm) == (38.8, 42.0)
    assert pancam.tracked_formula == "sqrt(0.4^2 + (0.06 N)^2)"
    assert navcam.tracked_formula == "sqrt(1.6^2 + (0.16 N)^2)"


def test_ten_pixel_drift_matches_the_paper() -> None:
    # "Even with an extreme 10-pixel drift, ... 0.7 cm for pancam and 2.3 cm with navcam."
    pancam, navcam = table_1()
    assert round_half_up(pancam.tracked_cm(10.0), 1) == 0.7
    assert round_half_up(navcam.tracked_cm(10.0), 1) == 2.3


def test_table_1_requires_the_specified_pixel_pitch() -> None:
    # The text of the paper derives a pitch of 4.69 um from the sensor size (4.8 mm / 1024); with this pitch the errors
    # would be 9.8 and 39.1 cm.
    designs = [
        StereoDesign(design.name, design.focal_length_m, 4.8e-3 / 1024, design.baseline_m)
        for design in (PANCAM, NAVCAM)
    ]
    assert [accuracy_row(design).designation_cm for design in designs] == [9.8, 39.1]


def test_errors_scale_with_range_and_focal_length() -> None:
    assert stereo_range_error_m(6.0, 1000.0, 0.2) == pytest.approx(9.0 * stereo_range_error_m(2.0, 1000.0, 0.2))
    # range^2 x disparity error / (focal length x baseline): 4 m2 x 0.5 px / (1000 px x 0.2 m)
    assert stereo_range_error_m(2.0, 1000.0, 0.2, 0.5) == pytest.approx(0.01)
    # A pixel at 2 m: 0.58 mm and 1.55 mm.
    assert drift_error_m(2.0, PANCAM.focal_px, 1.0) == pytest.approx(0.58e-3, abs=5e-6)
    assert tracked_approach_error_m(0.03, 0.04) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [(38.75, 1, 38.8), (38.749999999999993, 1, 38.8), (1.55, 1, 1.6), (0.155, 2, 0.16), (-0.25, 1, -0.3)],
)
def test_half_digits_are_rounded_away_from_zero(value: float, digits: int, expected: float) -> None:
    assert round_half_up(value, digits) == expected
