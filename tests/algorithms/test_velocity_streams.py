"""Tests of velocity streams: inputs per image, checks of answers, and programs as streams."""

import importlib
import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from marsyard.algorithms.answers import check_and_set_span, check_velocity
from marsyard.algorithms.dimes import DimesEstimator
from marsyard.algorithms.exchange import (
    VELOCITY_STREAM,
    ExecutableAlgorithm,
    ExecutableLimits,
    ProgramDetails,
    parse_command,
    read_case,
    read_frame,
    write_case,
    write_frame,
)
from marsyard.algorithms.exchange.serving import end_idle_programs
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.input_copies import hash_inputs
from marsyard.scenarios.streamed import StreamedEstimator
from marsyard.scenarios.velocity import check_velocity_answer
from marsyard.sim.measurements import AltitudeMeasurement, DescentFrame, DescentMeasurements, ImuIncrements

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
NO_VELOCITY = VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


def make_estimate(*span_s: float) -> VelocityEstimate:
    """Create a valid estimate for the time span (first, last), or without a span."""
    span = (span_s[0], span_s[1]) if span_s else None
    return VelocityEstimate(VelocityOutcome.VALID, np.array([1.0, 2.0]), span_s=span)


def estimate(stream: object, measurements: DescentMeasurements) -> VelocityEstimate:
    """Run a stream over a descent and check its answers."""
    return check_velocity_answer(StreamedEstimator(stream).estimate(measurements), measurements.tags_s)


class RecordingStream:
    """A stream that records its calls and returns an estimate from the second image on."""

    def __init__(self) -> None:
        self.calls: list[object] = []

    def start(self) -> None:
        self.calls.append("start")

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        self.calls.append(frame)
        return make_estimate() if len(self.calls) > 2 else None

    def finish(self) -> VelocityEstimate:
        self.calls.append("finish")
        return make_estimate(100.5, 101.0)


def test_stream_receives_measurements_of_each_image() -> None:
    measurements, stream = inputs.descent(5), RecordingStream()
    velocities = measurements.interval_velocities_m_s + np.arange(4.0)[:, None]
    measurements = replace(measurements, interval_velocities_m_s=velocities)
    answer = estimate(stream, measurements)
    assert (stream.calls[0], stream.calls[-1]) == ("start", "finish")
    frames = [call for call in stream.calls if isinstance(call, DescentFrame)]
    assert [frame.image for frame in frames] == list(measurements.images)
    assert [frame.altitude for frame in frames] == list(measurements.altitudes)
    assert [frame.attitude for frame in frames] == list(measurements.attitudes)
    assert frames[0].interval_velocity_m_s is None
    for velocity, frame in zip(velocities, frames[1:], strict=True):
        np.testing.assert_array_equal(frame.interval_velocity_m_s, velocity)
    assert answer.span_s == (100.5, 101.0)
    # Without a span the answer is for the last interval.
    first, *later = answer.after_images
    assert first is None
    tags = measurements.tags_s
    assert [item.span_s for item in later if item is not None] == list(pairwise(tags))


def test_selection_averages_velocities_over_omitted_images() -> None:
    measurements = inputs.descent(5)
    velocities = np.arange(12.0).reshape(4, 3)
    images = tuple(
        replace(image, time_s=tag) for image, tag in zip(measurements.images, (0.0, 1.0, 4.0, 6.0, 7.0), strict=True)
    )
    selection = replace(measurements, images=images, interval_velocities_m_s=velocities).select((0, 2, 3))
    assert selection.tags_s == (0.0, 4.0, 6.0)
    # One second at the velocity of the first interval and three at that of the second; the third interval is unchanged.
    np.testing.assert_allclose(selection.interval_velocities_m_s[0], (velocities[0] + 3.0 * velocities[1]) / 4.0)
    np.testing.assert_array_equal(selection.interval_velocities_m_s[1], velocities[2])
    assert selection.attitudes == (measurements.attitudes[0], measurements.attitudes[2], measurements.attitudes[3])
    np.testing.assert_array_equal(selection.inertial_velocities_m_s, measurements.inertial_velocities_m_s[[0, 2, 3]])  # type: ignore[index]
    assert len(measurements.select(()).frames()) == 0


