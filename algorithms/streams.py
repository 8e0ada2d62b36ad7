"""Streams of pictures as velocity estimators: one protocol for three pictures and for any number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from marsyard.algorithms.answers import checked_velocity
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import VelocityEstimate, VelocityStream
from marsyard.sim.measurements import DescentMeasurements

#: What a stream has, in the order in which it is called.
STREAM_METHODS = ("start", "picture", "finish")
#: Pictures that an interval lies between.
_INTERVAL = 2


@dataclass(frozen=True)
class StreamedEstimator:
    """A stream as a `VelocityEstimator`: it is handed the pictures of a descent one by one, however many there are."""

    stream: VelocityStream

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The stream's last answer, with those before it.

        Raises
        ------
        AlgorithmError
            Where an answer is not of the interface's form, or looks ahead of the pictures that were handed over.
        """
        tags = measurements.tags_s
        self.stream.start()
        earlier: list[VelocityEstimate | None] = []
        for number, frame in enumerate(measurements.frames(), start=1):
            answer = self.stream.picture(frame)
            earlier.append(None if answer is None else spanned(_alone(answer), tags[:number]))
        final = spanned(_alone(self.stream.finish()), tags)
        return replace(final, after_pictures=tuple(earlier))


def spanned(answer: object, tags_s: Sequence[float]) -> VelocityEstimate:
    """An answer, valid by the interface, to pictures of these tags, with the span stated that it is the mean over.

    Raises
    ------
    AlgorithmError
        BAD_ANSWER, and what is wrong with it.
    """
    estimate = checked_velocity(answer, tags_s)
    if estimate.span_s is not None or len(tags_s) < _INTERVAL:
        return estimate
    return replace(estimate, span_s=(tags_s[-2], tags_s[-1]))


def _alone(answer: object) -> object:
    """The answer, if it says nothing of those before it: that is said for it."""
    if isinstance(answer, VelocityEstimate) and answer.after_pictures:
        raise AlgorithmError(Fault.BAD_ANSWER, "after_pictures is given; allowed: nothing there, it is filled in")
    return answer
