"""Tests of the validation checks: they fail for lost cases and a wrong threshold, and their limits are not too wide."""

import json
import math
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.localisation import STAGES
from benchmarks.stages import DESCENT_STAGES
from benchmarks.threshold_derivation import ThresholdInputs, draw_correct_track_errors
from benchmarks.validation import dimes_checks, document, landing_checks, tracking_checks
from benchmarks.validation.__main__ import CHECKS
from benchmarks.validation.document import RESULTS
from benchmarks.validation.imu_reference import VelocityErrors
from benchmarks.validation.records import Measure
from marsyard.reports.validation_rows import VALIDATION_FILE, RowKind
from marsyard.scenarios.localisation.sites import localisation_sites
from marsyard.scenarios.systems import systems
from marsyard.sim.sensor.presets import PRESETS
from marsyard.sim.terrain import sites

NAN = float("nan")
#: Reasons for limits of more than four times the measured value, by the beginning of the claim.
REASONS_FOR_WIDE_LIMITS = {
    "discrepancy of correct tracks": "three standard errors of a quantile",
    "stereo range error": "the ratio of 55 pairs has a standard error of 10 %",
    "false PASS": "the guaranteed error rate",
    "false FAIL": "the guaranteed error rate",
    "rare violations, false": "the guaranteed error rate",
    "change to FAIL": "the guaranteed accuracy; the standard deviation of the estimate is 2 to 3 %",
    "nights with a false alarm": "the guaranteed rate",
    "kurtosis_8, descent over meridiani divided by gusev": "a factor of two in both directions",
    "second peak divided by first peak: minimum": "rendered images must cover the range of flight images",
    "bias of motion, rock at": "a mean over the patches of one rock can be near 0 by chance",
    "refused templates": "the 95 % confidence interval of 1 in 4 templates of flight images",
}


def read_measures() -> list[Measure]:
    """Read the stored measured values and limits of all checks."""
    checks = json.loads(RESULTS.read_text())["checks"]
    return [Measure(**row) for check in checks.values() for row in check["measures"]]


def failed_claims(measures: list[Measure]) -> list[str]:
    return [measure.claim for measure in measures if not measure.passed]


