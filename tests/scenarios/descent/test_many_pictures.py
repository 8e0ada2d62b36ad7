"""Descents of any number of pictures: what whom is given, and what is true of what is answered."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.exchange import read_case
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.campaigns.running.replay import differing_columns
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.measurements import DescentFrame, DescentMeasurements
from tests.scenarios.descent.settings import DESCENT, PERFECT, parameters, run

STREAM = "tests.scenarios.descent.test_many_pictures:Inertial"
#: The three pictures of a descent as flown, among nine.
NINE: dict[str, Any] = {"pictures": 9, "descent": DESCENT | {"interval_s": 3.75 / 4}}


class Inertial:
    """Answers the inertial velocity: of the last interval, of the first half, and at last of the last instant."""

    def start(self) -> None:
        self.frames: list[DescentFrame] = []

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        self.frames.append(frame)
        velocity = frame.interval_velocity_m_s
        return None if velocity is None else VelocityEstimate(VelocityOutcome.VALID, velocity[:2])

    def finish(self) -> VelocityEstimate:
        last = self.frames[-1]
        assert last.inertial_velocity_m_s is not None
        tag = last.image.time_s
        return VelocityEstimate(
            VelocityOutcome.VALID,
            last.inertial_velocity_m_s[:2],
            covariance_m2_s2=np.diag([0.01, 0.04]),
            span_s=(tag, tag),
        )


class Halfway(Inertial):
    """Answers the mean velocity of the first two intervals, from the middle of the first to the middle of the last."""

    def finish(self) -> VelocityEstimate:
        first, *_, last = (frame.image.time_s for frame in self.frames)
        return VelocityEstimate(VelocityOutcome.VALID, np.zeros(2), span_s=(0.75 * first + 0.25 * last, last))


@pytest.fixture(scope="module")
def nine() -> CaseResult:
    """Nine pictures with perfect instruments: what inertial navigation says is true."""
    return run(algorithm=STREAM, compared=["dimes"], **NINE, **PERFECT)


def test_the_truth_is_of_what_the_answer_is_of(nine: CaseResult) -> None:
    """The inertial unit makes no errors here, so that its velocities are true of every span."""
    row: Any = nine.row
    assert (nine.outcome, row["stream_pictures"], row["pictures_before_answer"]) == ("VALID", 9, 2)
    assert np.isnan(row["velocity_error_after_1_m_s"])
    after = [row[f"velocity_error_after_{number}_m_s"] for number in range(2, 10)]
    # 400 Hz samples of a swinging descent, added up by the trapezoidal rule
    assert max(after) < 1e-3
    assert float(row["velocity_error_m_s"]) < 1e-3
    assert float(row["firing_velocity_error_m_s"]) < 2e-2
    # of an instant, not of the interval before it: the swinging camera changes its velocity
    means = nine.products["after_true_m_s"][-1]
    assert np.hypot(*(means - nine.products["velocity_true_m_s"])) > 0.05


def test_an_estimator_of_three_gets_those_of_a_descent_of_three(nine: CaseResult) -> None:
    three = run(**PERFECT).row
    assert [nine.row[f"altitude_{number}_m"] for number in (1, 5, 9)] == [
        three[f"altitude_{number}_m"] for number in (1, 2, 3)
    ]
    for name in ("velocity_true_x_m_s", "velocity_true_y_m_s"):
        assert nine.row[f"dimes.{name}"] == pytest.approx(three[name], rel=1e-12)
    assert (nine.row["feasible_overlap_first_pair"], nine.row["feasible_overlap_second_pair"]) == (
        three["feasible_overlap_first_pair"],
        three["feasible_overlap_second_pair"],
    )
    assert float(nine.row["dimes.velocity_error_m_s"]) < 1.0
    assert "dimes.stream_pictures" not in nine.row


def test_pictures_that_dimes_was_given_are_kept_for_its_figures() -> None:
    case = run(compared=[STREAM], triple=[1, 2, 3], **NINE)
    assert [name for name in case.products if name.startswith("image_")] == ["image_1", "image_2", "image_3"]
    assert {"Inertial.stream_pictures", "Inertial.velocity_nees"} <= set(case.row)


def test_a_span_between_pictures() -> None:
    """A quarter of the way: between the pictures' true times in proportion, by the descent's own motion."""
    spec = "tests.scenarios.descent.test_many_pictures:Halfway"
    two, nine = (
        run(algorithm=spec, pictures=pictures, descent=DESCENT | {"interval_s": 4.0 / (pictures - 1)}, **PERFECT)
        for pictures in (2, 9)
    )
    # the same instants of the same flight, told by other pictures
    for axis in "xy":
        assert two.row[f"velocity_true_{axis}_m_s"] == pytest.approx(nine.row[f"velocity_true_{axis}_m_s"], abs=1e-9)
    assert "feasible_overlap" not in two.row
    assert "velocity_change_error_m_s" not in two.row


def test_a_case_of_many_pictures_is_a_function_of_its_parameters() -> None:
    errors: dict[str, Any] = {"pictures": 4, "descent": DESCENT | {"interval_s": 1.0}, "algorithm": STREAM}
    first, again = run(**errors), run(**errors)
    assert differing_columns(dict(first.row), dict(again.row)) == ()


def test_pictures_are_written_down_for_others(tmp_path: Path) -> None:
    run(algorithm=f"export:{tmp_path}", pictures=4, descent=DESCENT | {"interval_s": 1.0})
    written = read_case(tmp_path / "cases" / "000000")
    assert isinstance(written, DescentMeasurements)
    assert len(written.images) == len(written.attitudes) == len(written.altitudes) == 4
    assert written.interval_velocities_m_s.shape == (3, 3)
    assert written.inertial_velocities_m_s is not None
    # an answer of a span of its own is scored over that
    start, end = written.tags_s[0], written.tags_s[2]
    table = tmp_path / "answers.csv"
    table.write_text(f"case,velocity_east_m_s,velocity_north_m_s,start_s,end_s\n0,1,2,{start!r},{end!r}\n")
    scored = run(algorithm=f"answers:{table}", pictures=4, descent=DESCENT | {"interval_s": 1.0})
    three = run(algorithm=STREAM, pictures=2, descent=DESCENT | {"interval_s": 2.0}).products["after_true_m_s"][1]
    assert [scored.row[f"velocity_true_{axis}_m_s"] for axis in "xy"] == pytest.approx(three, abs=1e-9)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"pictures": 2}, "pictures is 2, but 'dimes' takes 3; allowed: 3 to 100"),
        ({"pictures": 1}, "greater than or equal to 2"),
        ({"pictures": 5, "triple": [1, 3, 6]}, r"triple is \[1, 3, 6\]; allowed: three in ascending order, 1 to 5"),
        ({"triple": [1, 3, 2]}, "three in ascending order, 1 to 3"),
        (
            {"algorithm": STREAM, "pictures": 2, "faults": {"black_picture": 3}},
            "a fault strikes picture 3, but pictures",
        ),
    ],
)
def test_numbers_of_pictures_that_cannot_be(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parameters(**parts)


@pytest.mark.parametrize(("pictures", "places"), [(3, (0, 1, 2)), (4, (1, 2, 3)), (5, (0, 2, 4)), (10, (1, 5, 9))])
def test_three_as_far_apart_as_can_be(pictures: int, places: tuple[int, int, int]) -> None:
    assert parameters(pictures=pictures).triple_indices == places


def test_no_picture_is_taken_after_the_firing() -> None:
    with pytest.raises(ValueError, match=r"picture \d of 9 would be taken at .* s, after the thrusters' firing"):
        run(pictures=9)
