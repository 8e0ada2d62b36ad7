"""The checks of estimators that take pictures one by one: those of any estimator, and of how many they are given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.estimators import VELOCITY, EstimatorSuite
from marsyard.scenarios.conformance.findings import BreachError, Check
from marsyard.scenarios.conformance.process import fingerprint, own_copy
from marsyard.sim.measurements import DescentMeasurements

#: Pictures of an ordinary descent, of which some checks take the first ones alone, and of a long one.
PICTURES, MANY = 5, 10
_FEW, _ENOUGH = (0, 1), (2, 3)

#: What is asked of any estimator, over more than three pictures.
STREAM = replace(VELOCITY, measurements=partial(inputs.descent, PICTURES))


@dataclass(frozen=True)
class StreamSuite:
    """The suite of one stream, made anew for each check. See `EstimatorSuite`; `make` makes a `StreamedEstimator`."""

    make: Callable[[], Any]
    spec: str
    program: bool
    limit_s: float

    def checks(self) -> Iterator[Check]:
        """All of them, the ordinary descent first."""
        yield from EstimatorSuite(STREAM, self.make, self.spec, self.program, self.limit_s).checks()
        advice = f"return one of the failures from finish: {VELOCITY.failures}"
        yield Check("few", "ends with a failure where there is no picture, or one", advice, self._fails_on_few)
        yield Check(
            "number",
            f"gives a well-formed answer to {', '.join(map(str, _ENOUGH))} and {MANY} pictures",
            "expect any number: see VelocityStream in algorithms/interface.py",
            self._answers_any_number,
        )
        yield Check(
            "start", "forgets a descent that was broken off", "forget in start all that was kept", self._starts_anew
        )

    def _ask(self, measurements: DescentMeasurements) -> VelocityEstimate:
        answer: VelocityEstimate = self.make().estimate(own_copy(measurements))
        return answer

    def _fails_on_few(self) -> str:
        outcomes = []
        for number in _FEW:
            answer = self._ask(_first(number))
            if VELOCITY.claims(answer):
                raise BreachError(f"it answers {answer.outcome.name} to {number or 'no'} picture: nothing has moved")
            outcomes.append(answer.outcome.name)
        return ", ".join(outcomes)

    def _answers_any_number(self) -> str:
        answers = [self._ask(given) for given in (*map(_first, _ENOUGH), inputs.descent(MANY))]
        return "; ".join(VELOCITY.told(answer) for answer in answers)

    def _starts_anew(self) -> str:
        measurements = STREAM.measurements()
        expected = fingerprint(self._ask(measurements))
        kept = self.make()
        kept.stream.start()
        for frame in own_copy(inputs.noisy(measurements)).frames()[:2]:
            kept.stream.picture(frame)
        if fingerprint(kept.estimate(own_copy(measurements))) != expected:
            raise BreachError("started again after two pictures, it answers differently")
        return ""


def _first(number: int) -> DescentMeasurements:
    """A descent of which only the first pictures were taken."""
    chosen: DescentMeasurements = STREAM.measurements().chosen(tuple(range(number)))
    return chosen