def _check_drift_with_lost_targets(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """Run the check with every second target lost and a drift of 0.1 px of the others."""
    row = {"selectable": True, "sun_motion_deg": 5.0}
    monkeypatch.setattr(
        tracking_checks, "simulate_run", lambda number, camera: row | {"drift_px": NAN if number % 2 else 0.1}
    )
    return list(tracking_checks.check_drift(quick=False))


def _check_stereo_with_lost_targets(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """Run the check with every second target lost and the errors of Eq. 1 of the tracking paper for the others."""
    monkeypatch.setattr(
        tracking_checks, "_simulate_designation", lambda number, camera: (NAN if number % 2 else 0.1, 0.1)
    )
    return list(tracking_checks.check_stereo(quick=False))


def _check_landing_with_a_failed_pair(monkeypatch: pytest.MonkeyPatch) -> list[Measure]:
    """Run the check with a failed motion estimate of one image pair and exact estimates of the others."""

    def errors(number: int) -> dict[str, dict[str, Any]]:
        value = NAN if number == 3 else 0.0
        row = {"site": landing_checks.SITES[number % 2], "range_m": 10.0, "tracks": 200.0, "elevation_rms_m": value}
        row |= {"rotation_error_deg": value, "baseline_error_fraction": value}
        return {"paper": row, "many features": row}

    monkeypatch.setattr(landing_checks, "simulate_errors", errors)
    return list(landing_checks.check_accuracy(quick=False))


@pytest.mark.parametrize(
    "run_check", [_check_drift_with_lost_targets, _check_stereo_with_lost_targets, _check_landing_with_a_failed_pair]
)
def test_checks_with_lost_cases_fail(
    run_check: Callable[[pytest.MonkeyPatch], list[Measure]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert failed_claims(run_check(monkeypatch))


def test_limits_are_close_to_the_measured_values() -> None:
    wide_limits = [
        (row.claim, row.measured, row.limit)
        for row in read_measures()
        if row.limit is not None and row.sense == "at most" and row.measured > 1e-12
        and row.limit > 4.0 * row.measured and not row.claim.startswith(tuple(REASONS_FOR_WIDE_LIMITS))
    ]  # fmt: skip
    assert wide_limits == []


def test_unmet_requirements_keep_their_original_limit() -> None:
    rows = {row.claim: row for row in read_measures()}
    # the nightly check must detect 95 % of the regressions; this rate has no unit
    limit_by_unit = {"deg": landing_checks.ROTATION_LIMIT_DEG, "": 0.95}
    for claim_start in ("rotation error with the paper's features", "nights that detect a regression"):
        claim_rows = [row for claim, row in rows.items() if claim.startswith(claim_start)]
        assert claim_rows
        assert all(row.limit == limit_by_unit[row.unit] for row in claim_rows)


def test_wrong_threshold_derivation_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    # Halved errors of correct tracks, in the derivation only, give half the threshold. A check that reuses the
    # derivation would not detect this.
    def halve_errors(inputs: ThresholdInputs, rng: np.random.Generator) -> np.ndarray:
        return 0.5 * draw_correct_track_errors(inputs, rng)

    monkeypatch.setattr(dimes_checks, "draw_correct_track_errors", halve_errors, raising=False)
    # half of the threshold of 3.5 m/s, rounded up to 0.1 m/s
    options = dimes_checks.DimesOptions(imu_threshold_m_s=1.8)
    monkeypatch.setattr(dimes_checks, "DimesOptions", lambda: options)
    claims = failed_claims(list(dimes_checks.check_imu_threshold(quick=True)))
    assert "discrepancy of correct tracks: 99.5 % quantile against the threshold" in claims
    assert "descents with one correct track per pair that pass the IMU check" in claims


def test_matching_is_the_only_error_of_a_reference_with_exact_instruments() -> None:
    inputs = ThresholdInputs(
        common_altitude_sd=0.0,
        altitude_sd=0.0,
        common_attitude_sd_deg=0.0,
        attitude_sd_deg=0.0,
        feature_height_sd_m=0.0,
    )
    errors = VelocityErrors.draw(inputs, 300, np.random.default_rng(1))
    np.testing.assert_allclose(errors.tracks_m_s.std(), inputs.match_sd_m_s, rtol=0.1)
    # The discrepancy of two tracks and the IMU has a Rayleigh distribution with the median sd sqrt(2 ln 2).
    sd = math.sqrt(2.0 * inputs.match_sd_m_s**2 + inputs.imu_sd_m_s**2)
    assert np.median(errors.one_track_discrepancies_m_s()) == pytest.approx(
        sd * math.sqrt(2.0 * math.log(2.0)), rel=0.15
    )


def test_profiled_stages_name_existing_functions() -> None:
    root = Path(__file__).parents[2]
    for file, function in {pair for stages in (STAGES, DESCENT_STAGES) for pairs in stages.values() for pair in pairs}:
        # folders sim, scenarios, algorithms and campaigns
        paths = [path for path in root.glob("[sac]*/**/*.py") if path.as_posix().endswith(f"/{file}")]
        if file == "render/arrays.py":
            # a profiler sees compiled functions in the file of their decorator
            paths = list(root.glob("sim/render/*.py"))
        texts = [path.read_text() for path in paths]
        assert any(f"def {function}(" in text for text in texts), (file, function)


def test_packaged_rows_and_page_are_those_of_the_stored_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published = VALIDATION_FILE.read_bytes(), document.DOCUMENT.read_bytes()
    monkeypatch.setattr(document, "VALIDATION_FILE", tmp_path / "validation.json")
    monkeypatch.setattr(document, "DOCUMENT", tmp_path / "validation.md")
    document.write_pages(CHECKS, document.read_stored())
    written = (tmp_path / "validation.json").read_bytes(), (tmp_path / "validation.md").read_bytes()
    assert written == published


def test_rows_on_images_have_the_conditions_of_their_check() -> None:
    sections = {"Motion of images", "Light", "Independent renderer", "Images from Mars", "Tracking", "Landing"}
    # flat ground, points near bodies, and cameras that are no preset
    without_site = ("reflectance", "sky", "opposition")
    without = [
        row.claim
        for name, check in document.create_rows(CHECKS, document.read_stored()).items()
        for row in check.rows
        if check.section in sections and name not in without_site and not row.conditions.quantities
    ]
    assert without == []


def test_conditions_name_systems_sites_and_presets_that_exist() -> None:
    rows = [row for check in document.create_rows(CHECKS, document.read_stored()).values() for row in check.rows]
    conditions = [row.conditions for row in rows]
    assert {name for item in conditions for name in item.systems or ()} <= {system.name for system in systems()}
    assert {name for item in conditions for name in item.camera or ()} <= {*PRESETS, "lander vision camera"}
    assert {name for item in conditions for name in item.site or ()} - {*sites(), *localisation_sites()} == {
        "HiRISE tile in Gale"
    }


def test_every_pattern_of_conditions_matches_a_row() -> None:
    stored = document.read_stored()
    unmatched = [
        (check.name, item.rows)
        for check in CHECKS
        if check.name in stored
        for item in check.conditions
        if not any(fnmatchcase(row["claim"], item.rows) for row in stored[check.name]["measures"])
    ]
    assert unmatched == []


@pytest.mark.parametrize(
    ("data", "kind"),
    [("", RowKind.VERIFICATION), ("spirit-descent", RowKind.FIT), ("dimes-templates", RowKind.VALIDATION)],
)
def test_kind_follows_from_the_register(data: str, kind: RowKind) -> None:
    assert document.kind_of(data) is kind
