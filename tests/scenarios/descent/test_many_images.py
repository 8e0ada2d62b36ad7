"""Tests of descents with two or more images: images for each algorithm, and true velocity for each answer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.exchange import read_case
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.measurements import DescentFrame, DescentMeasurements
from tests.scenarios.descent.descents import DESCENT, IDEAL_INSTRUMENTS, make_parameters, run_descent

STREAM_ESTIMATOR = "tests.scenarios.descent.test_many_images:InertialEstimator"
#: Nine images of a descent that contain the three images of a standard descent; the estimator runs in this process.
NINE_IMAGES: dict[str, Any] = {
    "images": 9,
    "descent": DESCENT | {"interval_s": 3.75 / 4},
    "executable": {"isolated": False},
}


class InertialEstimator:
    """Estimator that returns the mean inertial velocity of the last interval, and at the end the last velocity."""

    def start(self) -> None:
        self.frames: list[DescentFrame] = []

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        self.frames.append(frame)
        velocity = frame.interval_velocity_m_s
        return None if velocity is None else VelocityEstimate(VelocityOutcome.VALID, velocity[:2])

    def finish(self) -> VelocityEstimate:
        last = self.frames[-1]
        assert last.inertial_velocity_m_s is not None
        last_time_s = last.image.time_s
        return VelocityEstimate(
            VelocityOutcome.VALID,
            last.inertial_velocity_m_s[:2],
            covariance_m2_s2=np.diag([0.01, 0.04]),
            span_s=(last_time_s, last_time_s),
        )


class LastThreeQuartersEstimator(InertialEstimator):
    """Estimator whose answer has a span from a quarter of the descent to the last image."""

    def finish(self) -> VelocityEstimate:
        first, *_, last = (frame.image.time_s for frame in self.frames)
        return VelocityEstimate(VelocityOutcome.VALID, np.zeros(2), span_s=(0.75 * first + 0.25 * last, last))


@pytest.fixture(scope="module")
def nine_images() -> CaseResult:
    """Run a case with nine images and ideal instruments; the inertial velocity is exact."""
    return run_descent(algorithm=STREAM_ESTIMATOR, compared=["dimes"], **NINE_IMAGES, **IDEAL_INSTRUMENTS)


def test_true_velocity_is_averaged_over_the_span_of_the_answer(nine_images: CaseResult) -> None:
    """Each answer is compared with the true mean velocity over its own span; the inertial unit has no errors."""
    row: Any = nine_images.row
    assert (nine_images.outcome, row["stream_images"], row["images_before_answer"]) == ("VALID", 9, 2)
    assert np.isnan(row["velocity_error_after_1_m_s"])
    interval_errors = [row[f"velocity_error_after_{number}_m_s"] for number in range(2, 10)]
    # Tolerance: trapezoidal integration of 400 Hz samples of a swinging descent.
    assert max(interval_errors) < 1e-3
    assert float(row["velocity_error_m_s"]) < 1e-3
    assert float(row["firing_velocity_error_m_s"]) < 2e-2
    # The span of the final answer is an instant: the velocity of the swinging camera differs from the interval's mean.
    interval_mean = nine_images.products["after_true_m_s"][-1]
    assert np.hypot(*(interval_mean - nine_images.products["velocity_true_m_s"])) > 0.05


def test_three_image_estimator_receives_first_middle_and_last_image(nine_images: CaseResult) -> None:
    three_images = run_descent(**IDEAL_INSTRUMENTS).row
    assert [nine_images.row[f"altitude_{number}_m"] for number in (1, 5, 9)] == [
        three_images[f"altitude_{number}_m"] for number in (1, 2, 3)
    ]
    for name in ("velocity_true_x_m_s", "velocity_true_y_m_s"):
        assert nine_images.row[f"dimes.{name}"] == pytest.approx(three_images[name], rel=1e-12)
    for name in ("overlap_width_first_pair_m", "overlap_width_second_pair_m"):
        assert nine_images.row[name] == three_images[name]
    assert float(nine_images.row["dimes.velocity_error_m_s"]) < 1.0
    assert "dimes.stream_images" not in nine_images.row


@pytest.mark.slow
def test_dimes_input_images_are_stored_for_figures() -> None:
    result = run_descent(compared=[STREAM_ESTIMATOR], triple=[1, 2, 3], **NINE_IMAGES)
    assert [name for name in result.products if name.startswith("image_")] == ["image_1", "image_2", "image_3"]
    assert {"InertialEstimator.stream_images", "InertialEstimator.velocity_nees"} <= set(result.row)


def test_span_between_images_is_interpolated() -> None:
    """The span starts a quarter of the descent after the first image: the truth is interpolated between the images."""
    spec = "tests.scenarios.descent.test_many_images:LastThreeQuartersEstimator"
    first, second = (
        run_descent(algorithm=spec, images=n, descent=DESCENT | {"interval_s": 4.0 / (n - 1)}, **IDEAL_INSTRUMENTS)
        for n in (2, 9)
    )
    # Both cases have the same flight and span, but different images.
    for axis in "xy":
        name = f"velocity_true_{axis}_m_s"
        assert first.row[name] == pytest.approx(second.row[name], abs=1e-9)
    assert "feasible_overlap" not in first.row
    assert "velocity_change_error_m_s" not in first.row


def test_answer_table_for_exported_images_is_scored(tmp_path: Path) -> None:
    run_descent(algorithm=f"export:{tmp_path}", images=4, descent=DESCENT | {"interval_s": 1.0})
    exported_case = read_case(tmp_path / "cases" / "000000")
    assert isinstance(exported_case, DescentMeasurements)
    assert len(exported_case.images) == len(exported_case.attitudes) == len(exported_case.altitudes) == 4
    assert exported_case.interval_velocities_m_s.shape == (3, 3)
    assert exported_case.inertial_velocities_m_s is not None
    # The answer is scored over its span.
    start, end = exported_case.tags_s[0], exported_case.tags_s[2]
    answer_table = tmp_path / "answers.csv"
    answer_table.write_text(f"case,velocity_east_m_s,velocity_north_m_s,start_s,end_s\n0,1,2,{start!r},{end!r}\n")
    scored_case = run_descent(algorithm=f"answers:{answer_table}", images=4, descent=DESCENT | {"interval_s": 1.0})
    same_span = run_descent(algorithm=STREAM_ESTIMATOR, images=2, descent=DESCENT | {"interval_s": 2.0})
    assert [scored_case.row[f"velocity_true_{axis}_m_s"] for axis in "xy"] == pytest.approx(
        same_span.products["after_true_m_s"][1], abs=1e-9
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"images": 2}, "images is 2, but 'dimes' needs 3; allowed: 3 to 100"),
        ({"images": 1}, "greater than or equal to 2"),
        ({"images": 5, "triple": [1, 3, 6]}, r"triple is \[1, 3, 6\]; allowed: three in ascending order, 1 to 5"),
        ({"triple": [1, 3, 2]}, "three in ascending order, 1 to 3"),
        (
            {"algorithm": STREAM_ESTIMATOR, "images": 2, "faults": {"black_image": 3}},
            "a fault affects image 3, but the",
        ),
    ],
)
def test_invalid_image_counts_are_rejected(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_parameters(**values)


@pytest.mark.parametrize(("images", "positions"), [(3, (0, 1, 2)), (4, (1, 2, 3)), (5, (0, 2, 4)), (10, (1, 5, 9))])
def test_default_image_triple_is_evenly_spaced(images: int, positions: tuple[int, int, int]) -> None:
    assert make_parameters(images=images).triple_indices == positions


def test_image_times_after_thruster_ignition_are_rejected() -> None:
    with pytest.raises(ValueError, match=r"image \d of 9 would be taken at .* s, after the thrusters' firing"):
        run_descent(images=9)
