"""Tests of the measurement stream: order of events, time tags, and the run of an estimator."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.scenarios.localisation.camera import LanderCameraParameters, true_camera
from marsyard.scenarios.localisation.flight import LanderFlight
from marsyard.scenarios.localisation.instruments import IMAGE_CLOCK
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.localisation.parameters import ImageSchedule
from marsyard.scenarios.streamed import StreamAnswers, StreamedEstimator
from marsyard.sim.measurements import AltitudeMeasurement, DetectorCalibration, DetectorImage, ImuIncrements
from marsyard.sim.sensor import Clock, Imu
from marsyard.sim.sensor.imu import LN200, true_increments

#: True start and end of the inertial data, s.
SPAN_S = (0.0, 6.0)
CAMERA = true_camera(LanderCameraParameters(pixels=64, pixel_mrad=26.0))


def _make_image(tag_s: float) -> DetectorImage:
    """Return a black image of 64 x 64 pixels with a time tag; its calibration is not used."""
    calibration = DetectorCalibration(np.ones((64, 64)), 150e-6, 0.0, 0.0, 1, 2.0, 255)
    return DetectorImage(np.zeros((64, 64), dtype=np.uint16), tag_s, CAMERA, calibration)


@pytest.fixture(scope="module")
def increments(flight: LanderFlight) -> ImuIncrements:
    """Return the increments of an LN-200 over six seconds of the flight."""
    rng = np.random.default_rng(4)
    return Imu.draw(LN200, SPAN_S, rng).increments(flight, *SPAN_S, rng)


#: Initial state and map; the recorded estimator does not use their values.
INITIAL = InitialState(0.0, np.zeros(3), np.zeros(3), Rotation.identity(), np.eye(9), 3.72)
MAP = MapProduct(
    np.zeros((2, 2), dtype=np.float32), np.zeros((2, 2), dtype=np.float32), np.zeros(2), 6.0, 1.0, 1.0, 1.0
)


class Recorder(InertialEstimator):
    """An estimator that records its measurements."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[object] = []

    def process_increments(self, increments: ImuIncrements) -> None:
        """Record increments."""
        self.calls.append(increments)
        super().process_increments(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Record an altitude."""
        self.calls.append(measurement)

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Record an image."""
        self.calls.append(image)
        return super().process_image(image)


Run = tuple[Recorder, StreamAnswers[PositionEstimate]]


@pytest.fixture(scope="module")
def run(increments: ImuIncrements) -> Run:
    """Run a stream with 10 altitudes per second, two of them at one time, and three images."""
    altitudes = [AltitudeMeasurement(4000.0, 0.1 * number + 0.03) for number in range(59)]
    altitudes.append(AltitudeMeasurement(4000.0, 1.03))
    images = [_make_image(tag) for tag in (4.5001, 0.5002, 1.03)]
    recorder = Recorder()
    measurements = LocalisationMeasurements(INITIAL, MAP, increments, tuple(altitudes), tuple(images))
    return recorder, StreamedEstimator(recorder).estimate(measurements)


def test_increments_arrive_before_their_measurement(run: Run, increments: ImuIncrements) -> None:
    """Increments arrive in batches between measurements. No increment is lost or repeated.

    A batch ends at the first boundary that is not before the next measurement.
    """
    calls = run[0].calls
    batches: list[ImuIncrements] = []
    latest = -np.inf
    for call in calls:
        if isinstance(call, ImuIncrements):
            assert call.times_s.size == len(call.delta_angles_rad) + 1 == len(call.delta_velocities_m_s) + 1 > 1
            if batches:
                assert call.times_s[0] == batches[-1].times_s[-1]
            batches.append(call)
        else:
            assert isinstance(call, AltitudeMeasurement | DetectorImage)
            assert call.time_s >= latest
            latest = call.time_s
            assert batches[-1].times_s[-2] < call.time_s <= batches[-1].times_s[-1]
    np.testing.assert_array_equal(
        np.concatenate([batch.delta_angles_rad for batch in batches]), increments.delta_angles_rad
    )
    np.testing.assert_array_equal(
        np.concatenate([batch.delta_velocities_m_s for batch in batches]), increments.delta_velocities_m_s
    )
    assert batches[-1].times_s[-1] == increments.times_s[-1]


def test_each_image_has_an_answer(run: Run, increments: ImuIncrements) -> None:
    """One estimate per image in the order of time, and the final one; each image's processor time is measured."""
    answers = run[1]
    expected = [0.5002, 1.03, 4.5001, float(increments.times_s[-1])]
    assert [estimate.time_s for estimate in answers.estimates] == expected
    assert len(answers.image_times_s) == 3
    assert min(answers.image_times_s) >= 0.0


def test_measurements_outside_of_the_increments_are_first_or_last(increments: ImuIncrements) -> None:
    """A wrong clock causes such time tags. The measurements are still delivered, and no increment is lost."""
    early, late = AltitudeMeasurement(4000.0, -0.5), _make_image(6.5)
    measurements = LocalisationMeasurements(INITIAL, MAP, increments, (early,), (late, _make_image(3.0)))
    events = measurements.events()
    assert events[0] is early
    assert events[-1] is late
    batches = [event for event in events if isinstance(event, ImuIncrements)]
    assert [batch.times_s[0] for batch in batches] == [increments.times_s[0], batches[0].times_s[-1]]
    assert batches[-1].times_s[-1] == increments.times_s[-1]


@pytest.mark.parametrize(
    ("answer", "error_s", "message"),
    [
        (0, 1e-5, r"answer to image 1 is 1.00001 s; allowed: 1.0 s, its time tag"),
        (1, -1.0, r"answer to image 2 is 2.0 s; allowed: 3.0 s"),
        # a state of the descent, reported after its end
        (3, -2.0, r"answer to finish is .*; allowed: .* the last increment"),
    ],
)
def test_answer_with_another_time_is_bad(increments: ImuIncrements, answer: int, error_s: float, message: str) -> None:
    """The third image is tagged after the inertial data; its answer has the time of the last increment."""
    images = tuple(_make_image(tag) for tag in (3.0, 6.5, 1.0))
    measurements = LocalisationMeasurements(INITIAL, MAP, increments, (), images)
    last_s = float(increments.times_s[-1])
    times_s = np.array([1.0, 3.0, last_s, last_s])
    assert measurements.answer_times_s == tuple(times_s)

    def check(times_s: np.ndarray) -> None:
        estimates = [PositionEstimate(PositionOutcome.UNCERTAIN, float(time_s)) for time_s in times_s]
        measurements.check(StreamAnswers(tuple(estimates[:-1]), estimates[-1]))

    # less than the tolerance of 1 us
    check(times_s + 5e-7)
    with pytest.raises(AlgorithmError, match=message) as caught:
        check(times_s + error_s * (np.arange(4) == answer))
    assert caught.value.fault is Fault.BAD_ANSWER


def test_images_follow_the_schedule(flight: LanderFlight) -> None:
    """Three images at 0.3 Hz, then images at equal intervals: 20 to 27 until the end, none after it."""
    schedule = ImageSchedule()
    times = schedule.times(0.0, flight.end_s)
    assert 20 <= times.size <= 27
    np.testing.assert_allclose(np.diff(times[:4]), schedule.coarse_interval_s)
    np.testing.assert_allclose(np.diff(times[3:]), schedule.interval_s)
    assert times[-1] <= flight.end_s < times[-1] + schedule.interval_s
    np.testing.assert_array_equal(ImageSchedule(first_s=1.0).times(2.0, 8.0), [3.0, 6.3])
    assert ImageSchedule().times(0.0, 0.1).size == 0


def test_measurements_contain_no_truth(flight: LanderFlight, increments: ImuIncrements) -> None:
    """Time tags of increments and images have the errors of their clocks; no increment equals its true value."""
    rng = np.random.default_rng(8)
    true_times = ImageSchedule().times(0.0, flight.end_s)
    assert np.all(Clock.draw(IMAGE_CLOCK, rng).tags(true_times, rng) != true_times)
    # the constant offset of this unit's clock, from its drawn errors
    unit = Imu.draw(LN200, SPAN_S, np.random.default_rng(4))
    boundaries = unit.boundaries(*SPAN_S)
    errors = increments.times_s - boundaries
    assert unit.clock.offset_s != 0.0
    assert errors.mean() == pytest.approx(unit.clock.offset_s, abs=4.0 * LN200.clock.jitter_sd_s / np.sqrt(errors.size))
    assert errors.std() == pytest.approx(LN200.clock.jitter_sd_s, rel=0.1)
    angles, velocities = true_increments(flight, boundaries)
    assert np.all(increments.delta_angles_rad != angles)
    assert np.all(increments.delta_velocities_m_s != velocities)
