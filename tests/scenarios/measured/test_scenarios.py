"""Tests of scenarios with ingested images: answers equal those of the original measurements; pose errors are seen."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.landing import MeasuredLandingScenario
from marsyard.scenarios.measured.matching import MatchingScenario
from marsyard.scenarios.measured.velocity import MeasuredVelocityScenario
from marsyard.scenarios.parts import ScoredSite, ScoredVelocity
from marsyard.sim.streams import Streams
from tests.scenarios.measured.folders import read_rows, write_landing_folder, write_text_rows, write_velocity_folder

STREAMS = Streams(seed=1, campaign="measured", case=0)
TRUE_VELOCITY_M_S = inputs.DESCENT_VELOCITY_M_S[:2]


def run_ingested(folder: Path, out: Path, **parameters: object) -> CaseResult:
    """Ingest a folder, and run its first case in the scenario of its task."""
    out.mkdir()
    path, stored_cases = ingest(folder, out)
    scenarios = (MatchingScenario(), MeasuredLandingScenario(), MeasuredVelocityScenario())
    scenario = next(entry for entry in scenarios if entry.name == f"measured-{stored_cases.task}")
    return scenario.run(scenario.parameters_type.model_validate({"cases": {"file": str(path)}, **parameters}), STREAMS)


def score_descent(case: ScoredVelocity) -> dict[str, float | bool]:
    """Custom score of a descent: the velocity error if the true velocity is known."""
    true_velocity, estimated_velocity = case.true_velocity_m_s, case.answer.velocity_m_s
    if true_velocity is None or estimated_velocity is None:
        return {"error_m_s": float("nan"), "known": False}
    return {"error_m_s": float(np.hypot(*(estimated_velocity - true_velocity))), "known": True}


def score_site(case: ScoredSite) -> dict[str, float]:
    """Custom score of a landing flight: the true distance between the two images if it is known."""
    if case.true_poses is None:
        return {"distance_m": np.nan}
    first, second = case.true_poses
    return {"distance_m": float(np.linalg.norm(second.translation - first.translation))}


@pytest.mark.parametrize("ned", [False, True])
def test_ingested_descents_equal_the_measurements(tmp_path: Path, ned: bool) -> None:
    measurements = inputs.descent()
    expected = DimesEstimator().estimate(measurements)
    assert expected.velocity_m_s is not None
    folder = write_velocity_folder(tmp_path / "in", {"drop": measurements}, {"drop": TRUE_VELOCITY_M_S}, ned=ned)
    result = run_ingested(
        folder, tmp_path / "out", compared=["phase-correlation"], scores=[f"{__name__}:score_descent"]
    )
    row: dict[str, Any] = dict(result.row)
    estimate = [row["velocity_estimated_x_m_s"], row["velocity_estimated_y_m_s"]]
    # Tolerance: rounding of the rotation to the folder's axes and back.
    assert np.allclose(estimate, expected.velocity_m_s, rtol=0.0, atol=1e-6)
    assert np.isclose(row["velocity_error_m_s"], np.hypot(*(expected.velocity_m_s - TRUE_VELOCITY_M_S)), atol=1e-6)
    assert np.isclose(
        row["inertial_difference_m_s"], np.hypot(*(expected.velocity_m_s - TRUE_VELOCITY_M_S - [9.0, -4.0])), atol=1e-6
    )
    assert row["pair_discrepancy_m_s"] < 1.0
    columns = [f"phase_correlation.velocity_estimated_{axis}_m_s" for axis in "xy"]
    compared_estimate = np.array([row[name] for name in columns], dtype=np.float64)
    assert np.isclose(row["phase_correlation.difference_m_s"], np.linalg.norm(compared_estimate - estimate))
    # The residuals use the estimate, not the inertial velocities, whose error of (9, -4) m/s is 37 m between images.
    assert row["residual_median_px"] < 1.5
    assert row["matches"] == row["phase_correlation.matches"]
    for label in ("", "phase_correlation."):
        assert row[f"{label}score_descent_error_m_s"] == row[f"{label}velocity_error_m_s"]
    assert result.outcome == "VALID"
    assert row["measured_case"] == "drop"


def test_missing_truth_gives_no_error_column(tmp_path: Path) -> None:
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    row: dict[str, Any] = dict(run_ingested(folder, tmp_path / "out", scores=[f"{__name__}:score_descent"]).row)
    assert row["score_descent_known"] is False
    assert np.isnan(row.pop("score_descent_error_m_s"))
    assert not [name for name in row if "error_" in name or "true_" in name]
    assert row["truth_known"] is False


def test_positions_replace_inertial_velocities_and_truth(tmp_path: Path) -> None:
    """The images are 3.75 s apart."""
    folder = write_velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    rows = read_rows(folder)
    for number, table_row in enumerate(rows):
        for axis in "xyz":
            table_row.pop(f"v{axis}_m_s")
        position = 3.75 * number * inputs.DESCENT_VELOCITY_M_S
        table_row |= {f"{axis}_m": str(value) for axis, value in zip("xyz", position, strict=True)}
        table_row |= {f"true_{axis}_m": str(value) for axis, value in zip("xyz", position, strict=True)}
    write_text_rows(folder, rows)
    row: dict[str, Any] = dict(run_ingested(folder, tmp_path / "out").row)
    assert np.isclose(row["velocity_true_x_m_s"], TRUE_VELOCITY_M_S[0])
    assert np.isclose(row["inertial_difference_m_s"], row["velocity_error_m_s"])
    # The poses are exact: the residual is the matching error of noisy images with rows summed by four.
    assert row["residual_median_px"] < 1.0
    assert row["matches"] > 100


def test_lever_arm_is_applied_to_velocities(tmp_path: Path) -> None:
    """The camera is 40 m from the recorded vehicle, whose attitude changes from image to image."""
    measurements, lever_m = inputs.descent(), np.array([40.0, 0.0, 0.0])
    folder = write_velocity_folder(tmp_path / "in", {"drop": measurements}, {"drop": TRUE_VELOCITY_M_S})
    text = (folder / "ingest.toml").read_text()
    (folder / "ingest.toml").write_text(text.replace("[poses]", f"[poses]\nlever_m = {lever_m.tolist()}"))
    (tmp_path / "out").mkdir()
    _, stored_cases = ingest(folder, tmp_path / "out")
    case = stored_cases.cases[0]
    arms = np.array([image.attitude.apply(lever_m) for image in case.images])
    times = np.array([image.time_s for image in case.images])
    lever_m_s = np.diff(arms, axis=0) / np.diff(times)[:, None]
    assert np.abs(lever_m_s).max() > 0.1
    expected = measurements.interval_velocities_m_s + lever_m_s
    assert case.interval_velocities_m_s is not None
    assert case.truth.velocity_m_s is not None
    assert np.allclose(case.interval_velocities_m_s, expected, rtol=0.0, atol=1e-9)
    assert np.allclose(case.truth.velocity_m_s, TRUE_VELOCITY_M_S + lever_m_s[1, :2], rtol=0.0, atol=1e-9)


def test_landings_are_compared_with_measured_and_true_poses(tmp_path: Path) -> None:
    folder = write_landing_folder(tmp_path / "in", inputs.landing(), "landing", true_poses=True)
    row: dict[str, Any] = dict(run_ingested(folder, tmp_path / "out", scores=[f"{__name__}:score_site"]).row)
    assert row["site_reported"]
    assert row["rotation_error_deg"] == row["rotation_pose_difference_deg"]
    assert row["rotation_error_deg"] < 0.5
    assert row["residual_median_px"] < 0.5
    assert np.isclose(row["max_translation_m"], np.linalg.norm([1.2, 0.2, -0.2]))
    assert np.isclose(row["score_site_distance_m"], row["max_translation_m"])


@pytest.mark.parametrize(("error_deg", "min_px", "max_px"), [(0.0, 0.0, 0.5), (0.5, 3.0, 12.0)])
def test_attitude_errors_are_detected(tmp_path: Path, error_deg: float, min_px: float, max_px: float) -> None:
    """A rotation about the direction of motion moves each match away from its epipolar line."""
    folder = write_landing_folder(tmp_path / "in", inputs.landing(), "matching")
    rows = read_rows(folder)
    error_rotation = Rotation.from_euler("x", error_deg, degrees=True)
    wrong_attitude = (error_rotation * Rotation.from_quat([float(rows[1][f"q{axis}"]) for axis in "xyzw"])).as_quat()
    rows[1] |= {f"q{axis}": repr(float(value)) for axis, value in zip("xyzw", wrong_attitude, strict=True)}
    write_text_rows(folder, rows)
    result = run_ingested(folder, tmp_path / "out")
    assert result.outcome == "MATCHED"
    assert min_px <= float(result.row["residual_median_px"]) <= max_px
    table = result.products["matches_1"]
    assert table.shape[1] == 7


def test_changed_image_is_rejected(tmp_path: Path) -> None:
    folder = write_landing_folder(tmp_path / "in", inputs.landing(), "matching")
    out = tmp_path / "out"
    run_ingested(folder, out)
    image_path = out / "images" / "000000-2.png"
    image_path.write_bytes(image_path.read_bytes() + b"\0")
    parameters = MatchingScenario.parameters_type.model_validate({"cases": {"file": str(out / "cases.json")}})
    with pytest.raises(ValueError, match=r"000000-2\.png: has changed since it was ingested"):
        MatchingScenario().run(parameters, STREAMS)