class RecordingInertialStream(RecordingStream):
    """A stream that records all measurements and returns no estimate after an image."""

    def process_image(self, frame: DescentFrame) -> None:
        self.calls.append(frame)

    def process_increments(self, increments: ImuIncrements) -> None:
        self.calls.append(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        self.calls.append(measurement)


def record_events(measurements: DescentMeasurements) -> list[object]:
    """Return the measurements in the order in which a stream with inertial data receives them."""
    stream = RecordingInertialStream()
    StreamedEstimator(stream).estimate(measurements)
    assert (stream.calls[0], stream.calls[-1]) == ("start", "finish")
    return stream.calls[1:-1]


def test_increments_and_altitudes_arrive_in_the_order_of_their_tags() -> None:
    """Altitudes of the first and the last image are missing or too early; the second reading is used twice."""
    measurements = inputs.inertial_descent(5)
    increments = measurements.increments
    first, second, third, *_, last = measurements.altitudes
    altitudes = (
        replace(first, time_s=0.0),
        replace(second, time_s=second.time_s - 0.3),
        replace(second, time_s=second.time_s - 0.3),
        replace(third, time_s=third.time_s + 0.4),
        replace(last, altitude_m=float("nan")),
    )
    measurements = replace(measurements, altitudes=altitudes)
    events = record_events(measurements)
    kinds = {ImuIncrements: "increments", AltitudeMeasurement: "altitude", DescentFrame: "image"}
    assert [kinds[type(event)] for event in events if not isinstance(event, ImuIncrements)] == [
        *("image", "altitude", "image", "image", "altitude", "image", "image")
    ]
    assert [kinds[type(event)] for event in events[::2]] == ["increments"] * 7
    # increments at 100 Hz up to the last image: 1 s before the first image, and 7.5 s between the images
    blocks = [event for event in events if isinstance(event, ImuIncrements)]
    angles = np.concatenate([block.delta_angles_rad for block in blocks])
    assert len(angles) == 850
    np.testing.assert_array_equal(angles, increments.delta_angles_rad[:850])
    # a stream without the optional methods receives the images only
    stream = RecordingStream()
    StreamedEstimator(stream).estimate(measurements)
    assert len(stream.calls) == 7
    assert record_events(measurements.select(())) == []


def test_three_image_estimator_rejects_more_images() -> None:
    with pytest.raises(ValueError, match="5 images are given; this estimator requires 3"):
        DimesEstimator().estimate(inputs.descent(5))


@pytest.mark.parametrize(
    ("span", "message"),
    [
        ((1.0, 2.5), r"span_s is \(1.0, 2.5\); allowed: within the images' time tags, 0.0 to 2.0 s"),
        ((-0.1, 1.0), "within the images' time tags"),
        ((1.0, 0.5), "the first not after the second"),
        ((float("nan"), 1.0), "finite"),
        ([0.0, 1.0], "a tuple of two time tags, or None"),
        ((0.0, "1"), "a tuple of two time tags, or None"),
    ],
)
def test_invalid_spans_are_rejected(span: object, message: str) -> None:
    answer = make_estimate()
    object.__setattr__(answer, "span_s", span)
    with pytest.raises(AlgorithmError, match=message) as error:
        check_velocity(answer, (0.0, 1.0, 2.0))
    assert error.value.fault is Fault.BAD_ANSWER


def test_missing_span_defaults_to_last_interval() -> None:
    assert check_and_set_span(make_estimate(), (0.0, 1.0, 3.0)).span_s == (1.0, 3.0)
    assert check_and_set_span(make_estimate(2.0, 2.0), (0.0, 3.0)).span_s == (2.0, 2.0)
    assert check_and_set_span(NO_VELOCITY, (0.0,)).span_s is None
    with pytest.raises(AlgorithmError, match="one image has no last interval"):
        check_and_set_span(make_estimate(), (0.0,))


def test_answer_of_a_stream_with_after_images_is_rejected() -> None:
    class StreamWithAfterImages(RecordingStream):
        def finish(self) -> VelocityEstimate:
            return replace(make_estimate(), after_images=(make_estimate(),))

    with pytest.raises(AlgorithmError, match="after_images is given"):
        estimate(StreamWithAfterImages(), inputs.descent())


@pytest.mark.parametrize("altitude_m", [1500.0, float("nan")])
def test_frame_files_round_trip(tmp_path: Path, altitude_m: float) -> None:
    measurements = inputs.inertial_descent(3)
    frame = replace(measurements.frames()[1], altitude=replace(measurements.altitudes[1], altitude_m=altitude_m))
    write_frame(tmp_path, frame)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["camera_1.cahvor", "flat_field_1.f64", "image.json", "image_1.pgm"]
    restored_frame = read_frame(tmp_path)
    np.testing.assert_array_equal(restored_frame.image.counts, frame.image.counts)
    for name in ("sun_direction", "inertial_velocity_m_s", "interval_velocity_m_s"):
        np.testing.assert_array_equal(getattr(restored_frame, name), getattr(frame, name))
    assert repr(restored_frame.altitude) == repr(frame.altitude)
    assert restored_frame.gravity_m_s2 == frame.gravity_m_s2 == 3.72
    assert (restored_frame.attitude.world_from_body.inv() * frame.attitude.world_from_body).magnitude() < 1e-14
    path = tmp_path / "image.json"
    path.write_text(path.read_text().replace('"exchange": 3', '"exchange": 2'))
    with pytest.raises(ValueError, match="is not a valid descent image file: exchange version 2"):
        read_frame(tmp_path)


@pytest.mark.parametrize("image_count", [1, 5])
def test_cases_of_any_image_count_round_trip(tmp_path: Path, image_count: int) -> None:
    moving_sun = replace(inputs.inertial_descent(5), sun_directions=np.eye(5, 3))
    measurements = moving_sun.select(tuple(range(image_count)))
    write_case(tmp_path, measurements)
    restored_case = read_case(tmp_path)
    assert isinstance(restored_case, DescentMeasurements)
    assert hash_inputs([image.counts for image in restored_case.images]) == hash_inputs(
        [image.counts for image in measurements.images]
    )
    np.testing.assert_array_equal(restored_case.interval_velocities_m_s, measurements.interval_velocities_m_s)
    np.testing.assert_array_equal(restored_case.inertial_velocities_m_s, measurements.inertial_velocities_m_s)
    assert hash_inputs(restored_case.increments) == hash_inputs(measurements.increments)
    np.testing.assert_array_equal(restored_case.suns(), np.eye(image_count, 3))
    assert restored_case.gravity_m_s2 == measurements.gravity_m_s2
    # the files of descents without increments have no further keys
    write_case(tmp_path, inputs.descent())
    assert not {"increments", "gravity_m_s2", "sun_directions"} & set(json.loads((tmp_path / "case.json").read_text()))


def make_stream(spec: str) -> ExecutableAlgorithm:
    """Create the stream of a program."""
    command = parse_command(spec)
    assert command is not None
    assert command.stream
    return ExecutableAlgorithm(command, ExecutableLimits(time_s=60.0), VELOCITY_STREAM.requests)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the example, and make Marsyard's packages importable in programs."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("velocity_stream")


def test_example_returns_equal_estimates_in_python_and_as_program(example: ModuleType) -> None:
    measurements = inputs.inertial_descent(5)
    reference = estimate(example.ChainedShifts(), measurements)
    assert reference.velocity_m_s is not None
    error = reference.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2]
    # Errors are within three standard deviations, which are below 1 m/s.
    assert reference.covariance_m2_s2 is not None
    assert np.all(np.abs(error) < 3.0 * np.sqrt(np.diag(reference.covariance_m2_s2)))
    assert np.all(np.diag(reference.covariance_m2_s2) < 1.0)
    # The increments are exact: the integrated velocities equal the inertial velocities of the frames. The inertial
    # velocities of later frames are wrong and must not be used.
    velocities = measurements.inertial_velocities_m_s
    assert velocities is not None
    wrong = replace(
        measurements,
        inertial_velocities_m_s=velocities + 50.0 * (np.arange(5.0) > 0.0)[:, None],
        interval_velocities_m_s=measurements.interval_velocities_m_s + 50.0,
    )
    integrated = estimate(example.IntegratedShifts(), wrong)
    np.testing.assert_allclose(integrated.velocity_m_s, reference.velocity_m_s, atol=1e-6)  # type: ignore[arg-type]
    for option, case, expected in (("", measurements, reference), (" --increments", wrong, integrated)):
        program = make_stream(f"serve-stream:{sys.executable} {EXAMPLES / 'velocity_stream.py'}{option}")
        for _ in range(2):
            actual = estimate(program, case)
            np.testing.assert_allclose(actual.velocity_m_s, expected.velocity_m_s, rtol=0.0, atol=1e-9)  # type: ignore[arg-type]
            np.testing.assert_allclose(actual.covariance_m2_s2, expected.covariance_m2_s2, rtol=1e-12)  # type: ignore[arg-type]
            assert actual.span_s == expected.span_s == (107.5, 107.5)
            assert [item is None for item in actual.after_images] == [True, False, False, False, False]
            assert isinstance(actual.details, ProgramDetails)
            assert actual.details.time_s > 0.0
        end_idle_programs()


