"""The validation can miss: lost cases, faults of a derivation and bars that are far too wide are noticed."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.threshold_derivation import ThresholdInputs, right_track_errors
from benchmarks.validation import dimes_checks, landing_checks, tracking_checks
from benchmarks.validation.document import RESULTS
from benchmarks.validation.imu_reference import Reference
from benchmarks.validation.records import Measure

NAN = float("nan")
#: Bars that are wider than three times their figure, by how their claims begin, and why.
WIDER = {
    "right tracks' discrepancy": "three standard errors of a quantile",
    "stereo range error": "55 pairs leave the ratio uncertain by 10 %",
    "false PASS": "the error rate that is promised",
    "false FAIL": "the error rate that is promised",
    "nights with a false alarm": "the rate that is promised",
}


def stored() -> list[Measure]:
    checks = json.loads(RESULTS.read_text())["checks"]
    return [Measure(**row) for check in checks.values() for row in check["measures"]]


def missed(measures: list[Measure]) -> list[str]:
    return [one.claim for one in measures if not one.passed]


def _lose_drifts(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """Every second target is lost; the others do not drift at all."""
    row = {"selectable": True, "sun_motion_deg": 5.0}
    monkeypatch.setattr(
        tracking_checks, "driven", lambda number, camera: row | {"drift_px": NAN if number % 2 else 0.1}
    )
    return list(tracking_checks.drift(quick=False))


def _lose_stereo_pairs(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """Every second target is not found; the others are as far off as Eq. 1 says."""
    monkeypatch.setattr(
        tracking_checks, "_designation_errors", lambda number, camera: (NAN if number % 2 else 0.1, 0.1)
    )
    return list(tracking_checks.stereo(quick=False))


def _lose_landing_pairs(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """One pair of a hundred finds no motion; the others are exact."""

    def errors(number: int) -> dict[str, dict[str, Any]]:
        value = NAN if number == 3 else 0.0
        row = {"site": landing_checks.SITES[number % 2], "range_m": 10.0, "tracks": 200.0, "elevation_rms_m": value}
        row |= {"rotation_error_deg": value, "baseline_error_fraction": value}
        return {"paper": row, "ours": row}

    monkeypatch.setattr(landing_checks, "errors", errors)
    return list(landing_checks.accuracy(quick=False))


@pytest.mark.parametrize("lose", [_lose_drifts, _lose_stereo_pairs, _lose_landing_pairs])
def test_checks_that_lose_cases_miss_a_bar(
    lose: Callable[[pytest.MonkeyPatch], list[Measure]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert missed(lose(monkeypatch))


def test_bars_are_no_wider_than_three_times_what_is_measured() -> None:
    wide = [
        (one.claim, one.measured, one.bar)
        for one in stored()
        if one.bar is not None and one.sense == "at most" and one.measured > 1e-12
        and one.bar > 4.0 * one.measured and not one.claim.startswith(tuple(WIDER))
    ]  # fmt: skip
    assert wide == []


def test_what_is_worse_than_asked_is_held_to_a_bar() -> None:
    rows = {one.claim: one for one in stored()}
    asked = {"deg": landing_checks.ROTATION_BAR_DEG, "": 0.95}
    for start in ("rotation's error of the paper's features", "nights that name a regression"):
        found = [row for claim, row in rows.items() if claim.startswith(start)]
        assert found
        assert all(row.bar == asked[row.unit] for row in found)


def test_the_threshold_of_a_derivation_at_fault_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    # right tracks that err half as much as they do, in the derivation alone, give half the threshold: a check that
    # repeats the derivation agrees with it
    def halved(inputs: ThresholdInputs, rng: np.random.Generator) -> np.ndarray:
        return 0.5 * right_track_errors(inputs, rng)

    monkeypatch.setattr(dimes_checks, "right_track_errors", halved, raising=False)
    real = dimes_checks.DimesOptions
    monkeypatch.setattr(dimes_checks, "DimesOptions", lambda: real(imu_threshold_m_s=2.3))
    found = missed(list(dimes_checks.imu_check(quick=True)))
    assert "right tracks' discrepancy, 99.5 % quantile, from the threshold" in found
    assert "descents with one right track a pair that pass the IMU check" in found


def test_the_second_implementation_agrees_with_the_first_where_geometry_is_exact() -> None:
    # without errors of instruments only the match is left: 0.1 m/s an axis of each track, which is known exactly
    inputs = ThresholdInputs(
        altitude_sd=0.0, common_attitude_sd_deg=0.0, attitude_sd_deg=0.0, tag_sd_s=0.0, feature_height_sd_m=0.0
    )
    found = Reference.draw(inputs, 300, np.random.default_rng(1))
    np.testing.assert_allclose(found.tracks.std(), inputs.match_sd_m_s, rtol=0.1)
    # of two tracks and the IMU, by Rayleigh's median
    sd = math.sqrt(2.0 * inputs.match_sd_m_s**2 + inputs.imu_sd_m_s**2)
    assert np.median(found.single()) == pytest.approx(sd * math.sqrt(2.0 * math.log(2.0)), rel=0.15)
