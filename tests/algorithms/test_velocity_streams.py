"""Pictures one by one: what a stream gets, what is asked of its answers, and streams that are programs."""

import importlib
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from marsyard.algorithms.answers import AlgorithmError, Fault, check_velocity
from marsyard.algorithms.dimes import DimesEstimator
from marsyard.algorithms.exchange import (
    ExecutableLimits,
    ExecutableVelocityStream,
    ProgramDetails,
    parse_command,
    read_case,
    read_frame,
    write_case,
    write_frame,
)
from marsyard.algorithms.exchange.serving import end_persistent
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.algorithms.streams import StreamedEstimator, set_span
from marsyard.scenarios.algorithm_run import hash_inputs
from marsyard.scenarios.conformance import inputs
from marsyard.sim.measurements import DescentFrame, DescentMeasurements

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
NOTHING = VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
READY = "import json, os, sys, time\nprint(json.dumps({'exchange': 1, 'ready': True}), flush=True)\n"


def valid(*span_s: float) -> VelocityEstimate:
    span = (span_s[0], span_s[1]) if span_s else None
    return VelocityEstimate(VelocityOutcome.VALID, np.array([1.0, 2.0]), span_s=span)


class Noting:
    """Notes its calls; answers from the second picture on."""

    def __init__(self) -> None:
        self.called: list[object] = []

    def start(self) -> None:
        self.called.append("start")

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        self.called.append(frame)
        return valid() if len(self.called) > 2 else None

    def finish(self) -> VelocityEstimate:
        self.called.append("finish")
        return valid(100.5, 101.0)


def test_a_stream_gets_what_came_with_each_picture() -> None:
    given, stream = inputs.descent(5), Noting()
    velocities = given.interval_velocities_m_s + np.arange(4.0)[:, None]
    given = replace(given, interval_velocities_m_s=velocities)
    answer = StreamedEstimator(stream).estimate(given)
    assert (stream.called[0], stream.called[-1]) == ("start", "finish")
    frames = [one for one in stream.called if isinstance(one, DescentFrame)]
    assert [frame.image for frame in frames] == list(given.images)
    assert [frame.altitude for frame in frames] == list(given.altitudes)
    assert [frame.attitude for frame in frames] == list(given.attitudes)
    assert frames[0].interval_velocity_m_s is None
    for before, frame in zip(velocities, frames[1:], strict=True):
        np.testing.assert_array_equal(frame.interval_velocity_m_s, before)
    assert answer.span_s == (100.5, 101.0)
    # without a span the last interval of what had been taken by then is meant
    first, *later = answer.after_pictures
    assert first is None
    tags = given.tags_s
    assert [one.span_s for one in later if one is not None] == list(pairwise(tags))


def test_three_of_many_pictures_keep_the_motion_between_them() -> None:
    given = inputs.descent(5)
    velocities = np.arange(12.0).reshape(4, 3)
    images = tuple(replace(one, time_s=tag) for one, tag in zip(given.images, (0.0, 1.0, 4.0, 6.0, 7.0), strict=True))
    chosen = replace(given, images=images, interval_velocities_m_s=velocities).select((0, 2, 3))
    assert chosen.tags_s == (0.0, 4.0, 6.0)
    # a second at the first interval's velocity and three at the second's; the third's alone, to the bit
    np.testing.assert_allclose(chosen.interval_velocities_m_s[0], (velocities[0] + 3.0 * velocities[1]) / 4.0)
    np.testing.assert_array_equal(chosen.interval_velocities_m_s[1], velocities[2])
    assert chosen.attitudes == (given.attitudes[0], given.attitudes[2], given.attitudes[3])
    np.testing.assert_array_equal(chosen.inertial_velocities_m_s, given.inertial_velocities_m_s[[0, 2, 3]])  # type: ignore[index]
    assert len(given.select(()).frames()) == 0


def test_an_estimator_of_three_takes_no_more() -> None:
    with pytest.raises(ValueError, match="5 pictures are given; this estimator takes 3"):
        DimesEstimator().estimate(inputs.descent(5))


@pytest.mark.parametrize(
    ("span", "message"),
    [
        ((1.0, 2.5), r"span_s is \(1.0, 2.5\); allowed: within the pictures' tags, 0.0 to 2.0 s"),
        ((-0.1, 1.0), "within the pictures' tags"),
        ((1.0, 0.5), "the first not after the second"),
        ((float("nan"), 1.0), "finite"),
        ([0.0, 1.0], "a tuple of two time tags, or None"),
        ((0.0, "1"), "a tuple of two time tags, or None"),
    ],
)
def test_spans_that_are_none(span: object, message: str) -> None:
    answer = valid()
    object.__setattr__(answer, "span_s", span)
    with pytest.raises(AlgorithmError, match=message) as caught:
        check_velocity(answer, (0.0, 1.0, 2.0))
    assert caught.value.fault is Fault.BAD_ANSWER


def test_what_an_answer_leaves_out_is_the_last_interval() -> None:
    assert set_span(valid(), (0.0, 1.0, 3.0)).span_s == (1.0, 3.0)
    assert set_span(valid(2.0, 2.0), (0.0, 3.0)).span_s == (2.0, 2.0)
    assert set_span(NOTHING, (0.0,)).span_s is None
    with pytest.raises(AlgorithmError, match="of one picture there is no last interval"):
        set_span(valid(), (0.0,))


def test_a_stream_does_not_write_its_own_history() -> None:
    class Claiming(Noting):
        def finish(self) -> VelocityEstimate:
            return replace(valid(), after_pictures=(valid(),))

    with pytest.raises(AlgorithmError, match="after_pictures is given"):
        StreamedEstimator(Claiming()).estimate(inputs.descent())


