"""What one algorithm does to its inputs, or to its process, is its own: no other notices, and the case's row keeps what
does not depend on it.
"""

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
from marsyard.reports.verdicts import Status, judge_campaign
from marsyard.scenarios.algorithm_run import Handover
from marsyard.scenarios.conformance.inputs import descent
from marsyard.scenarios.interface import CaseResult, Scalar, conditions_recorded_by
from marsyard.scenarios.systems import scenario
from marsyard.scenarios.velocity import run_estimator
from marsyard.sim.streams import Streams
from tests.scenarios import spies

SPY = "tests.scenarios.spies"


@pytest.fixture(autouse=True)
def _empty() -> Iterator[None]:
    yield
    spies.GIVEN.clear()
    spies.TRUE.clear()


def run(name: str, algorithm: str, compared: tuple[str, ...] = (), case: int = 0) -> CaseResult:
    """A small case of a scenario."""
    from tests.scenarios.descent.settings import DESCENT, WORLD
    from tests.scenarios.rover.short_run import SHORT
    from tests.scenarios.test_fieldtest import stated

    chosen: dict[str, Any] = {"algorithm": f"{SPY}:{algorithm}", "compared": [f"{SPY}:{one}" for one in compared]}
    turn = {"legs": [{"motion": "circle", "step_deg": 5.0, "steps": 1}]}
    parameters: dict[str, Any] = {
        "descent": {**WORLD, "descent": DESCENT, **chosen},
        "fieldtest": {
            **stated().model_dump(),
            "runs": [stated().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}],
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
    found = scenario(name)
    return found.run(found.parameters_type.model_validate(parameters[name]), Streams(1, "handover", case))


def pictures(given: Any) -> list[np.ndarray]:
    """The counts in what an algorithm was given."""
    images = given.images if hasattr(given, "images") else (given.left, given.right)
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
def test_an_algorithm_cannot_spoil_the_measurements_of_the_next(name: str, spoiler: str, spy: str) -> None:
    result = run(name, spoiler, (spy,))
    assert (result.outcome, result.answered) == ("BAD_ANSWER", False)
    assert result.failure is not None
    assert "changed the measurements" in result.failure.error
    given = next(one for one in spies.GIVEN if not isinstance(one, tuple))
    assert all(counts.mean() > 1.0 for counts in pictures(given))
    assert result.row[f"{spy}.error"] == ""


def test_writing_to_a_picture_is_an_error_of_the_algorithm() -> None:
    result = run("descent", "WritingVelocity", ("VelocitySpy",))
    assert result.outcome == "CRASHED"
    assert result.failure is not None
    assert "read-only" in result.failure.error
    assert result.row["VelocitySpy.outcome"] == "NO_VALID_TRACK"


def test_copies_are_the_same_bit_for_bit_and_nobody_elses() -> None:
    given = descent()
    first, second = Handover(given).given, Handover(given).given
    assert first.images[0].counts.tobytes() == given.images[0].counts.tobytes()
    assert first.attitudes[0].world_from_body.as_quat().tobytes() == (
        given.attitudes[0].world_from_body.as_quat().tobytes()
    )
    for one in (given, second):
        assert not np.shares_memory(first.images[0].counts, one.images[0].counts)
        assert not np.shares_memory(first.sun_direction, one.sun_direction)
    assert not first.sun_direction.flags.writeable
    assert given.sun_direction.flags.writeable


class Lying(np.ndarray):
    """An array that is always equal to what it is compared with."""

    def __sub__(self, other: Any) -> Any:
        return np.zeros(self.shape)

    __rsub__ = __sub__


class LyingEstimator:
    """Reports a velocity that is far off, whose error is 0 by its own account."""

    def estimate(self, _: object) -> VelocityEstimate:
        """See `VelocityEstimator`."""
        return VelocityEstimate(VelocityOutcome.VALID, np.array([400.0, 0.0]).view(Lying))


def test_answers_are_plain_numbers_before_they_are_scored() -> None:
    answer = run_estimator(LyingEstimator, descent()).answer
    assert answer is not None
    assert type(answer.velocity_m_s) is np.ndarray
    assert (answer.velocity_m_s - np.array([1.0, 0.0])).tolist() == [399.0, 0.0]
    place, plane = np.arange(3, dtype=np.float32).view(Lying), np.eye(2).view(Lying)
    velocity = VelocityEstimate(
        VelocityOutcome.VALID, np.zeros(2), covariance_m2_s2=plane, span_s=(np.float64(0.0), 1.0)
    )
    checked = (
        check_velocity(velocity).covariance_m2_s2,
        check_site(SiteEstimate(SiteOutcome.SAFE_SITE, place)).site_world,
        check_update(TargetUpdate(TrackingState.NORMAL, (), place)).position_rover,
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
def test_conditions_are_recorded_before_an_algorithm_can_end_its_process(name: str, flags: set[str]) -> None:
    recorded: dict[str, Scalar] = {}
    with conditions_recorded_by(recorded.update), pytest.raises(SystemExit):
        run(name, "Leaving")
    assert flags <= recorded.keys()


def test_trackers_that_raise_fail_the_runs_in_which_the_target_is_selectable() -> None:
    """5 of 20 runs raise: 15 of 15 of the others must not be what the requirement sees."""
    raised, whole = (run("rover", spy, case=4) for spy in ("RaisingTracker", "TrackerSpy"))
    assert raised.outcome == "CRASHED"
    assert raised.row["selectable"] is whole.row["selectable"] is True
    head = (
        {"outcome": one.outcome, "answered": one.answered, **one.row, "handed_over": True} for one in (raised, whole)
    )
    crashed, good = head
    crashed.pop("handed_over")
    frame = pd.DataFrame([crashed] * 5 + [good] * 15)
    asked_for = {"id": "VTT-HANDED", "metric": "handed_over", "probability": 0.9, "confidence": 0.9}
    (found,) = judge_campaign(frame, [{**asked_for, "population": "selectable", "decide_by": "estimate"}])
    assert (found.status, found.n, found.failures) == (Status.FAIL, 20, 5)


def test_the_row_of_a_crashed_landing_does_not_say_whether_a_site_was_reported() -> None:
    """Whether it would have reported a site is unknown: it counts as if it had, and failed."""
    row = run("landing", "SpoilingSite").row
    assert not {"site_reported", "no_site_reported", "converged"} & row.keys()
