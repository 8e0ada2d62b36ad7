"""Conformance checks of velocity estimators, for three images or a stream of images, and of landing site estimators."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.answers import check_site, check_velocity
from marsyard.algorithms.interface import SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.algorithm_run import copy_inputs
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.checks import BreachError, Check, Suite, fingerprint
from marsyard.sim.measurements import DescentMeasurements

#: Number of images of an ordinary stream, and of a long stream.
_STREAM_LENGTH, _LONG_LENGTH = 5, 10
#: Numbers of images of streams that are too short for a velocity, and of short but sufficient streams.
_INSUFFICIENT_LENGTHS, _SHORT_LENGTHS = (0, 1), (2, 3)


@dataclass(frozen=True)
class Protocol:
    """Measurements of a task, and the rules for its answers.

    - measurements: creates the input of an ordinary case
    - check: returns a valid answer; raises AlgorithmError for an answer that does not conform to the interface
    - is_valid: whether an answer contains a result (a velocity or a site)
    - describe: formats an answer
    - failures: outcomes without a result, as text
    """

    measurements: Callable[[], Any]
    check: Callable[[object], Any]
    is_valid: Callable[[Any], bool]
    describe: Callable[[Any], str]
    failures: str


def describe_velocity(estimate: VelocityEstimate) -> str:
    """Return the outcome of an estimate, and its error relative to the truth of the suite's descents."""
    if estimate.velocity_m_s is None:
        return estimate.outcome.name
    error = float(np.hypot(*(estimate.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2])))
    return f"{estimate.outcome.name}, {error:.2f} m/s error"


VELOCITY = Protocol(
    measurements=inputs.descent,
    check=check_velocity,
    is_valid=lambda estimate: estimate.outcome is VelocityOutcome.VALID,
    describe=describe_velocity,
    failures=", ".join(outcome.name for outcome in VelocityOutcome if outcome is not VelocityOutcome.VALID),
)
STREAM = replace(VELOCITY, measurements=partial(inputs.inertial_descent, _STREAM_LENGTH))
LANDING = Protocol(
    measurements=inputs.landing,
    check=check_site,
    is_valid=lambda estimate: estimate.outcome.converged,
    describe=lambda estimate: str(estimate.outcome.name),
    failures=", ".join(outcome.name for outcome in SiteOutcome if not outcome.converged),
)


@dataclass(frozen=True)
class EstimatorSuite(Suite):
    """Suite of one estimator; with the protocol `STREAM`, `make` constructs a `StreamedEstimator`."""

    protocol: Protocol

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        protocol = self.protocol
        advice = "see algorithms/interface.py for the format of the answer"
        rule = "returns a well-formed answer to textured images"
        yield Check("answer", rule, advice, lambda: protocol.describe(self._answer(protocol.measurements())))
        advice = f"return one of the failures: {protocol.failures}"
        for name, blank in inputs.BLANKS.items():
            rule = f"returns a failure if images are {name}"
            yield Check(name, rule, advice, partial(self._check_blank_images, name, blank))
        rule = "returns a well-formed answer to images of noise"
        yield Check("noise", rule, advice, lambda: self._describe_outcome(inputs.make_noisy(protocol.measurements())))
        if protocol is LANDING:
            rule = "returns a well-formed answer without a range"
            no_range = replace(inputs.landing(), slant_range_m=float("nan"))
            yield Check("no-range", rule, advice, lambda: self._describe_outcome(no_range))
        yield from self.common_checks()
        if protocol is STREAM:
            advice = f"return one of the failures from finish: {VELOCITY.failures}"
            yield Check("few", "returns a failure for zero images and for one image", advice, self._check_short_streams)
            rule = f"returns a well-formed answer to {', '.join(map(str, _SHORT_LENGTHS))} and {_LONG_LENGTH} images"
            advice = "accept any number: see VelocityStream in algorithms/interface.py"
            streams = (*map(_select_first_images, _SHORT_LENGTHS), inputs.inertial_descent(_LONG_LENGTH))
            yield Check(
                "number", rule, advice, lambda: "; ".join(describe_velocity(self._answer(stream)) for stream in streams)
            )
            rule, advice = "returns a well-formed answer without inertial increments", "use the inertial velocities"
            yield Check("no-increments", rule, advice, lambda: describe_velocity(self._answer(_without_increments())))
            rule, advice = "resets its state after an interrupted descent", "reset the whole state in start"
            yield Check("start", rule, advice, self._check_restart)

    def cases(self) -> Sequence[Any]:
        """See `Suite`."""
        return [self.protocol.measurements()]

    def _other_cases(self) -> Sequence[Any]:
        return [inputs.make_noisy(self.protocol.measurements())]

    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        return algorithm.estimate(case)

    def _check_answer(self, answer: Any, case: Any) -> Any:
        return self.protocol.check(answer)

    def _describe_outcome(self, measurements: Any) -> str:
        return str(self._answer(measurements).outcome.name)

    def _check_blank_images(self, name: str, blank: inputs.Blank) -> str:
        answer = self._answer(inputs.make_blank(self.protocol.measurements(), blank))
        if self.protocol.is_valid(answer):
            raise BreachError(f"it answers {answer.outcome.name} to images that are {name}: they contain no texture")
        return str(answer.outcome.name)

    def _check_short_streams(self) -> str:
        outcomes = []
        for number in _INSUFFICIENT_LENGTHS:
            answer = self._answer(_select_first_images(number))
            if VELOCITY.is_valid(answer):
                raise BreachError(f"it answers {answer.outcome.name} to {number or 'no'} image: no motion is visible")
            outcomes.append(answer.outcome.name)
        return ", ".join(outcomes)

    def _check_restart(self) -> str:
        measurements = self.protocol.measurements()
        expected_fingerprint = fingerprint(self._answer(measurements))
        estimator = self.make()
        estimator.stream.start()
        for event in copy_inputs(inputs.make_noisy(measurements).select((0, 1))).events():
            estimator.process(event)
        if fingerprint(estimator.estimate(copy_inputs(measurements))) != expected_fingerprint:
            raise BreachError("after a restart in the middle of a descent, its answer differs")
        return ""


def _select_first_images(number: int) -> DescentMeasurements:
    return inputs.inertial_descent(_STREAM_LENGTH).select(tuple(range(number)))


def _without_increments() -> DescentMeasurements:
    return inputs.descent(_STREAM_LENGTH)