#: A program that sends fixed answers without evaluating its requests.
SERVER = """import json, sys
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
for answer in ANSWERS:
    identity = '"exchange": 3, "id": %d' % json.loads(sys.stdin.readline())["id"]
    print(answer.replace('"exchange": 3', identity), flush=True)
"""
#: Answer to an image, before the first velocity.
NO_VELOCITY_YET = '{"exchange": 3, "outcome": null}'


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (
            ['{"exchange": 3, "outcome": "NO_VALID_TRACK"}'],
            "outcome is 'NO_VALID_TRACK'; only process_image and finish",
        ),
        (['{"exchange": 3, "outcome": null, "inertial": 1}'], "unknown key 'inertial'; allowed: exchange, outcome"),
        ([NO_VELOCITY_YET, "3"], "not one JSON object"),
        ([NO_VELOCITY_YET, '{"exchange": 3}'], "outcome is None; allowed: VALID"),
        ([NO_VELOCITY_YET, '{"exchange": 3, "outcome": null, "span_s": [1, 2]}'], "unknown key 'span_s'"),
        (
            [
                NO_VELOCITY_YET,
                NO_VELOCITY_YET,
                '{"exchange": 3, "outcome": "VALID", "velocity_m_s": [1, 2], "span_s": [0, 1]}',
                NO_VELOCITY_YET,
                '{"exchange": 3, "outcome": "NO_VALID_TRACK"}',
            ],
            r"span_s is \(0.0, 1.0\); allowed: within",
        ),
        ([NO_VELOCITY_YET] * 5, "outcome is None; allowed: VALID"),
        ([NO_VELOCITY_YET] * 2, "its output ended without an answer|it closed its input"),
    ],
)
def test_invalid_answers_are_reported_as_faults(tmp_path: Path, answers: list[str], message: str) -> None:
    (tmp_path / "stream.py").write_text(SERVER.replace("ANSWERS", repr(answers)))
    with pytest.raises(AlgorithmError, match=message) as error:
        estimate(make_stream(f"exec-stream:{sys.executable} {tmp_path / 'stream.py'}"), inputs.descent(3))
    assert error.value.fault is (Fault.CRASHED if answers == [NO_VELOCITY_YET] * 2 else Fault.BAD_ANSWER)


