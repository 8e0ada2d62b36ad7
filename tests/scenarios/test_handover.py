"""Tests that an algorithm cannot affect the inputs, process or row of other algorithms."""

from __future__ import annotations

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
from marsyard.reports.verdicts import Status, evaluate_requirements
from marsyard.scenarios.algorithm_run import InputCopy
from marsyard.scenarios.conformance.inputs import descent
from marsyard.scenarios.interface import CaseResult, Scalar, conditions_recorded_by
from marsyard.scenarios.systems import scenario
from marsyard.scenarios.velocity import run_estimator
from marsyard.sim.streams import Streams
from tests.scenarios import spies

SPY = "tests.scenarios.spies"


@pytest.fixture(autouse=True)
def _clear_spies() -> Iterator[None]:
    yield
    spies.GIVEN.clear()
    spies.TRUE.clear()


def run_small_case(name: str, algorithm: str, compared: tuple[str, ...] = (), case: int = 0) -> CaseResult:
    """Run a small case of a scenario."""
    from tests.scenarios.descent.settings import DESCENT, WORLD
    from tests.scenarios.rover.short_run import SHORT
    from tests.scenarios.test_fieldtest import make_parameters

    chosen: dict[str, Any] = {"algorithm": f"{SPY}:{algorithm}", "compared": [f"{SPY}:{one}" for one in compared]}
    turn = {"legs": [{"motion": "circle", "step_deg": 5.0, "steps": 1}]}
    parameters: dict[str, Any] = {
        "descent": {**WORLD, "descent": DESCENT, **chosen},
        "fieldtest": {
            **make_parameters().model_dump(),
            "runs": [make_parameters().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}],
            **chosen,
        },
        "landing": {"site": "heli-benign", "terrain": {"samples": 256}, **chosen},
        "rover": {**SHORT, **chosen},
        "rover-drive": {
            "drive": {**SHORT, **turn, **chosen},
            "variants": [{"diameter_m": 0.8, "height_m": 0.5, "shape": 8, "yaw_deg": 30.0, "sun_azimuth_deg": 260.0}],
            "targets": [{"across": 0.0, "up": 0.5}],
        },
    }
    result = scenario(name)
    return result.run(result.parameters_type.model_validate(parameters[name]), Streams(1, "handover", case))


def list_images(inputs: Any) -> list[np.ndarray]:
    """Return the counts in the inputs of an algorithm."""
    images = inputs.images if hasattr(inputs, "images") else (inputs.left, inputs.right)
    return [image.counts for image in images]


@pytest.mark.parametrize(
    ("name", "spoiler", "spy"),
    [
        ("descent", "SpoilingVelocity", "VelocitySpy"),
        ("fieldtest", "SpoilingVelocity", "VelocitySpy"),
        ("landing", "SpoilingSite", "SiteSpy"),
        ("rover-drive", "SpoilingTracker", "TrackerSpy"),
    ],
)
def test_algorithm_cannot_change_measurements_of_the_next(name: str, spoiler: str, spy: str) -> None:
    result = run_small_case(name, spoiler, (spy,))
    assert (result.outcome, result.answered) == ("BAD_ANSWER", False)
    assert result.failure is not None
    assert "changed its measurements" in result.failure.error
    inputs = next(one for one in spies.GIVEN if not isinstance(one, tuple))
    assert all(counts.mean() > 1.0 for counts in list_images(inputs))
    assert result.row[f"{spy}.error"] == ""


def test_writing_to_an_image_is_an_algorithm_error() -> None:
    result = run_small_case("descent", "WritingVelocity", ("VelocitySpy",))
    assert result.outcome == "CRASHED"
    assert result.failure is not None
    assert "read-only" in result.failure.error
    assert result.row["VelocitySpy.outcome"] == "NO_VALID_TRACK"


