"""Tests of offline position estimators, which read exported descents and write tables (CSV) of their answers.

A table is scored like the estimator that wrote it.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.exchange import ExecutableLimits
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.export_scoring import (
    create_scoring_campaign,
    export_campaign,
    find_cases_with_changed_images,
)
from marsyard.campaigns.running.replay import differing_columns
from marsyard.scenarios.input_copies import hash_inputs
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.localisation.offline_files import POSITION_FORMAT, read_descent
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.localisation.task import LOCALISATION
from marsyard.scenarios.offline_algorithms import read_answers
from marsyard.scenarios.streamed import StreamedEstimator
from marsyard.sim.streams import Streams
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows
from tests.scenarios.localisation.test_scenario import COARSE, SMALL

CAMPAIGN = """
name = "loc-tables"
scenario = "localisation"
cases = 1
seed = 3
[parameters]
algorithm = "inertial"
"""
#: Overrides for a short descent with small images and a small map.
OVERRIDES = [
    f"{table}.{key}={value}"
    for table, values in {**SMALL, **COARSE}.items()
    if isinstance(values, dict)
    for key, value in values.items()
]
HEADER = ",".join(POSITION_FORMAT.columns)


@cache
def simulate() -> LocalisationMeasurements:
    parameters = LocalisationScenarioParameters.model_validate({**SMALL, **COARSE})
    return LocalisedDescent.simulate(parameters, Streams(1, "loc tables", 0)).measurements


def write_line(case: int, estimate: PositionEstimate) -> str:
    """Format an answer as a line of the table; the columns are in the order of the documentation."""
    cells: list[Any] = [case, estimate.outcome.name, float(estimate.time_s)]
    if estimate.covariance is None or estimate.world_from_body is None:
        # empty cells of position, velocity, quaternion and covariance
        return ",".join(map(str, cells)) + "," * (3 + 3 + 4 + 45)
    for values in (estimate.position_m, estimate.velocity_m_s, estimate.world_from_body.as_quat()):
        cells += np.asarray(values).tolist()
    cells += [float(estimate.covariance[row, column]) for row in range(9) for column in range(row, 9)]
    return ",".join(map(repr, cells)).replace("'", "")


def write_table(path: Path, lines: Sequence[str]) -> Path:
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


def estimate_descent(measurements: LocalisationMeasurements) -> tuple[PositionEstimate, ...]:
    """Run inertial navigation, and refuse to answer the first image."""
    answers = StreamedEstimator(InertialEstimator()).estimate(measurements).estimates
    return (PositionEstimate(PositionOutcome.NO_COARSE_FIX, answers[0].time_s), *answers[1:])


class RefusingOnceEstimator(InertialEstimator):
    """Inertial navigation that refuses to answer the first image."""

    def start(self, *inputs: Any) -> None:
        """Start a new descent."""
        super().start(*inputs)
        self._has_refused = False

    def process_image(self, image: Any) -> PositionEstimate:
        """Refuse to answer the first image."""
        answer = super().process_image(image)
        if self._has_refused:
            return answer
        self._has_refused = True
        return PositionEstimate(PositionOutcome.NO_COARSE_FIX, answer.time_s)


def test_table_columns() -> None:
    assert POSITION_FORMAT.columns[:7] == (
        *("case", "outcome", "time_s"),
        *("position_east_m", "position_north_m", "position_up_m", "velocity_east_m_s"),
    )
    assert POSITION_FORMAT.columns[9:15] == (
        *("world_from_body_x", "world_from_body_y", "world_from_body_z", "world_from_body_w"),
        *("covariance_0_0", "covariance_0_1"),
    )
    # case, outcome and time; position; velocity; quaternion; upper triangle of the 9 x 9 covariance
    assert len(POSITION_FORMAT.columns) == 3 + 3 + 3 + 4 + 45
    assert POSITION_FORMAT.columns[-1] == "covariance_8_8"


def test_exported_descent_equals_the_measurements(tmp_path: Path) -> None:
    measurements = simulate()
    exporter: Any = LOCALISATION.make(f"export:{tmp_path}", LvsOptions(), ExecutableLimits(), 12)
    answers = exporter.estimate(measurements)
    assert {estimate.outcome for estimate in measurements.check(answers).estimates} == {PositionOutcome.NO_COARSE_FIX}
    folder = tmp_path / "cases" / "000012"
    exported = read_descent(folder)
    for name in ("map_product", "increments", "altitudes"):
        assert hash_inputs(getattr(exported, name)) == hash_inputs(getattr(measurements, name)), name
    for image, original in zip(exported.images, measurements.images, strict=True):
        assert image.time_s == original.time_s
        np.testing.assert_array_equal(image.counts, original.counts)
        np.testing.assert_array_equal(image.calibration.flat_field, original.calibration.flat_field)
        # coordinates of a camera file have 9 decimals
        pixels = np.array([[0.0, 0.0], [31.5, 10.0]])
        np.testing.assert_allclose(image.camera.rays(pixels)[1], original.camera.rays(pixels)[1], atol=1e-8)
    np.testing.assert_array_equal(exported.initial.position_m, measurements.initial.position_m)
    np.testing.assert_array_equal(exported.initial.covariance, measurements.initial.covariance)
    rotation_error = exported.initial.world_from_body * measurements.initial.world_from_body.inv()
    assert rotation_error.magnitude() < 1e-12
    assert [type(event) for event in exported.events()] == [type(event) for event in measurements.events()]
    # no other files: the export does not contain the truth
    assert {path.name for path in folder.iterdir() if path.suffix not in (".png", ".cahvor")} == {
        *("case.json", "map.json", "appearance.f32", "elevation.f32", "flat_field_1.f64")
    }


def test_table_answers_every_image(tmp_path: Path) -> None:
    measurements = simulate()
    expected = estimate_descent(measurements)
    path = write_table(tmp_path / "answers.csv", [write_line(5, estimate) for estimate in expected])
    table: Any = LOCALISATION.make(f"answers:{path}", LvsOptions(), ExecutableLimits(), 5)
    answers = table.estimate(measurements)
    assert len(answers.estimates) == len(measurements.images) + 1
    for answer, estimate in zip(answers.estimates, expected, strict=True):
        assert (answer.outcome, answer.time_s) == (estimate.outcome, estimate.time_s)
        for name in ("position_m", "velocity_m_s", "covariance"):
            np.testing.assert_array_equal(getattr(answer, name), getattr(estimate, name), err_msg=name)
    assert isinstance(answers.estimates[1].world_from_body, Rotation)
    assert (answers.estimates[1].world_from_body * expected[1].world_from_body.inv()).magnitude() < 1e-12


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["0,NO_COARSE_FIX,{empty}"], r"line 2: time_s is missing"),
        (["0,VALID,1.0{empty}"], r"line 2: outcome is VALID, but position_m is missing"),
        (["0,CRASHED,1.0{empty}"], r"outcome is 'CRASHED'; allowed: VALID, NO_COARSE_FIX"),
        (["0,UNCERTAIN,2.0{empty}", "0,UNCERTAIN,1.0{empty}"], r"case 0: time_s is 1 after 2; allowed: the order of"),
        (["0,VALID,1.0,1,2,3{short}"], r"outcome is VALID, but velocity_m_s is missing"),
        (["0,VALID,1.0,1,2,3,4,5,6,0,0,0,2{identity}"], r"world_from_body_xyzw is .*allowed: a unit quaternion"),
        (["0,VALID,1.0,1,2,3,4,5,6,0,0,0,1{zeros}"], r"covariance is not positive"),
        (["0,UNCERTAIN,1.0,1,2,3,4,5,6,0,0,0,1{identity}"], r"outcome is UNCERTAIN, but position_m is given"),
        (["0,VALID,1.0,1,2,3,4000,5,6,0,0,0,1{identity}"], r"velocity_east_m_s is 4000, beyond 1000"),
    ],
)
def test_invalid_lines_are_rejected(tmp_path: Path, lines: list[str], message: str) -> None:
    """The names in braces stand for cells: 55 or 52 empty ones, or the covariance (identity matrix or zeros)."""
    identity = "".join(f",{float(row == column)}" for row in range(9) for column in range(row, 9))
    parts = {"empty": "," * 55, "short": "," * 52, "identity": identity, "zeros": ",0" * 45}
    path = write_table(tmp_path / "answers.csv", [line.format(**parts) for line in lines])
    with pytest.raises(ValueError, match=message):
        read_answers(path, POSITION_FORMAT)


@pytest.mark.slow
def test_export_and_score_equal_a_normal_run(tmp_path: Path) -> None:
    file = tmp_path / "loc.toml"
    file.write_text(CAMPAIGN)
    folder, truth = tmp_path / "out", tmp_path / "truth"
    overrides = [*OVERRIDES, "retain.showcase=none", "retain.products=none"]
    watch = RecordingWatch()
    export = load_campaign(str(file), overrides, None, None, [f"export:{folder}"])
    export_campaign(export, folder, truth, ExecutorConfig(1), watch)
    estimates = estimate_descent(read_descent(folder / "cases" / "000000"))
    readme = (folder / "README.md").read_text()
    assert "then the lines of each case in order:" in readme
    assert "one line for each image" in readme

    answers = write_table(tmp_path / "answers.csv", [write_line(0, estimate) for estimate in estimates])
    run_campaign(create_scoring_campaign(folder, truth, answers), tmp_path / "scored", ExecutorConfig(1), watch)
    path = "tests.scenarios.localisation.test_position_answers:RefusingOnceEstimator"
    run_campaign(load_campaign(str(file), overrides, None, None, [path]), tmp_path / "run", ExecutorConfig(1), watch)
    assert find_cases_with_changed_images(truth, tmp_path / "scored") == []
    (scored,), (normal,) = read_case_rows(tmp_path / "scored"), read_case_rows(tmp_path / "run")
    assert (scored["outcome"], scored["valid_images"]) == ("VALID", 3)
    assert scored["algorithm"] == "answers"
    assert {"position_error_m", "position_nees", "attitude_error_deg", "fix_after_s", "image_hash"} <= set(normal)
    # quaternions are normalised when they are read, which changes their last digits
    changed = set(differing_columns(scored, normal))
    assert changed <= {"algorithm", "attitude_error_deg"}
    assert scored["attitude_error_deg"] == pytest.approx(normal["attitude_error_deg"], rel=1e-9)

    missing = write_table(tmp_path / "missing.csv", [write_line(0, estimate) for estimate in estimates[1:]])
    run_campaign(create_scoring_campaign(folder, truth, missing), tmp_path / "bad", ExecutorConfig(1), watch)
    (bad,) = read_case_rows(tmp_path / "bad")
    assert bad["outcome"] == "BAD_ANSWER"
    assert "4 answers are given to this case; allowed: 5, one for each of its 4 images" in bad["error"]
