"""Conformance checks of estimators: velocity, also from a stream of pictures, and landing sites."""

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

#: Pictures of an ordinary stream; of shortened streams, too short and long enough for an answer; of a long stream.
_PICTURES, _TOO_FEW, _ENOUGH, _MANY = 5, (0, 1), (2, 3), 10


@dataclass(frozen=True)
class Protocol:
    """A task's measurements, and the check, validity and text of its answers; `failures` are outcomes without a result.

    `check` checks an answer against the interface and raises AlgorithmError.
    """

    measurements: Callable[[], Any]
    check: Callable[[object], Any]
    is_valid: Callable[[Any], bool]
    describe: Callable[[Any], str]
    failures: str


def describe_velocity(estimate: VelocityEstimate) -> str:
    """Outcome of an estimate, and its distance from the truth of the suite's descents."""
    if estimate.velocity_m_s is None:
        return estimate.outcome.name
    error = float(np.hypot(*(estimate.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2])))
    return f"{estimate.outcome.name}, {error:.2f} m/s from the truth"


VELOCITY = Protocol(
    measurements=inputs.descent,
    check=check_velocity,
    is_valid=lambda estimate: estimate.outcome is VelocityOutcome.VALID,
    describe=describe_velocity,
    failures=", ".join(one.name for one in VelocityOutcome if one is not VelocityOutcome.VALID),
)
STREAM = replace(VELOCITY, measurements=partial(inputs.descent, _PICTURES))
LANDING = Protocol(
    measurements=inputs.landing,
    check=check_site,
    is_valid=lambda estimate: estimate.outcome.converged,
    describe=lambda estimate: str(estimate.outcome.name),
    failures=", ".join(one.name for one in SiteOutcome if not one.converged),
)


@dataclass(frozen=True)
class EstimatorSuite(Suite):
    """Suite of one estimator; with the protocol `STREAM`, `make` constructs a `StreamedEstimator`."""

    protocol: Protocol

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        p = self.protocol
        form = "see algorithms/interface.py for the answer's form"
        rule = "gives a well-formed answer to textured pictures"
        yield Check("answer", rule, form, lambda: p.describe(self._answer(p.measurements())))
        advice = f"return one of the failures: {p.failures}"
        for name, blank in inputs.BLANKS.items():
            rule = f"ends with a failure if pictures are {name}"
            yield Check(name, rule, advice, partial(self._fails_on, name, blank))
        rule = "gives a well-formed answer to pictures of noise"
        yield Check("noise", rule, advice, lambda: self._outcome(inputs.noisy(p.measurements())))
        if p is LANDING:
            rule = "gives a well-formed answer without a range"
            no_range = replace(inputs.landing(), slant_range_m=float("nan"))
            yield Check("no-range", rule, advice, lambda: self._outcome(no_range))
        yield from self.common_checks()
        if p is STREAM:
            advice = f"return one of the failures from finish: {VELOCITY.failures}"
            yield Check("few", "ends with a failure if there is no picture, or one", advice, self._fails_on_few)
            rule = f"gives a well-formed answer to {', '.join(map(str, _ENOUGH))} and {_MANY} pictures"
            advice = "expect any number: see VelocityStream in algorithms/interface.py"
            streams = (*map(_first_pictures, _ENOUGH), inputs.descent(_MANY))
            yield Check("number", rule, advice, lambda: "; ".join(describe_velocity(self._answer(x)) for x in streams))
            rule, advice = "resets its state after an interrupted descent", "reset the whole state in start"
            yield Check("start", rule, advice, self._starts_again)

    def cases(self) -> Sequence[Any]:
        """See `Suite`."""
        return [self.protocol.measurements()]

    def _other_cases(self) -> Sequence[Any]:
        return [inputs.noisy(self.protocol.measurements())]

    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        return algorithm.estimate(case)

    def _check_answer(self, answer: Any, case: Any) -> Any:
        return self.protocol.check(answer)

    def _outcome(self, measurements: Any) -> str:
        return str(self._answer(measurements).outcome.name)

    def _fails_on(self, name: str, blank: inputs.Blank) -> str:
        answer = self._answer(inputs.blank_pictures(self.protocol.measurements(), blank))
        if self.protocol.is_valid(answer):
            raise BreachError(f"it answers {answer.outcome.name} to pictures that are {name}: there is nothing to see")
        return str(answer.outcome.name)

    def _fails_on_few(self) -> str:
        outcomes = []
        for number in _TOO_FEW:
            answer = self._answer(_first_pictures(number))
            if VELOCITY.is_valid(answer):
                raise BreachError(f"it answers {answer.outcome.name} to {number or 'no'} picture: nothing has moved")
            outcomes.append(answer.outcome.name)
        return ", ".join(outcomes)

    def _starts_again(self) -> str:
        measurements = self.protocol.measurements()
        expected = fingerprint(self._answer(measurements))
        used = self.make()
        used.stream.start()
        for frame in copy_inputs(inputs.noisy(measurements)).frames()[:2]:
            used.stream.picture(frame)
        if fingerprint(used.estimate(copy_inputs(measurements))) != expected:
            raise BreachError("started again after two pictures, it answers differently")
        return ""


def _first_pictures(number: int) -> DescentMeasurements:
    return inputs.descent(_PICTURES).select(tuple(range(number)))
