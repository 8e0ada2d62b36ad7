"""The bars on DIMES' IMU check, and DIMES beside ready-made registration on the same descents."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from algorithms.dimes import DimesOptions
from algorithms.dimes.threshold import ThresholdInputs, discrepancies, harm, right_track_errors
from benchmarks.dimes_threshold import WRONG_BY_M_S
from benchmarks.estimators import ESTIMATORS, recorded, tried
from benchmarks.validation.records import Check, Measure

#: Not the seed of the stored derivation: what is measured is another sample.
SEED = 4002
HARMLESS = 0.995
REQUIREMENT_M_S = 5.0


def imu_check(quick: bool) -> Iterator[Measure]:
    inputs = replace(ThresholdInputs(), descents=300 if quick else 3000)
    rng = np.random.default_rng(SEED)
    errors = right_track_errors(inputs, rng)
    threshold = DimesOptions().imu_threshold_m_s
    found = discrepancies(errors, inputs.imu_sd_m_s, rng)
    how = f"{inputs.descents} descents drawn afresh; threshold {threshold:g} m/s"
    yield Measure(
        "right tracks' discrepancy, 99.5 % quantile", float(np.quantile(found.single, inputs.kept)), "m/s", None, how
    )
    kept = float(np.mean(found.best < threshold))
    yield Measure("descents with two right tracks a pair that pass the IMU check", kept, "", 0.995, how, "at least")
    for tracks in (1, 2):
        for low, high in WRONG_BY_M_S:
            share = harm(errors[:, :, :tracks], (low, high), threshold, inputs.imu_sd_m_s, rng)
            by = f"{low:g} m/s" if low == high else f"{low:g} to {high:g} m/s"
            yield Measure(
                f"one of {2 * tracks} tracks wrong by {by}: a right velocity or none",
                share.right + share.refused,
                "",
                HARMLESS,
                f"{how}; {100.0 * share.right:.2f} % right, {100.0 * share.refused:.2f} % refused",
                "at least",
            )


def estimators(quick: bool) -> Iterator[Measure]:
    descents = recorded("dimes-smoke", 4 if quick else 48)
    for name, estimator in ESTIMATORS.items():
        found = tried(estimator, descents)
        valid = found.valid
        rms = float(np.sqrt(np.mean(valid**2))) if valid.size else float("nan")
        wrong = int(np.sum(valid > REQUIREMENT_M_S))
        how = (
            f"{valid.size} of {len(descents)} descents of dimes-smoke answered, {wrong} wrong by more than 5 m/s, "
            f"largest error {valid.max() if valid.size else float('nan'):.2g} m/s, "
            f"{1e3 * float(np.median(found.seconds)):.0f} core-ms a triple"
        )
        yield Measure(f"velocity error, rms: {name}", rms, "m/s", None, how)


CHECKS = (
    Check("imu-check", "DIMES", imu_check),
    Check("estimators", "DIMES", estimators),
)
