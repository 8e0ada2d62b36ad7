"""The checks of estimators that are asked once a case: velocity, also from a stream of pictures, and landing sites."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.answers import checked_site, checked_velocity
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.checks import (
    BreachError,
    Check,
    Suite,
    answer_print,
    seed_global_generators,
    timed,
)
from marsyard.scenarios.handover import fingerprint, handed_copy
from marsyard.sim.measurements import DescentMeasurements

#: Pictures of an ordinary stream, numbers of its first ones that some checks take alone, and those of a long stream.
_PICTURES, _FEW, _ENOUGH, _MANY = 5, (0, 1), (2, 3), 10


@dataclass(frozen=True)
class Protocol:
    """What the checks need to know of a task.

    Attributes
    ----------
    measurements
        Ordinary ones.
    checked
        Holds an answer against the interface; raises AlgorithmError.
    claims
        Whether an answer claims to know what was asked for.
    describe
        An answer in words.
    failures
        The outcomes to end with where nothing is known.
    """

    measurements: Callable[[], Any]
    checked: Callable[[object], Any]
    claims: Callable[[Any], bool]
    describe: Callable[[Any], str]
    failures: str


def _describe_velocity(estimate: VelocityEstimate) -> str:
    if estimate.velocity_m_s is None:
        return estimate.outcome.name
    error = float(np.hypot(*(estimate.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2])))
    return f"{estimate.outcome.name}, {error:.2f} m/s from the truth"


def _describe_site(estimate: SiteEstimate) -> str:
    return estimate.outcome.name


VELOCITY = Protocol(
    measurements=inputs.descent,
    checked=checked_velocity,
    claims=lambda estimate: estimate.outcome is VelocityOutcome.VALID,
    describe=_describe_velocity,
    failures=", ".join(one.name for one in VelocityOutcome if one is not VelocityOutcome.VALID),
)
STREAM = replace(VELOCITY, measurements=partial(inputs.descent, _PICTURES))
LANDING = Protocol(
    measurements=inputs.landing,
    checked=checked_site,
    claims=lambda estimate: estimate.outcome.converged,
    describe=_describe_site,
    failures=", ".join(one.name for one in SiteOutcome if not one.converged),
)


@dataclass(frozen=True)
class EstimatorSuite(Suite):
    """The suite of one estimator. Of the protocol `STREAM`, `make` makes a `StreamedEstimator`."""

    protocol: Protocol

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        form = "see algorithms/interface.py for the answer's form"
        yield Check("answer", "gives a well-formed answer to textured pictures", form, self._answers)
        advice = f"return one of the failures: {self.protocol.failures}"
        for name, blank in inputs.BLANKS.items():
            asked = f"ends with a failure where pictures are {name}"
            yield Check(name, asked, advice, partial(self._fails_on, name, blank))
        yield Check("noise", "gives a well-formed answer to pictures of noise", advice, self._answers_noise)
        if self.protocol is LANDING:
            yield Check("no-range", "gives a well-formed answer without a range", advice, self._answers_no_range)
        yield from self.common_checks()
        if self.protocol is STREAM:
            advice = f"return one of the failures from finish: {VELOCITY.failures}"
            yield Check("few", "ends with a failure where there is no picture, or one", advice, self._fails_on_few)
            yield Check(
                "number",
                f"gives a well-formed answer to {', '.join(map(str, _ENOUGH))} and {_MANY} pictures",
                "expect any number: see VelocityStream in algorithms/interface.py",
                self._answers_any_number,
            )
            asked, advice = "forgets a descent that was broken off", "reset in start all that was kept"
            yield Check("start", asked, advice, self._starts_again)

    def _ask(self, measurements: Any) -> Any:
        return self.protocol.checked(self.make().estimate(handed_copy(measurements)))

    def _answers(self) -> str:
        return self.protocol.describe(self._ask(self.protocol.measurements()))

    def _fails_on(self, name: str, blank: inputs.Blank) -> str:
        answer = self._ask(inputs.blanked(self.protocol.measurements(), blank))
        if self.protocol.claims(answer):
            raise BreachError(f"it answers {answer.outcome.name} to pictures that are {name}: there is nothing to see")
        return str(answer.outcome.name)

    def _answers_noise(self) -> str:
        return str(self._ask(inputs.noisy(self.protocol.measurements())).outcome.name)

    def _answers_no_range(self) -> str:
        return str(self._ask(replace(inputs.landing(), slant_range_m=float("nan"))).outcome.name)

    def _change_inputs(self) -> str:
        measurements = handed_copy(self.protocol.measurements(), writable=True)
        before = fingerprint(measurements)
        self.make().estimate(measurements)
        if fingerprint(measurements) != before:
            raise BreachError("its measurements are not what they were before it was asked")
        return ""

    def _answer_again(self) -> str:
        measurements, other = self.protocol.measurements(), inputs.noisy(self.protocol.measurements())
        seed_global_generators(1)
        first = answer_print(self._ask(measurements))
        seed_global_generators(2)
        if answer_print(self._ask(measurements)) != first:
            raise BreachError("asked twice, it answers differently to the same case")
        kept = self.make()
        kept.estimate(handed_copy(other))
        if answer_print(self.protocol.checked(kept.estimate(handed_copy(measurements)))) != first:
            raise BreachError("its answer depends on the case that it was asked before")
        return ""

    def _taken_s(self) -> float:
        self._ask(self.protocol.measurements())
        return timed(lambda: self._ask(self.protocol.measurements()))

    def _fails_on_few(self) -> str:
        outcomes = []
        for number in _FEW:
            answer = self._ask(_first(number))
            if VELOCITY.claims(answer):
                raise BreachError(f"it answers {answer.outcome.name} to {number or 'no'} picture: nothing has moved")
            outcomes.append(answer.outcome.name)
        return ", ".join(outcomes)

    def _answers_any_number(self) -> str:
        answers = [self._ask(given) for given in (*map(_first, _ENOUGH), inputs.descent(_MANY))]
        return "; ".join(VELOCITY.describe(answer) for answer in answers)

    def _starts_again(self) -> str:
        measurements = self.protocol.measurements()
        expected = answer_print(self._ask(measurements))
        kept = self.make()
        kept.stream.start()
        for frame in handed_copy(inputs.noisy(measurements)).frames()[:2]:
            kept.stream.picture(frame)
        if answer_print(kept.estimate(handed_copy(measurements))) != expected:
            raise BreachError("started again after two pictures, it answers differently")
        return ""


def _first(number: int) -> DescentMeasurements:
    """A descent of which only the first pictures were taken."""
    return inputs.descent(_PICTURES).select(tuple(range(number)))