@pytest.mark.parametrize("altitude_m", [1500.0, float("nan")])
def test_a_frame_comes_back_as_it_was(tmp_path: Path, altitude_m: float) -> None:
    given = inputs.descent()
    frame = replace(given.frames()[1], altitude=replace(given.altitudes[1], altitude_m=altitude_m))
    write_frame(tmp_path, frame)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["camera_1.cahvor", "flat_field_1.f64", "frame.json", "image_1.pgm"]
    back = read_frame(tmp_path)
    np.testing.assert_array_equal(back.image.counts, frame.image.counts)
    for name in ("sun_direction", "inertial_velocity_m_s", "interval_velocity_m_s"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frame, name))
    assert repr(back.altitude) == repr(frame.altitude)
    assert (back.attitude.world_from_body.inv() * frame.attitude.world_from_body).magnitude() < 1e-14
    path = tmp_path / "frame.json"
    path.write_text(path.read_text().replace('"exchange": 1', '"exchange": 2'))
    with pytest.raises(ValueError, match="is no picture of a descent: it has version 2 of the exchange"):
        read_frame(tmp_path)


@pytest.mark.parametrize("number", [1, 5])
def test_a_case_of_any_number_of_pictures_comes_back(tmp_path: Path, number: int) -> None:
    given = inputs.descent(5).select(tuple(range(number)))
    write_case(tmp_path, given)
    back = read_case(tmp_path)
    assert isinstance(back, DescentMeasurements)
    assert hash_inputs([one.counts for one in back.images]) == hash_inputs([one.counts for one in given.images])
    np.testing.assert_array_equal(back.interval_velocities_m_s, given.interval_velocities_m_s)
    np.testing.assert_array_equal(back.inertial_velocities_m_s, given.inertial_velocities_m_s)


def program(spec: str, time_s: float = 60.0) -> StreamedEstimator:
    command = parse_command(spec)
    assert command is not None
    assert command.stream
    return StreamedEstimator(ExecutableVelocityStream(command, ExecutableLimits(time_s=time_s)))


def test_the_example_answers_alike_in_python_and_as_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.syspath_prepend(str(EXAMPLES))
    ChainedShifts = importlib.import_module("velocity_stream").ChainedShifts

    given = inputs.descent(5)
    mine = StreamedEstimator(ChainedShifts()).estimate(given)
    assert mine.velocity_m_s is not None
    error = mine.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2]
    # within three deviations of its own, which are below 1 m/s
    assert mine.covariance_m2_s2 is not None
    assert np.all(np.abs(error) < 3.0 * np.sqrt(np.diag(mine.covariance_m2_s2)))
    assert np.all(np.diag(mine.covariance_m2_s2) < 1.0)
    asked = program(f"serve-stream:{sys.executable} {EXAMPLES / 'velocity_stream.py'}")
    for _ in range(2):
        its = asked.estimate(given)
        np.testing.assert_allclose(its.velocity_m_s, mine.velocity_m_s, rtol=0.0, atol=1e-9)  # type: ignore[arg-type]
        np.testing.assert_allclose(its.covariance_m2_s2, mine.covariance_m2_s2, rtol=1e-12)  # type: ignore[arg-type]
        assert its.span_s == mine.span_s == (107.5, 107.5)
        assert [one is None for one in its.after_pictures] == [True, False, False, False, False]
        assert isinstance(its.details, ProgramDetails)
        assert its.details.time_s > 0.0
    end_persistent()


def answering(answers: list[str]) -> str:
    """A program that gives these answers, whatever it is asked."""
    return f"{READY}for answer in {answers}:\n    sys.stdin.readline()\n    print(answer, flush=True)\n"


NONE_YET = '{"exchange": 1, "outcome": null}'


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (['{"exchange": 1, "outcome": "NO_VALID_TRACK"}'], "start is answered with an outcome"),
        ([NONE_YET, "3"], "not one JSON object"),
        ([NONE_YET, '{"exchange": 1}'], "outcome is None; allowed: VALID"),
        ([NONE_YET, '{"exchange": 1, "outcome": null, "span_s": [1, 2]}'], "unknown key 'span_s'"),
        (
            [NONE_YET, NONE_YET, '{"exchange": 1, "outcome": "VALID", "velocity_m_s": [1, 2], "span_s": [0, 1]}'],
            r"span_s is \(0.0, 1.0\); allowed: within",
        ),
        ([NONE_YET] * 5, "finish is answered with the outcome null"),
        ([NONE_YET] * 2, "its output ended before it had answered|it reads no more cases"),
    ],
)
def test_whatever_a_program_answers_wrong_is_a_fault(tmp_path: Path, answers: list[str], message: str) -> None:
    (tmp_path / "stream.py").write_text(answering(answers))
    with pytest.raises(AlgorithmError, match=message) as caught:
        program(f"exec-stream:{sys.executable} {tmp_path / 'stream.py'}").estimate(inputs.descent())
    assert caught.value.fault is (Fault.CRASHED if answers == [NONE_YET] * 2 else Fault.BAD_ANSWER)


def test_a_program_that_hangs_at_a_picture_is_ended(tmp_path: Path) -> None:
    (tmp_path / "stream.py").write_text(answering([NONE_YET, NONE_YET]) + "time.sleep(60)\n")
    with pytest.raises(AlgorithmError, match="no answer within 3 s") as caught:
        program(f"exec-stream:{sys.executable} {tmp_path / 'stream.py'}", 3.0).estimate(inputs.descent())
    assert caught.value.fault is Fault.TIMED_OUT
