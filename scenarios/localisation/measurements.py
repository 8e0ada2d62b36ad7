"""Measurements of a descent in the order of arrival: inputs of a position estimator, and check of its answers."""

from dataclasses import dataclass
from typing import Any

from marsyard.algorithms.answers import check_type
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.exchange import check_estimate
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements


@dataclass(frozen=True)
class LocalisationMeasurements:
    """All measurements of a descent, with the initial state and the map: the inputs of a position estimator.

    - images, altitudes: in the order of their true times, which that of the time tags can differ from; lost images and
      missing readings are omitted
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
