"""Derive and store the threshold of DIMES' IMU check: ``python -m benchmarks.dimes_threshold``.

Writes `algorithms/dimes/imu_threshold.json`; a test compares it with the option's default. Takes about ten minutes.
"""

import json
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import benchmarks.threshold_derivation as derivation
from benchmarks.simulated_instruments import InstrumentErrors, simulate_instruments
from marsyard.algorithms.dimes import options
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.statistics.samples import quantile_bounds

STORED = Path(options.__file__).with_name("imu_threshold.json")
#: Version of the derivation; increase it if the result changes for the same inputs.
VERSION = 2
#: Campaign whose instruments are simulated, its overrides (few terrains, for a short run time) and number of descents.
CAMPAIGN, OVERRIDES, CASES = "dimes-gusev", ("parameters.location.bank=12",), 400
#: Stored quantiles of the discrepancy between tracks and IMU.
QUANTILES = (0.5, 0.9, 0.95, 0.99, 0.995, 0.999)
#: Minimum and maximum velocity error of the wrong track, m/s: a constant error, and errors up to the search range.
WRONG_TRACK_ERRORS_M_S = ((10.0, 10.0), (10.0, 60.0))


def derive_threshold(inputs: derivation.ThresholdInputs, instruments: InstrumentErrors) -> dict[str, Any]:
    """Derive the threshold, the distribution of discrepancies, and the outcomes of the check with one wrong track.

    `instruments` are the errors of the simulated instruments, from which the inputs are rounded; they are stored.
    """
    rng = np.random.default_rng(inputs.seed)
    errors = derivation.draw_correct_track_errors(inputs, rng)
    results = derivation.discrepancies(errors, inputs.imu_sd_m_s, rng)
    threshold = derivation.threshold_m_s(results.one_track, inputs.accepted_fraction, inputs.step_m_s)
    wrong_track_outcomes = []
    for tracks in (1, 2):
        for error_range_m_s in WRONG_TRACK_ERRORS_M_S:
            outcomes = derivation.simulate_wrong_track(
                errors[:, :, :tracks], error_range_m_s, threshold, inputs.imu_sd_m_s, rng
            )
            fractions = {"correct": outcomes.correct, "rejected": outcomes.rejected, "wrong": outcomes.wrong}
            wrong_track_outcomes.append(
                {"tracks_per_pair": tracks, "track_error_range_m_s": error_range_m_s, **fractions}
            )
    return {
        "derivation": "benchmarks.threshold_derivation",
        "derivation_version": VERSION,
        "versions": {name: version(name) for name in ("marsyard", "numpy", "scipy")},
        "instruments": {"campaign": CAMPAIGN, "overrides": OVERRIDES, "descents": CASES, **asdict(instruments)},
        "inputs": asdict(inputs),
        "track_error_rms_m_s": float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))),
        "discrepancy_quantiles_m_s": {
            "one correct track in each pair": _quantiles(results.one_track),
            "best combination of two correct tracks in each pair": _quantiles(results.two_tracks),
        },
        "accepted_fractions": {
            "one correct track in each pair": float(np.mean(results.one_track < threshold)),
            "best combination of two correct tracks in each pair": float(np.mean(results.two_tracks < threshold)),
        },
        "accepted_quantile_m_s": float(np.quantile(results.one_track, inputs.accepted_fraction)),
        # one-sided bounds at 95 % each
        "accepted_quantile_90_percent_bounds_m_s": quantile_bounds(results.one_track, inputs.accepted_fraction, 0.95),
        "threshold_m_s": threshold,
        "one_wrong_track": wrong_track_outcomes,
    }


def _quantiles(values: np.ndarray) -> dict[str, float]:
    """Return the values' `QUANTILES`, by their probability."""
    return {str(quantile): float(np.quantile(values, quantile)) for quantile in QUANTILES}


def main() -> None:
    """Derive, store and print the threshold."""
    instruments = simulate_instruments(load_campaign(CAMPAIGN, list(OVERRIDES)), CASES)
    record = derive_threshold(derivation.ThresholdInputs(), instruments)
    STORED.write_text(json.dumps(record, indent=1) + "\n")
    print(json.dumps(record, indent=1))
    print(f"stored in {STORED}; the option's default is {DimesOptions().imu_threshold_m_s} m/s")


if __name__ == "__main__":
    main()