def test_copies_are_equal_and_independent() -> None:
    inputs = descent()
    first, second = InputCopy(inputs).inputs, InputCopy(inputs).inputs
    assert first.images[0].counts.tobytes() == inputs.images[0].counts.tobytes()
    assert first.attitudes[0].world_from_body.as_quat().tobytes() == (
        inputs.attitudes[0].world_from_body.as_quat().tobytes()
    )
    for one in (inputs, second):
        assert not np.shares_memory(first.images[0].counts, one.images[0].counts)
        assert not np.shares_memory(first.sun_direction, one.sun_direction)
    assert not first.sun_direction.flags.writeable
    assert inputs.sun_direction.flags.writeable


class Lying(np.ndarray):
    """An array that compares equal to any value."""

    def __sub__(self, other: Any) -> Any:
        return np.zeros(self.shape)

    __rsub__ = __sub__


class LyingEstimator:
    """Reports a wrong velocity whose own comparison gives an error of 0."""

    def estimate(self, _: object) -> VelocityEstimate:
        """See `VelocityEstimator`."""
        return VelocityEstimate(VelocityOutcome.VALID, np.array([400.0, 0.0]).view(Lying))


def test_answers_are_converted_to_plain_numbers() -> None:
    answer = run_estimator(LyingEstimator, descent()).answer
    assert answer is not None
    assert type(answer.velocity_m_s) is np.ndarray
    assert (answer.velocity_m_s - np.array([1.0, 0.0])).tolist() == [399.0, 0.0]
    position, plane = np.arange(3, dtype=np.float32).view(Lying), np.eye(2).view(Lying)
    velocity = VelocityEstimate(
        VelocityOutcome.VALID, np.zeros(2), covariance_m2_s2=plane, span_s=(np.float64(0.0), 1.0)
    )
    checked = (
        check_velocity(velocity).covariance_m2_s2,
        check_site(SiteEstimate(SiteOutcome.SAFE_SITE, position)).site_world,
        check_update(TargetUpdate(TrackingState.NORMAL, (), position)).position_rover,
    )
    assert len([one for one in checked if type(one) is np.ndarray and one.dtype == np.float64]) == 3
    assert [type(one) for one in check_velocity(velocity).span_s or ()] == [float, float]


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("descent", {"feasible_overlap", "terrain"}),
        ("fieldtest", {"one_direction", "clear_sky"}),
        ("landing", {"wide_site_exists", "no_safe_site_exists", "within_limits"}),
        ("rover", {"selectable", "navcam", "roll_compensated"}),
        ("rover-drive", {"selectable", "in_view", "on_face", "with_scale"}),
    ],
)
def test_conditions_are_recorded_before_the_algorithm_runs(name: str, flags: set[str]) -> None:
    recorded: dict[str, Scalar] = {}
    with conditions_recorded_by(recorded.update), pytest.raises(SystemExit):
        run_small_case(name, "Leaving")
    assert flags <= recorded.keys()


def test_raising_tracker_fails_runs_with_selectable_targets() -> None:
    """5 of 20 runs raise: the requirement must not count only the other 15."""
    raised, full = (run_small_case("rover", spy, case=4) for spy in ("RaisingTracker", "TrackerSpy"))
    assert raised.outcome == "CRASHED"
    assert raised.row["selectable"] is full.row["selectable"] is True
    head = (
        {"outcome": one.outcome, "answered": one.answered, **one.row, "handed_over": True} for one in (raised, full)
    )
    crashed, good = head
    crashed.pop("handed_over")
    frame = pd.DataFrame([crashed] * 5 + [good] * 15)
    requested = {"id": "VTT-HANDED", "metric": "handed_over", "probability": 0.9, "confidence": 0.9}
    (result,) = evaluate_requirements(frame, [{**requested, "population": "selectable", "decide_by": "estimate"}])
    assert (result.status, result.n, result.failures) == (Status.FAIL, 20, 5)


def test_crashed_landing_has_no_site_report_column() -> None:
    """The report of a site is unknown: the case counts as reported and failed."""
    row = run_small_case("landing", "SpoilingSite").row
    assert not {"site_reported", "no_site_reported", "converged"} & row.keys()
