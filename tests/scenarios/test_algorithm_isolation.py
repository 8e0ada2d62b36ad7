"""Tests of the isolation of algorithms: an algorithm cannot affect the inputs, process or row of another one."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.algorithms.answers import check_site, check_update, check_velocity
from marsyard.algorithms.interface import (
    SiteEstimate,
    SiteOutcome,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
    VelocityOutcome,
)
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.verdicts import Status
from marsyard.scenarios.conformance.inputs import descent
from marsyard.scenarios.input_copies import InputCopy
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.systems import scenario
from marsyard.scenarios.velocity import run_estimator
from marsyard.sim.streams import Streams
from tests.scenarios import spies

SPY = "tests.scenarios.spies"


@pytest.fixture(autouse=True)
def _clear_spies() -> Iterator[None]:
    yield
    spies.RECORDED_INPUTS.clear()
    spies.RECORDED_CASES.clear()


def run_small_case(name: str, algorithm: str, compared: tuple[str, ...] = (), case: int = 0) -> CaseResult:
    """Run a small case of a scenario; `compared` are the names of further algorithms of the spies module."""
    from tests.scenarios.descent.descents import DESCENT, SMALL_WORLD
    from tests.scenarios.rover.short_run import SHORT_RUN
    from tests.scenarios.test_fieldtest import make_parameters

    compared_paths = [f"{SPY}:{spy}" for spy in compared]
    # in this process, so that the spies record their inputs here
    algorithms: dict[str, Any] = {"algorithm": f"{SPY}:{algorithm}", "compared": compared_paths}
    algorithms["executable"] = {"isolated": False}
    circle = {"legs": [{"motion": "circle", "step_deg": 5.0, "steps": 1}]}
    parameters: dict[str, Any] = {
        "descent": {**SMALL_WORLD, "descent": DESCENT, **algorithms},
        # one run, only image triples of the category "short time"
        "fieldtest": {
            **make_parameters().model_dump(),
            "runs": [make_parameters().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}],
            **algorithms,
        },
        "landing": {"site": "heli-benign", "terrain": {"samples": 256}, **algorithms},
        "rover": {**SHORT_RUN, **algorithms},
        "rover-drive": {
            "drive": {**SHORT_RUN, **circle, **algorithms},
            "variants": [{"diameter_m": 0.8, "height_m": 0.5, "shape": 8, "yaw_deg": 30.0, "sun_azimuth_deg": 260.0}],
            "targets": [{"across": 0.0, "up": 0.5}],
        },
    }
    selected = scenario(name)
    return selected.run(selected.parameters_type.model_validate(parameters[name]), Streams(1, "handover", case))


def list_image_counts(inputs: Any) -> list[np.ndarray]:
    """Return the pixel counts of each image in the inputs of an algorithm."""
    images = inputs.images if hasattr(inputs, "images") else (inputs.left, inputs.right)
    return [image.counts for image in images]


@pytest.mark.parametrize(
    ("name", "writer", "spy"),
    [
        ("descent", "ForcedVelocityWriter", "VelocitySpy"),
        ("fieldtest", "ForcedVelocityWriter", "VelocitySpy"),
        ("landing", "ForcedSiteWriter", "SiteSpy"),
        ("rover-drive", "ForcedTrackerWriter", "TrackerSpy"),
    ],
)
def test_algorithm_cannot_change_the_measurements_of_other_algorithms(name: str, writer: str, spy: str) -> None:
    result = run_small_case(name, writer, (spy,))
    assert (result.outcome, result.answered) == ("BAD_ANSWER", False)
    assert "changed its measurements" in result.failure.error
    inputs = next(entry for entry in spies.RECORDED_INPUTS if not isinstance(entry, tuple))
    # The writer sets the counts of its own copy to zero.
    assert all(counts.mean() > 1.0 for counts in list_image_counts(inputs))
    assert result.row[f"{spy}.error"] == ""


def test_writing_to_an_image_is_an_algorithm_error() -> None:
    result = run_small_case("descent", "VelocityWriter", ("VelocitySpy",))
    assert result.outcome == "CRASHED"
    assert "read-only" in result.failure.error
    assert result.row["VelocitySpy.outcome"] == "NO_VALID_TRACK"


def test_input_copies_are_equal_and_independent() -> None:
    inputs = descent()
    first, second = InputCopy(inputs).inputs, InputCopy(inputs).inputs
    assert first.images[0].counts.tobytes() == inputs.images[0].counts.tobytes()
    assert first.attitudes[0].world_from_body.as_quat().tobytes() == (
        inputs.attitudes[0].world_from_body.as_quat().tobytes()
    )
    for entry in (inputs, second):
        assert not np.shares_memory(first.images[0].counts, entry.images[0].counts)
        assert not np.shares_memory(first.sun_direction, entry.sun_direction)
    assert not first.sun_direction.flags.writeable
    assert inputs.sun_direction.flags.writeable


class ZeroDifferenceArray(np.ndarray):
    """Array whose subtraction always returns zeros."""

    def __sub__(self, other: Any) -> Any:
        return np.zeros(self.shape)

    __rsub__ = __sub__


class ZeroDifferenceEstimator:
    """Returns a wrong velocity in an array whose difference to the truth is zero."""

    def estimate(self, _: object) -> VelocityEstimate:
        return VelocityEstimate(VelocityOutcome.VALID, np.array([400.0, 0.0]).view(ZeroDifferenceArray))


def test_answers_are_converted_to_numpy_arrays_and_floats() -> None:
    answer = run_estimator(ZeroDifferenceEstimator, descent()).answer
    assert type(answer.velocity_m_s) is np.ndarray
    assert (answer.velocity_m_s - np.array([1.0, 0.0])).tolist() == [399.0, 0.0]
    position, matrix = np.arange(3, dtype=np.float32).view(ZeroDifferenceArray), np.eye(2).view(ZeroDifferenceArray)
    velocity = VelocityEstimate(VelocityOutcome.VALID, np.zeros(2), None, matrix, (np.float64(0.0), 1.0))
    arrays = (
        check_velocity(velocity).covariance_m2_s2,
        check_site(SiteEstimate(SiteOutcome.SAFE_SITE, position)).site_world,
        check_update(TargetUpdate(TrackingState.NORMAL, (), position)).position_rover,
    )
    assert all(type(array) is np.ndarray and array.dtype == np.float64 for array in arrays)
    assert [type(entry) for entry in check_velocity(velocity).span_s or ()] == [float, float]


def test_runs_with_a_tracker_exception_count_as_failures() -> None:
    """The tracker raises an exception in 5 of 20 runs. Their rows have no column of the metric, `handed_off`."""
    crashed_case, complete_case = (run_small_case("rover", spy, case=4) for spy in ("RaisingTracker", "TrackerSpy"))
    assert crashed_case.outcome == "CRASHED"
    assert crashed_case.row["selectable"] is complete_case.row["selectable"] is True
    crashed_row, complete_row = (
        {"outcome": case.outcome, "answered": case.answered, **case.row, "handed_off": True}
        for case in (crashed_case, complete_case)
    )
    crashed_row.pop("handed_off")
    frame = pd.DataFrame([crashed_row] * 5 + [complete_row] * 15)
    requirement = {"id": "VTT-HANDED", "metric": "handed_off", "probability": 0.9, "confidence": 0.9}
    (result,) = evaluate_requirements(frame, [{**requirement, "population": "selectable", "decide_by": "estimate"}])
    assert (result.status, result.n, result.failures) == (Status.FAIL, 20, 5)


def test_row_of_a_rejected_answer_has_no_site_columns() -> None:
    """A verdict counts a case without these columns as a failure: a reported unsafe site."""
    row = run_small_case("landing", "ForcedSiteWriter").row
    assert not {"site_reported", "no_site_reported", "converged"} & row.keys()