def test_example_integrates_increments_in_python_and_as_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """The increments are exact: the integrated velocities equal the inertial velocities of the frames."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.syspath_prepend(str(EXAMPLES))
    example = importlib.import_module("velocity_stream")
    measurements = inputs.inertial_descent(5)
    expected = estimate(example.ChainedShifts(), measurements)
    # the inertial velocities of later frames are wrong and must not be used
    velocities = measurements.inertial_velocities_m_s
    assert velocities is not None
    wrong = replace(
        measurements,
        inertial_velocities_m_s=velocities + 50.0 * (np.arange(5.0) > 0.0)[:, None],
        interval_velocities_m_s=measurements.interval_velocities_m_s + 50.0,
    )
    reference = estimate(example.IntegratedShifts(), wrong)
    np.testing.assert_allclose(reference.velocity_m_s, expected.velocity_m_s, atol=1e-6)  # type: ignore[arg-type]
    program = make_stream(f"serve-stream:{sys.executable} {EXAMPLES / 'velocity_stream.py'} --increments")
    for _ in range(2):
        actual = estimate(program, wrong)
        np.testing.assert_allclose(actual.velocity_m_s, reference.velocity_m_s, rtol=0.0, atol=1e-9)  # type: ignore[arg-type]
    end_idle_programs()
