"""Checks of DIMES' IMU check, and comparison of DIMES with standard registration methods on the same descents."""

import json
import math
from collections.abc import Iterator

import numpy as np

from benchmarks.dimes_threshold import STORED, WRONG_TRACK_ERRORS_M_S
from benchmarks.estimators import ESTIMATORS, run_estimator, simulate_descents
from benchmarks.threshold_derivation import ThresholdInputs
from benchmarks.validation.imu_reference import VelocityErrors
from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.dimes import DimesOptions
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.terrain.sites import sites

#: Seed of the simulated descents.
SEED = 4002
#: Required fraction of descents with a correct velocity or none, and required velocity error.
REQUIRED_FRACTION = 0.995
REQUIREMENT_M_S = 5.0


def check_imu_threshold(quick: bool) -> Iterator[Measure]:
    """Compare the threshold with a second implementation of its Monte Carlo derivation."""
    inputs, descents = ThresholdInputs(), 300 if quick else 3000
    rng = np.random.default_rng(SEED)
    errors = VelocityErrors.draw(inputs, descents, rng)
    threshold = DimesOptions().imu_threshold_m_s
    discrepancies_m_s = errors.one_track_discrepancies_m_s()
    how = f"{descents} descents of a second implementation by first-order propagation; threshold {threshold:g} m/s"
    # The limits are three standard errors of a quantile. The relative standard error of the quantile q is
    # sqrt(q (1 - q) / n) / (probability density * quantile). The denominator is 0.44 at the median, 0.03 at 99.5 %.
    median_error = float(np.median(discrepancies_m_s)) / _read_stored_median_m_s() - 1.0
    limit = 3.4 / math.sqrt(descents)
    yield Measure(
        "discrepancy of correct tracks: median against the stored derivation", abs(median_error), "", limit, how
    )
    quantile_error = float(np.quantile(discrepancies_m_s, inputs.accepted_fraction)) / threshold - 1.0
    limit = 7.0 / math.sqrt(descents)
    yield Measure(
        "discrepancy of correct tracks: 99.5 % quantile against the threshold", abs(quantile_error), "", limit, how
    )
    fraction = inputs.accepted_fraction
    limit = fraction - 3.0 * math.sqrt(fraction * (1.0 - fraction) / descents)
    passed_fraction = float(np.mean(discrepancies_m_s < threshold))
    claim = "descents with one correct track per pair that pass the IMU check"
    yield Measure(
        claim,
        passed_fraction,
        "",
        limit,
        f"{how}; limit: 99.5 % minus three standard deviations of the simulation",
        "at least",
    )
    passed_fraction = float(np.mean(errors.two_track_discrepancies_m_s() < threshold))
    yield Measure(
        "descents with two correct tracks per pair that pass the IMU check", passed_fraction, "", 0.995, how, "at least"
    )
    for tracks in (1, 2):
        for low, high in WRONG_TRACK_ERRORS_M_S:
            correct, rejected = errors.correct_and_rejected_fractions(tracks, (low, high), threshold, rng)
            error_range = f"{low:g} m/s" if low == high else f"{low:g} to {high:g} m/s"
            yield Measure(
                f"one of {2 * tracks} tracks wrong by {error_range}: correct velocity or none",
                correct + rejected,
                "",
                REQUIRED_FRACTION,
                f"{how}; {100.0 * correct:.2f} % correct, {100.0 * rejected:.2f} % refused",
                "at least",
            )


def _read_stored_median_m_s() -> float:
    """Median discrepancy of one correct track in each pair, from the stored derivation."""
    quantiles = json.loads(STORED.read_text())["discrepancy_quantiles_m_s"]
    return float(quantiles["one correct track in each pair"]["0.5"])


def compare_estimators(quick: bool) -> Iterator[Measure]:
    """Measure the velocity errors of all estimators on the same descents."""
    descents = simulate_descents("dimes-smoke", 4 if quick else 48)
    for name, estimator in ESTIMATORS.items():
        results = run_estimator(estimator, descents)
        valid = results.valid_errors_m_s
        rms = float(np.sqrt(np.mean(valid**2))) if valid.size else float("nan")
        wrong_count = int(np.sum(valid > REQUIREMENT_M_S))
        largest_error = valid.max() if valid.size else float("nan")
        how = (
            f"{valid.size} of {len(descents)} descents of dimes-smoke answered, "
            f"{wrong_count} wrong by more than 5 m/s, largest error {largest_error:.2g} m/s, "
            f"{1e3 * float(np.median(results.seconds)):.0f} core-ms for three images"
        )
        yield Measure(f"velocity error, rms: {name}", rms, "m/s", None, how)


CHECKS = (
    Check("imu-check", "DIMES", check_imu_threshold, conditions=(Conditions(systems=("dimes", "fieldtest")),)),
    Check(
        "estimators",
        "DIMES",
        compare_estimators,
        # the dispersions of dimes-smoke
        conditions=(
            Conditions(
                "*",
                ("dimes",),
                site=("gusev",),
                camera=("mer-descent-flown",),
                sun_elevation_deg=(30.0, 60.0),
                slope_deg=(sites()["gusev"].terrain("descent").rms_slope_deg,) * 2,
                optical_depth=(0.9, 0.9),
                range_m=(1400.0, 2100.0),
            ),
        ),
    ),
)
