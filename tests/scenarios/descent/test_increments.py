"""Tests of inertial increments, the angle and velocity changes that estimators receive: truth, errors and order."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import chi2

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.campaigns.running.replay import differing_columns
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.descent.flight import DescentFlight, create_flight, gravity_m_s2
from marsyard.scenarios.descent.measurements import add_increments
from marsyard.sim.measurements import AltitudeMeasurement, DescentFrame, DescentMeasurements, ImuIncrements
from marsyard.sim.sensor import InertialSolution
from marsyard.sim.sensor.imu import DEG_H, IMUS, MILLI_G, ImuClass
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface
from tests.scenarios.descent.descents import make_parameters, run_descent
from tests.scenarios.descent.test_many_images import InertialEstimator

RECORDER = "tests.scenarios.descent.test_increments:EventRecorder"
FLAT_GROUND = Surface.from_samples(np.zeros((16, 16, 2), np.float32), 200.0)
#: Measurements that `EventRecorder` received, in order.
EVENTS: list[ImuIncrements | AltitudeMeasurement | DescentFrame] = []


class EventRecorder(InertialEstimator):
    """Estimator that records its measurements in `EVENTS`."""

    def process_increments(self, increments: ImuIncrements) -> None:
        EVENTS.append(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        EVENTS.append(measurement)

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        EVENTS.append(frame)
        return super().process_image(frame)


@pytest.fixture(autouse=True)
def _clear_events() -> Iterator[None]:
    yield
    EVENTS.clear()


def measure(case: int = 0, /, **tables: Any) -> tuple[DescentMeasurements, DescentFlight]:
    """Simulate a flight over flat ground; return measurements with its increments, and the flight.

    The images of the measurements are those of `inputs.descent()`; the tests do not use them.
    """
    parameters, streams = make_parameters(**tables), Streams(1, "test", case)
    flight = create_flight(parameters, FLAT_GROUND, streams)
    measurements = add_increments(inputs.descent(), parameters, flight, streams)
    if measurements.increments is not None:
        assert measurements.gravity_m_s2 == gravity_m_s2(parameters)
    return measurements, flight


def propagate(measurements: DescentMeasurements, flight: DescentFlight) -> InertialSolution:
    """Propagate the true state at the first boundary with the increments."""
    increments, gravity = measurements.increments, measurements.gravity_m_s2
    assert increments is not None
    assert gravity is not None
    # the increments start 0.1 s after the start of the flight
    start = flight.motion.state(-flight.lead_s + 0.1)
    return InertialSolution.propagate(increments, start.attitude, start.velocity_m_s, gravity)


@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 400.0])
def test_exact_increments_integrate_to_the_true_motion(rate_hz: float) -> None:
    measurements, flight = measure(exact_instruments=True, inertial={"rate_hz": rate_hz})
    solution = propagate(measurements, flight)
    times = solution.increments.times_s
    truth = flight.motion.motion(times)
    assert solution.increments.period_s == 1.0 / rate_hz
    assert times[0] < -4.0
    assert flight.firing_s < times[-1] < flight.firing_s + 0.11
    assert np.abs(solution.velocities_m_s - truth.velocities_m_s).max() < 1e-6
    # the rotation vectors are exact; this is the rounding of the magnitude of small rotations
    assert (solution.attitudes.inv() * truth.attitudes).magnitude().max() < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("imu_class", ["ln-200", "mems"])
def test_errors_of_increments_are_those_of_the_class(imu_class: ImuClass) -> None:
    """Mean increments minus the true ones have the variance of the biases; scale and alignment errors add to it."""
    p, cases, rate_hz = IMUS[imu_class], 10, 100.0
    errors: dict[str, list[Any]] = {"gyro": [], "accelerometer": []}
    for case in range(cases):
        values = {"inertial": {"rate_hz": rate_hz, "imu_class": imu_class}}
        measured, exact = (measure(case, **values, exact_instruments=is_exact)[0].increments for is_exact in (0, 1))
        # offset and jitter of the unit's clock: 0.2 ms and 0.02 ms
        tag_errors = measured.times_s - exact.times_s
        assert 0.0 < np.abs(tag_errors).max() < 2e-3
        assert 0.0 < tag_errors.std() < 1e-4
        errors["gyro"].append(np.mean(measured.delta_angles_rad - exact.delta_angles_rad, axis=0))
        errors["accelerometer"].append(np.mean(measured.delta_velocities_m_s - exact.delta_velocities_m_s, axis=0))
    biases = {
        "gyro": np.hypot(p.gyro_bias_deg_h, p.gyro_wander_deg_h) * DEG_H,
        "accelerometer": np.hypot(p.accelerometer_bias_mg, p.accelerometer_wander_mg) * MILLI_G,
    }
    low, high = (float(chi2.ppf(level, 3 * cases)) / (3 * cases) for level in (1e-4, 1.0 - 1e-4))
    # random walk, scale factors and misalignment contribute up to 20 times (gyros) and 1.2 times the variance of biases
    assert low < np.mean(np.square(errors["gyro"])) * rate_hz**2 / biases["gyro"] ** 2 < 20.0 * high
    ratio = np.mean(np.square(errors["accelerometer"])) * rate_hz**2 / biases["accelerometer"] ** 2
    assert low < ratio < 1.2 * high


@pytest.mark.parametrize("rate_hz", [-1.0, 1.0, 49.9, 400.1])
def test_other_rates_are_rejected(rate_hz: float) -> None:
    with pytest.raises(ValidationError, match="rate_hz"):
        make_parameters(inertial={"rate_hz": rate_hz})


def test_increments_arrive_in_order_and_change_no_other_measurement() -> None:
    """Two descents with the same images: one without increments, one with increments at 100 Hz."""
    # in this process, so that the estimator records its measurements here
    values: dict[str, Any] = {"algorithm": RECORDER, "images": 2, "executable": {"isolated": False}}
    without = run_descent(**values)
    frames = [event for event in EVENTS if isinstance(event, DescentFrame)]
    assert len(EVENTS) == len(frames) == 2
    EVENTS.clear()
    with_increments = run_descent(**values, inertial={"rate_hz": 100.0})
    assert with_increments.outcome == "VALID"
    assert with_increments.row["image_hash"] == without.row["image_hash"]
    assert differing_columns(dict(without.row), dict(with_increments.row)) == ()
    assert [type(event) for event in EVENTS] == [*(ImuIncrements, AltitudeMeasurement, ImuIncrements, DescentFrame) * 2]
    boundaries = [event.times_s for event in EVENTS if isinstance(event, ImuIncrements)]
    tags = [
        event.time_s if isinstance(event, AltitudeMeasurement) else event.image.time_s
        for event in EVENTS
        if not isinstance(event, ImuIncrements)
    ]
    for times, tag in zip(boundaries, tags, strict=True):
        assert times[-2] < tag <= times[-1]
    for first, second in pairwise(boundaries):
        assert first[-1] == second[0]
