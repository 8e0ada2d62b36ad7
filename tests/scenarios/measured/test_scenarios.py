"""Ingested cases give the answers of the measurements that they were laid out from, and know right poses from wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.scenarios import MatchingScenario, MeasuredLandingScenario, MeasuredVelocityScenario
from marsyard.scenarios.parts import ScoredSite, ScoredVelocity
from marsyard.sim.streams import Streams
from tests.scenarios.measured.folders import landing_folder, read_rows, velocity_folder, write_texts

STREAMS = Streams(seed=1, campaign="measured", case=0)
TRUE = inputs.DESCENT_VELOCITY_M_S[:2]


def ran(folder: Path, out: Path, **parameters: object) -> CaseResult:
    out.mkdir()
    path, stored = ingest(folder, out)
    scenarios = {one.name: one for one in (MatchingScenario(), MeasuredLandingScenario(), MeasuredVelocityScenario())}
    scenario = scenarios[f"measured-{stored.task}"]
    return scenario.run(scenario.parameters_type.model_validate({"cases": {"file": str(path)}, **parameters}), STREAMS)


def descent_score(case: ScoredVelocity) -> dict[str, float | bool]:
    """A user's own score of a descent: its error where the truth is known."""
    true, estimated = case.true_velocity_m_s, case.answer.velocity_m_s
    if true is None or estimated is None:
        return {"error_m_s": float("nan"), "known": False}
    return {"error_m_s": float(np.hypot(*(estimated - true))), "known": True}


def site_score(case: ScoredSite) -> dict[str, float]:
    """A user's own score of a flight for a site: the true distance between the pictures, where it is known."""
    if case.true_poses is None:
        return {"moved_m": np.nan}
    first, second = case.true_poses
    return {"moved_m": float(np.linalg.norm(second.translation - first.translation))}


@pytest.mark.parametrize("ned", [False, True])
def test_descents_come_through_as_they_were_measured(tmp_path: Path, ned: bool) -> None:
    given = inputs.descent()
    expected = DimesEstimator().estimate(given)
    assert expected.velocity_m_s is not None
    folder = velocity_folder(tmp_path / "in", {"drop": given}, {"drop": TRUE}, ned=ned)
    result = ran(folder, tmp_path / "out", compared=["phase-correlation"], scores=[f"{__name__}:descent_score"])
    row: dict[str, Any] = dict(result.row)
    found = [row["velocity_estimated_x_m_s"], row["velocity_estimated_y_m_s"]]
    # what turns in rounding: the axes there and back
    assert np.allclose(found, expected.velocity_m_s, rtol=0.0, atol=1e-6)
    assert np.isclose(row["velocity_error_m_s"], np.hypot(*(expected.velocity_m_s - TRUE)), atol=1e-6)
    assert np.isclose(
        row["inertial_difference_m_s"], np.hypot(*(expected.velocity_m_s - TRUE - [9.0, -4.0])), atol=1e-6
    )
    assert row["pair_discrepancy_m_s"] < 1.0
    other = np.array([row[f"phase_correlation.velocity_estimated_{axis}_m_s"] for axis in "xy"], dtype=np.float64)
    assert np.isclose(row["phase_correlation.difference_m_s"], np.linalg.norm(other - found))
    # the answer takes the constant error of (9, -4) m/s, 34 m between pictures, out of the inertial velocities
    assert row["residual_median_px"] < 1.5
    assert row["matches"] == row["phase_correlation.matches"]
    for label in ("", "phase_correlation."):
        assert row[f"{label}descent_score_error_m_s"] == row[f"{label}velocity_error_m_s"]
    assert result.outcome == "VALID"
    assert row["measured_case"] == "drop"


def test_without_truth_no_error_is_reported(tmp_path: Path) -> None:
    folder = velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    row: dict[str, Any] = dict(ran(folder, tmp_path / "out", scores=[f"{__name__}:descent_score"]).row)
    assert row["descent_score_known"] is False
    assert np.isnan(row.pop("descent_score_error_m_s"))
    assert not [name for name in row if "error_" in name or "true_" in name]
    assert row["truth_known"] is False


def test_positions_stand_in_for_inertial_velocities_and_for_truth(tmp_path: Path) -> None:
    folder = velocity_folder(tmp_path / "in", {"drop": inputs.descent()}, {})
    rows = read_rows(folder)
    for number, written in enumerate(rows):
        for axis in "xyz":
            written.pop(f"v{axis}_m_s")
        place = 3.75 * number * inputs.DESCENT_VELOCITY_M_S
        written |= {f"{axis}_m": str(value) for axis, value in zip("xyz", place, strict=True)}
        written |= {f"true_{axis}_m": str(value) for axis, value in zip("xyz", place, strict=True)}
    write_texts(folder, rows)
    row: dict[str, Any] = dict(ran(folder, tmp_path / "out").row)
    assert np.isclose(row["velocity_true_x_m_s"], TRUE[0])
    assert np.isclose(row["inertial_difference_m_s"], row["velocity_error_m_s"])
    # the poses are exact: what is left is the matching of pictures with noise, rows summed by four
    assert row["residual_median_px"] < 1.0
    assert row["matches"] > 100


def test_landings_are_held_against_measured_and_true_poses(tmp_path: Path) -> None:
    folder = landing_folder(tmp_path / "in", inputs.landing(), "landing", true_poses=True)
    row: dict[str, Any] = dict(ran(folder, tmp_path / "out", scores=[f"{__name__}:site_score"]).row)
    assert row["site_reported"]
    assert row["rotation_error_deg"] == row["rotation_pose_difference_deg"]
    assert row["rotation_error_deg"] < 0.5
    assert row["residual_median_px"] < 0.5
    assert np.isclose(row["max_translation_m"], np.linalg.norm([1.2, 0.2, -0.2]))
    assert np.isclose(row["site_score_moved_m"], row["max_translation_m"])


@pytest.mark.parametrize(("turned_deg", "least", "most"), [(0.0, 0.0, 0.5), (0.5, 3.0, 12.0)])
def test_wrong_attitudes_show(tmp_path: Path, turned_deg: float, least: float, most: float) -> None:
    """An error about the direction of motion moves every match off its line by its angle in pixels."""
    folder = landing_folder(tmp_path / "in", inputs.landing(), "matching")
    rows = read_rows(folder)
    turn = Rotation.from_euler("x", turned_deg, degrees=True)
    wrong = (turn * Rotation.from_quat([float(rows[1][f"q{axis}"]) for axis in "xyzw"])).as_quat()
    rows[1] |= {f"q{axis}": repr(float(value)) for axis, value in zip("xyzw", wrong, strict=True)}
    write_texts(folder, rows)
    result = ran(folder, tmp_path / "out")
    assert result.outcome == "MATCHED"
    assert least <= float(result.row["residual_median_px"]) <= most
    table = result.products["matches_1"]
    assert table.shape[1] == 7


def test_a_picture_that_has_changed_is_not_run(tmp_path: Path) -> None:
    folder = landing_folder(tmp_path / "in", inputs.landing(), "matching")
    out = tmp_path / "out"
    ran(folder, out)
    picture = out / "pictures" / "000000-2.png"
    picture.write_bytes(picture.read_bytes() + b"\0")
    parameters = MatchingScenario.parameters_type.model_validate({"cases": {"file": str(out / "cases.json")}})
    with pytest.raises(ValueError, match=r"000000-2\.png: has changed since it was ingested"):
        MatchingScenario().run(parameters, STREAMS)
