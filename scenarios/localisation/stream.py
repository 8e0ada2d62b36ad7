"""Measurements of a descent in the order of arrival, schedule of the images, and check of the answers to a descent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.algorithms.answers import check_type
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.answers import check_estimate
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements
from marsyard.sim.parameters import Parameters, bounded_field

#: Margin of the inertial increments before the first and after the last time tag of the other clocks, s: the time tags
#: of the inertial unit have an offset of 0.2 ms rms.
INERTIAL_MARGIN_S = 0.05


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
    def start_inputs(self) -> tuple[InitialState, MapProduct]:
        """Arguments of the method `start` of a position estimator."""
        return self.initial, self.map_product

    def events(self) -> list[ImuIncrements | AltitudeMeasurement | DetectorImage]:
        """Return the measurements in the order of arrival (`ImuIncrements.merge`)."""
        measurements: list[AltitudeMeasurement | DetectorImage] = [*self.altitudes, *self.images]
        return self.increments.merge([(measurement.time_s, measurement) for measurement in measurements])

    def check(self, answer: Any) -> StreamAnswers[PositionEstimate]:
        """Validate the answers of an estimator. Raises AlgorithmError."""
        check_type("the answer", answer, StreamAnswers)
        count, expected = len(answer.after_images), len(self.images)
        if count != expected:
            raise bad_answer(
                f"{count + 1} answers are given to this case; allowed: {expected + 1}, one for each of its {expected} "
                "images and the final one"
            )
        span_s = float(self.increments.times_s[0]), float(self.increments.times_s[-1])
        estimates = [check_estimate(estimate, span_s) for estimate in (*answer.after_images, answer.final)]
        return StreamAnswers(tuple(estimates[:-1]), estimates[-1], answer.image_times_s)
