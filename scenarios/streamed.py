"""Streams in cases: the measurements of a case are passed one by one to an estimator, and its answers are collected."""

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from marsyard.algorithms.exchange import answer_time_s
from marsyard.scenarios.isolation.remote import algorithm_time_s
from marsyard.sim.measurements import AltitudeMeasurement, ImuIncrements

Answer = TypeVar("Answer")

#: Methods of a stream, in calling order (`marsyard.algorithms.interface.ImageStream`).
STREAM_METHODS = ("start", "process_image", "finish")


class StreamMeasurements(Protocol):
    """Measurements of a case that a stream can receive."""

    @property
    def start_inputs(self) -> tuple[Any, ...]:
        """Arguments of the stream's method `start`."""

    def events(self) -> list[Any]:
        """Return increments, altitudes and images in the order of their arrival."""


@dataclass(frozen=True)
class StreamAnswers(Generic[Answer]):
    """Answers of a stream to the measurements of a case.

    - after_images: answers to the images, in the order of arrival; None for no answer
    - final: final answer
    - image_times_s: computation times of the images: processor time, or wall-clock time of a program's answer; empty if
      unknown
    """

    after_images: tuple[Answer, ...]
    final: Answer
    image_times_s: tuple[float, ...] = ()

    @property
    def estimates(self) -> tuple[Answer, ...]:
        """The answers to the images, and the final one."""
        return (*self.after_images, self.final)

    @property
    def outcome(self) -> Any:
        """Outcome of the final answer."""
        return getattr(self.final, "outcome", None)

    @property
    def details(self) -> Any:
        """Details of the final answer; those of a program contain its output and time in the whole case."""
        return getattr(self.final, "details", None)


@dataclass(frozen=True)
class StreamedEstimator:
    """Estimator that passes the measurements of a case one by one to a stream."""

    stream: Any

    def estimate(self, measurements: StreamMeasurements) -> StreamAnswers[Any]:
        """Return the answers, unchecked."""
        self.stream.start(*measurements.start_inputs)
        answers, times_s = [], []
        for event in measurements.events():
            start_s = algorithm_time_s()
            answer = self.process(event)
            if is_image(event):
                answers.append(answer)
                times_s.append(answer_time_s(answer, algorithm_time_s() - start_s))
        return StreamAnswers(tuple(answers), self.stream.finish(), tuple(times_s))

    def process(self, event: Any) -> Any:
        """Pass a measurement to the stream's method for its type, if it has one; return the answer."""
        if is_image(event):
            return self.stream.process_image(event)
        name = "process_increments" if isinstance(event, ImuIncrements) else "process_altitude"
        method = getattr(self.stream, name, None)
        return None if method is None else method(event)


def is_image(event: object) -> bool:
    """Return whether a measurement is an image, alone or with further measurements."""
    return not isinstance(event, ImuIncrements | AltitudeMeasurement)
