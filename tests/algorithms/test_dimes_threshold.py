"""Tests of the Monte Carlo derivation of the threshold of DIMES' IMU check, and of its stored result."""

import json
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

from benchmarks import dimes_threshold
from benchmarks.simulated_instruments import InstrumentErrors, simulate_instruments
from benchmarks.threshold_derivation import (
    ThresholdInputs,
    WrongTrackOutcomes,
    discrepancies,
    draw_correct_track_errors,
    simulate_wrong_track,
    threshold_m_s,
)
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.campaigns.definition.loading import load_campaign

#: Stored result of the derivation: inputs, threshold and quantiles.
STORED = json.loads(dimes_threshold.STORED.read_text())
#: Inputs without measurement errors.
EXACT = ThresholdInputs(
    descents=20,
    common_altitude_sd=0.0,
    altitude_sd=0.0,
    common_attitude_sd_deg=0.0,
    attitude_sd_deg=0.0,
    feature_height_sd_m=0.0,
    match_sd_m_s=0.0,
)


def test_default_threshold_matches_stored_derivation() -> None:
    assert DimesOptions().imu_threshold_m_s == STORED["threshold_m_s"]
    assert json.loads(json.dumps(asdict(ThresholdInputs()))) == STORED["inputs"]
    low, high = STORED["accepted_quantile_90_percent_bounds_m_s"]
    assert low < STORED["threshold_m_s"] < high


def test_inputs_are_the_rounded_errors_of_the_simulated_instruments() -> None:
    for field in fields(InstrumentErrors):
        # two digits: the rounding error is at most 5 %, half a unit of 1.0
        assert getattr(ThresholdInputs(), field.name) == pytest.approx(STORED["instruments"][field.name], rel=0.05)


@pytest.mark.slow
def test_simulated_instruments_have_the_stored_errors() -> None:
    # A small terrain. Relief changes the altitude errors, so only the errors without relief are compared. The common
    # errors of 40 descents have a standard error of about 15 %, and a few large ones dominate the mean square.
    campaign = load_campaign(dimes_threshold.CAMPAIGN, ["parameters.location.bank=1", "parameters.terrain.samples=256"])
    errors = simulate_instruments(campaign, 40)
    stored = STORED["instruments"]
    for name in ("common_attitude_sd_deg", "attitude_sd_deg", "imu_sd_m_s"):
        assert getattr(errors, name) == pytest.approx(stored[name], rel=0.45)
    # a scale error of 0.3 % and noise of 0.15 % without relief
    assert errors.common_altitude_sd > 0.5 * 0.003
    assert errors.altitude_sd > 0.5 * 0.0015


def test_error_free_tracks_are_exact() -> None:
    # The tolerance covers rounding between pixels and ground.
    assert np.abs(draw_correct_track_errors(EXACT, np.random.default_rng(1))).max() < 1e-6


def test_threshold_is_rounded_up_to_its_step() -> None:
    values = np.linspace(0.0, 1.0, 1001)
    assert threshold_m_s(values, 0.99, 0.1) == 1.0
    assert threshold_m_s(values, 0.81, 0.05) == 0.85


def test_outcomes_of_one_wrong_track_have_the_expected_fractions() -> None:
    exact = np.zeros((50, 2, 2, 2))
    rng = np.random.default_rng(3)
    assert simulate_wrong_track(exact, (10.0, 10.0), 4.5, 0.0, rng) == WrongTrackOutcomes(1.0, 0.0, 0.0)
    assert simulate_wrong_track(exact[:, :, :1], (10.0, 10.0), 4.5, 0.0, rng) == WrongTrackOutcomes(0.0, 1.0, 0.0)
    # Without a threshold the wrong track is reported if it is in the second pair: half of the cases.
    unchecked = simulate_wrong_track(exact[:, :, :1], (10.0, 10.0), 100.0, 0.0, rng)
    assert unchecked.wrong == pytest.approx(0.5, abs=0.25)
    assert unchecked.rejected == 0.0


@pytest.fixture(scope="module")
def confirmation_errors() -> np.ndarray:
    """Track errors for the inputs of the stored derivation, with a confirmation seed."""
    return draw_errors(replace(ThresholdInputs(), descents=250), seed=77)


def draw_errors(inputs: ThresholdInputs, seed: int = 1) -> np.ndarray:
    """Draw velocity errors of correct tracks, m/s, shape (descents, pair, template, 2)."""
    return draw_correct_track_errors(inputs, np.random.default_rng(seed))


@pytest.mark.slow
def test_common_attitude_error_causes_apparent_drift() -> None:
    # A tilt b (rad) at the velocity v causes an apparent velocity b x v. For 75 m/s down and 0.5 deg per axis it is
    # 0.65 m/s per axis. A heading error of 0.5 deg adds at most 0.26 m/s at 30 m/s of drift.
    errors = draw_errors(replace(EXACT, descents=120, common_attitude_sd_deg=0.5))
    apparent_m_s = np.radians(0.5) * 281.0 / 3.75  # 281 m of descent in 3.75 s
    assert 0.8 * apparent_m_s < errors.std() < 1.7 * apparent_m_s
    # All tracks have the same error: the IMU check is hardly affected.
    result = discrepancies(errors, 0.0, np.random.default_rng(1))
    assert np.median(result.one_track) < 0.5 * np.median(np.linalg.norm(errors[:, 1, 0], axis=-1))


@pytest.mark.slow
def test_confirmation_seed_has_similar_availability(confirmation_errors: np.ndarray) -> None:
    result = discrepancies(confirmation_errors, ThresholdInputs().imu_sd_m_s, np.random.default_rng(2))
    # The stored derivation accepts 99.56 %: of 250 cases, 1.1 +- 1.0 fail.
    assert np.sum(result.one_track >= STORED["threshold_m_s"]) <= 5
    assert np.all(result.two_tracks <= result.one_track)
    expected = STORED["discrepancy_quantiles_m_s"]["one correct track in each pair"]
    assert np.quantile(result.one_track, 0.5) == pytest.approx(expected["0.5"], rel=0.15)
    assert np.quantile(result.one_track, 0.9) == pytest.approx(expected["0.9"], rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("tracks_per_pair", [1, 2])
@pytest.mark.parametrize("range_m_s", [(10.0, 10.0), (10.0, 60.0)])
def test_one_wrong_track_rarely_causes_a_wrong_velocity(
    confirmation_errors: np.ndarray, tracks_per_pair: int, range_m_s: tuple[float, float]
) -> None:
    # With one track wrong by at least 10 m/s, 99.5 % of cases report a correct velocity or none.
    rng = np.random.default_rng(5)
    tracks = np.concatenate([confirmation_errors[:, :, :tracks_per_pair]] * 8)
    fractions = simulate_wrong_track(tracks, range_m_s, STORED["threshold_m_s"], ThresholdInputs().imu_sd_m_s, rng)
    assert fractions.correct + fractions.rejected >= 0.995
    assert fractions.correct + fractions.rejected + fractions.wrong == pytest.approx(1.0)
    # With a second track in the pair, the correct velocity is almost always reported.
    assert fractions.correct > 0.99 if tracks_per_pair == 2 else fractions.rejected > 0.99


@pytest.mark.slow
def test_velocity_errors_have_the_match_error_deviation() -> None:
    errors = draw_errors(replace(EXACT, descents=80, match_sd_m_s=0.3))
    assert errors.std() == pytest.approx(0.3, rel=0.1)  # 640 values: 3 % is one standard deviation
