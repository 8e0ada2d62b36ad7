"""Streams of pictures as velocity estimators: one protocol for three pictures and for any number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from marsyard.algorithms.answers import bad_answer, check_velocity
from marsyard.algorithms.interface import VelocityEstimate, VelocityStream
from marsyard.sim.measurements import DescentMeasurements

#: Methods of a stream, in the order of the calls.
STREAM_METHODS = ("start", "picture", "finish")


@dataclass(frozen=True)
class StreamedEstimator:
    """A stream as a `VelocityEstimator`: it gets the images of a descent one by one, in any number."""

    stream: VelocityStream

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The stream's final answer with its earlier ones; raises AlgorithmError for an answer of the wrong form."""
        tags = measurements.tags_s
        self.stream.start()
        earlier: list[VelocityEstimate | None] = []
        for number, frame in enumerate(measurements.frames(), start=1):
            answer = self.stream.picture(frame)
            earlier.append(None if answer is None else _check_answer(answer, tags[:number]))
        final = _check_answer(self.stream.finish(), tags)
        return replace(final, after_pictures=tuple(earlier))


def set_span(answer: object, tags_s: Sequence[float]) -> VelocityEstimate:
    """The valid answer to images of these tags, by default over the last interval; raises as `check_velocity`."""
    estimate = check_velocity(answer, tags_s)
    if estimate.span_s is not None or len(tags_s) < 2:
        return estimate
    return replace(estimate, span_s=(tags_s[-2], tags_s[-1]))


def _check_answer(answer: object, tags_s: Sequence[float]) -> VelocityEstimate:
    if isinstance(answer, VelocityEstimate) and answer.after_pictures:
        raise bad_answer("after_pictures is given; allowed: nothing there, it is filled in")
    return set_span(answer, tags_s)
