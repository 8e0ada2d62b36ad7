"""Measurements of a descent in the order of arrival: inputs of a position estimator, and check of its answers."""

from dataclasses import dataclass
from typing import Any

from marsyard.algorithms.answers import check_type
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.exchange import check_estimate
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements

#: Maximum difference between the time of an answer and the time tag of its image, or of the last increment, s. Answers
#: of other programs contain times with a few decimals.
_TIME_TOLERANCE_S = 1e-6


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

    @property
    def answer_times_s(self) -> tuple[float, ...]:
        """Times of the answers: time tags of the images in the order of arrival, then the last increment.

        An image outside of the inertial data has the time of the nearest increment.
        """
        first_s, last_s = (float(self.increments.times_s[index]) for index in (0, -1))
        tags_s = sorted(image.time_s for image in self.images)
        return (*(min(max(tag_s, first_s), last_s) for tag_s in tags_s), last_s)

    def check(self, answer: Any) -> StreamAnswers[PositionEstimate]:
        """Validate the answers of an estimator, which have the times `answer_times_s`. Raises AlgorithmError."""
        check_type("the answer", answer, StreamAnswers)
        count, expected = len(answer.after_images), len(self.images)
        if count != expected:
            raise bad_answer(
                f"{count + 1} answers are given to this case; allowed: {expected + 1}, one for each of its {expected} "
                "images and the final one"
            )
        estimates = [check_estimate(estimate) for estimate in (*answer.after_images, answer.final)]
        for number, (estimate, time_s) in enumerate(zip(estimates, self.answer_times_s, strict=True), start=1):
            if abs(estimate.time_s - time_s) > _TIME_TOLERANCE_S:
                name, allowed = f"image {number}", "its time tag inside the inertial data"
                if number > expected:
                    name, allowed = "finish", "the last increment"
                raise bad_answer(
                    f"time_s of the answer to {name} is {estimate.time_s} s; allowed: {time_s} s, {allowed}"
                )
        return StreamAnswers(tuple(estimates[:-1]), estimates[-1], answer.image_times_s)
