"""Tests of descents with any number of images: inputs of each algorithm and truth of each answer."""

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
#: Nine images of a descent that contain the three images of a standard descent.
NINE: dict[str, Any] = {"pictures": 9, "descent": DESCENT | {"interval_s": 3.75 / 4}}


class Inertial:
    """Return the inertial velocity: of the last interval for each image, of the last instant at the end."""

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
    """Return a mean velocity with a span from the middle of the first interval to the last image."""

    def finish(self) -> VelocityEstimate:
        first, *_, last = (frame.image.time_s for frame in self.frames)
        return VelocityEstimate(VelocityOutcome.VALID, np.zeros(2), span_s=(0.75 * first + 0.25 * last, last))


@pytest.fixture(scope="module")
def nine_images() -> CaseResult:
    """Nine images with ideal instruments: the inertial velocity is exact."""
    return run(algorithm=STREAM, compared=["dimes"], **NINE, **PERFECT)


def test_truth_has_the_span_of_the_answer(nine_images: CaseResult) -> None:
    """The inertial unit has no errors: its velocities are exact for each span."""
    row: Any = nine_images.row
    assert (nine_images.outcome, row["stream_pictures"], row["pictures_before_answer"]) == ("VALID", 9, 2)
    assert np.isnan(row["velocity_error_after_1_m_s"])
    after = [row[f"velocity_error_after_{number}_m_s"] for number in range(2, 10)]
    # Trapezoidal integration of 400 Hz samples of a swinging descent.
    assert max(after) < 1e-3
    assert float(row["velocity_error_m_s"]) < 1e-3
    assert float(row["firing_velocity_error_m_s"]) < 2e-2
    # The span is an instant, not the last interval: the camera swings and its velocity changes.
    means = nine_images.products["after_true_m_s"][-1]
    assert np.hypot(*(means - nine_images.products["velocity_true_m_s"])) > 0.05


def test_three_image_estimator_gets_standard_images(nine_images: CaseResult) -> None:
    three = run(**PERFECT).row
    assert [nine_images.row[f"altitude_{number}_m"] for number in (1, 5, 9)] == [
        three[f"altitude_{number}_m"] for number in (1, 2, 3)
    ]
    for name in ("velocity_true_x_m_s", "velocity_true_y_m_s"):
        assert nine_images.row[f"dimes.{name}"] == pytest.approx(three[name], rel=1e-12)
    assert (nine_images.row["feasible_overlap_first_pair"], nine_images.row["feasible_overlap_second_pair"]) == (
        three["feasible_overlap_first_pair"],
        three["feasible_overlap_second_pair"],
    )
    assert float(nine_images.row["dimes.velocity_error_m_s"]) < 1.0
    assert "dimes.stream_pictures" not in nine_images.row


def test_dimes_input_images_are_stored_for_figures() -> None:
    case = run(compared=[STREAM], triple=[1, 2, 3], **NINE)
    assert [name for name in case.products if name.startswith("image_")] == ["image_1", "image_2", "image_3"]
    assert {"Inertial.stream_pictures", "Inertial.velocity_nees"} <= set(case.row)


def test_span_between_images_is_interpolated() -> None:
    """A quarter of an interval: interpolation between the true image times along the true motion."""
    spec = "tests.scenarios.descent.test_many_pictures:Halfway"
    two, nine = (
        run(algorithm=spec, pictures=pictures, descent=DESCENT | {"interval_s": 4.0 / (pictures - 1)}, **PERFECT)
        for pictures in (2, 9)
    )
    # The same instants of the same flight with other images.
    for axis in "xy":
        assert two.row[f"velocity_true_{axis}_m_s"] == pytest.approx(nine.row[f"velocity_true_{axis}_m_s"], abs=1e-9)
    assert "feasible_overlap" not in two.row
    assert "velocity_change_error_m_s" not in two.row


def test_many_image_case_is_deterministic() -> None:
    errors: dict[str, Any] = {"pictures": 4, "descent": DESCENT | {"interval_s": 1.0}, "algorithm": STREAM}
    first, repeated = run(**errors), run(**errors)
    assert differing_columns(dict(first.row), dict(repeated.row)) == ()


def test_exported_images_can_be_answered_offline(tmp_path: Path) -> None:
    run(algorithm=f"export:{tmp_path}", pictures=4, descent=DESCENT | {"interval_s": 1.0})
    written = read_case(tmp_path / "cases" / "000000")
    assert isinstance(written, DescentMeasurements)
    assert len(written.images) == len(written.attitudes) == len(written.altitudes) == 4
    assert written.interval_velocities_m_s.shape == (3, 3)
    assert written.inertial_velocities_m_s is not None
    # An answer with its own span is scored over that span.
    start, end = written.tags_s[0], written.tags_s[2]
    table = tmp_path / "answers.csv"
    table.write_text(f"case,velocity_east_m_s,velocity_north_m_s,start_s,end_s\n0,1,2,{start!r},{end!r}\n")
    scored = run(algorithm=f"answers:{table}", pictures=4, descent=DESCENT | {"interval_s": 1.0})
    three = run(algorithm=STREAM, pictures=2, descent=DESCENT | {"interval_s": 2.0}).products["after_true_m_s"][1]
    assert [scored.row[f"velocity_true_{axis}_m_s"] for axis in "xy"] == pytest.approx(three, abs=1e-9)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"pictures": 2}, "pictures is 2, but 'dimes' needs 3; allowed: 3 to 100"),
        ({"pictures": 1}, "greater than or equal to 2"),
        ({"pictures": 5, "triple": [1, 3, 6]}, r"triple is \[1, 3, 6\]; allowed: three in ascending order, 1 to 5"),
        ({"triple": [1, 3, 2]}, "three in ascending order, 1 to 3"),
        (
            {"algorithm": STREAM, "pictures": 2, "faults": {"black_picture": 3}},
            "a fault affects picture 3, but the descent",
        ),
    ],
)
def test_invalid_image_counts_are_rejected(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parameters(**parts)


@pytest.mark.parametrize(("pictures", "positions"), [(3, (0, 1, 2)), (4, (1, 2, 3)), (5, (0, 2, 4)), (10, (1, 5, 9))])
def test_three_images_are_spread_evenly(pictures: int, positions: tuple[int, int, int]) -> None:
    assert parameters(pictures=pictures).triple_indices == positions


def test_no_image_is_captured_after_firing() -> None:
    with pytest.raises(ValueError, match=r"picture \d of 9 would be taken at .* s, after the thrusters' firing"):
        run(pictures=9)
