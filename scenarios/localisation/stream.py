"""Measurement stream of a descent in the order of arrival, and the run of a position estimator over it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Annotated, Any, TypeVar

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.algorithms.exchange import ProgramDetails
from marsyard.algorithms.localisation.exchange import ExecutablePositionEstimator
from marsyard.algorithms.localisation.interface import (
    InitialState,
    MapProduct,
    PositionEstimate,
    PositionEstimator,
    PositionOutcome,
)
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements
from marsyard.sim.parameters import Parameters, bounded_field

#: Margin of the inertial increments before the first and after the last time tag of the other clocks, s: the time tags
#: of the inertial unit have an offset of 0.2 ms rms.
INERTIAL_MARGIN_S = 0.05
#: One event of the stream.
Event = ImuIncrements | AltitudeMeasurement | DetectorImage
Data = TypeVar("Data")
Result = TypeVar("Result")


class ImageSchedule(Parameters):
    """Times of the images: those of the coarse stage first (0.3 Hz, Mars 2020), then those of the fine stage.

    Mars 2020 took up to one image per second in the fine stage; the default of 0.5 Hz is assumed.
    """

    first_s: Annotated[float, bounded_field(INERTIAL_MARGIN_S, 60.0, "first image, after the start")] = 0.5
    coarse_images: Annotated[int, Field(ge=0, le=100, description="images of the coarse stage")] = 3
    coarse_interval_s: Annotated[float, bounded_field(0.1, 60.0, "time after each image of the coarse stage")] = 3.3
    interval_s: Annotated[float, bounded_field(0.1, 60.0, "time between images of the fine stage")] = 2.0

    def times(self, start_s: float, end_s: float) -> Float64[np.ndarray, "images"]:
        """Compute the nominal times of the images from start to end (included)."""
        first, coarse = start_s + self.first_s, self.coarse_interval_s * np.arange(self.coarse_images + 1)
        count = max(int((end_s - first - coarse[-1]) / self.interval_s) + 1, 0)
        times = np.concatenate([first + coarse[:-1], first + coarse[-1] + self.interval_s * np.arange(count)])
        return np.asarray(times[times <= end_s])


def merge(
    increments: ImuIncrements, altitudes: Sequence[AltitudeMeasurement], images: Sequence[DetectorImage]
) -> list[Event]:
    """Merge measurements into the order of their time tags, with the increments split at each altitude and image.

    The parts are those of `ImuIncrements.split` without the empty ones. Measurements with time tags outside of the
    increments come before or after all of them.
    """
    measurements: list[AltitudeMeasurement | DetectorImage] = sorted([*altitudes, *images], key=lambda m: m.time_s)
    times = np.clip([m.time_s for m in measurements], increments.times_s[0], increments.times_s[-1])
    parts = increments.split(times.tolist())
    events: list[Event] = []
    for part, measurement in zip(parts, [*measurements, None], strict=True):
        events += [part] if part.times_s.size > 1 else []
        events += [] if measurement is None else [measurement]
    return events


@dataclass(frozen=True)
class LocalisationMeasurements:
    """All measurements of a descent, with the initial state and the map: the inputs of a position estimator.

    - images, altitudes: in the order of their time tags; lost images and missing readings are omitted
    """

    initial: InitialState
    map_product: MapProduct
    increments: ImuIncrements
    altitudes: tuple[AltitudeMeasurement, ...]
    images: tuple[DetectorImage, ...]

    @property
    def events(self) -> list[Event]:
        """Measurements in the order of arrival; see `merge`."""
        return merge(self.increments, self.altitudes, self.images)


@dataclass(frozen=True)
class ProcessorTimes:
    """Processor time of each call of an estimator, s; one value per call of `imu`, `altitude` and `image`.

    For an external program, the wall-clock time of its answer.
    """

    start_s: float
    imu_s: tuple[float, ...]
    altitude_s: tuple[float, ...]
    image_s: tuple[float, ...]
    finish_s: float

    @property
    def total_s(self) -> float:
        """Processor time of all calls."""
        return self.start_s + sum(self.imu_s) + sum(self.altitude_s) + sum(self.image_s) + self.finish_s


@dataclass(frozen=True)
class StreamAnswers:
    """Answers of an estimator to a stream.

    - estimates: one per image, in the order of arrival, and the final one
    - processor_times: of the calls
    """

    estimates: tuple[PositionEstimate, ...]
    processor_times: ProcessorTimes

    @property
    def outcome(self) -> PositionOutcome:
        """Outcome of the final estimate."""
        return self.estimates[-1].outcome

    @property
    def details(self) -> ProgramDetails | None:
        """Standard error and wall-clock time of an external program in the whole descent; None for a Python class."""
        details = self.estimates[-1].details
        return details if isinstance(details, ProgramDetails) else None


def feed(
    estimator: PositionEstimator, initial: InitialState, map_product: MapProduct, events: Sequence[Event]
) -> StreamAnswers:
    """Run an estimator over a stream; it receives read-only arrays. Its exceptions are not handled."""
    start_s = _measure_time(estimator, lambda: estimator.start(_read_only(initial), _read_only(map_product)))[1]
    estimates: list[PositionEstimate] = []
    imu_s: list[float] = []
    altitude_s: list[float] = []
    image_s: list[float] = []
    for event in events:
        data = _read_only(event)
        if isinstance(data, ImuIncrements):
            imu_s.append(_measure_time(estimator, partial(estimator.imu, data))[1])
        elif isinstance(data, AltitudeMeasurement):
            altitude_s.append(_measure_time(estimator, partial(estimator.altitude, data))[1])
        else:
            estimate, elapsed_s = _measure_time(estimator, partial(estimator.image, data))
            estimates.append(estimate)
            image_s.append(elapsed_s)
    final, finish_s = _measure_time(estimator, estimator.finish)
    times = ProcessorTimes(start_s, tuple(imu_s), tuple(altitude_s), tuple(image_s), finish_s)
    return StreamAnswers((*estimates, final), times)


def _measure_time(estimator: PositionEstimator, call: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of a call, and its processor time, s; the wall-clock time of a program's answer."""
    start_s = time.process_time()
    result = call()
    elapsed_s = time.process_time() - start_s
    return result, estimator.request_time_s if isinstance(estimator, ExecutablePositionEstimator) else elapsed_s


def _read_only(data: Data) -> Data:
    """Return a copy of a data class whose arrays are read-only views, also those of data classes in its fields.

    Arrays of camera models are always read-only.
    """
    changes: dict[str, Any] = {}
    for field in fields(data):  # type: ignore[arg-type]
        value = getattr(data, field.name)
        if isinstance(value, np.ndarray):
            changes[field.name] = value.view()
            changes[field.name].setflags(write=False)
        elif field.name == "calibration" and is_dataclass(value):
            changes[field.name] = _read_only(value)
    return replace(data, **changes)  # type: ignore[type-var]
