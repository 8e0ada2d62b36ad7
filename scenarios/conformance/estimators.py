"""The checks of estimators that are asked once a case: velocity, landing sites."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.answers import checked_site, checked_velocity
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.findings import BreachError, Check
from marsyard.scenarios.conformance.process import fingerprint, own_copy
from marsyard.scenarios.conformance.shared import COPIES, process_checks, seed_global_generators
from marsyard.sim.measurements import LandingMeasurements


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
    told
        An answer in words.
    failures
        The outcomes to end with where nothing is known.
    """

    measurements: Callable[[], Any]
    checked: Callable[[object], Any]
    claims: Callable[[Any], bool]
    told: Callable[[Any], str]
    failures: str


def _velocity_told(estimate: VelocityEstimate) -> str:
    if estimate.velocity_m_s is None:
        return estimate.outcome.name
    error = float(np.hypot(*(estimate.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2])))
    return f"{estimate.outcome.name}, {error:.2f} m/s from the truth"


def _site_told(estimate: SiteEstimate) -> str:
    return estimate.outcome.name


VELOCITY = Protocol(
    measurements=inputs.descent,
    checked=checked_velocity,
    claims=lambda estimate: estimate.outcome is VelocityOutcome.VALID,
    told=_velocity_told,
    failures=", ".join(one.name for one in VelocityOutcome if one is not VelocityOutcome.VALID),
)
LANDING = Protocol(
    measurements=inputs.landing,
    checked=checked_site,
    claims=lambda estimate: estimate.outcome.converged,
    told=_site_told,
    failures=", ".join(one.name for one in SiteOutcome if not one.converged),
)


@dataclass(frozen=True)
class EstimatorSuite:
    """The suite of one estimator, made anew for each check.

    Attributes
    ----------
    protocol
        Its task's.
    make
        Makes the estimator.
    spec
        How it is named.
    program
        Whether it is a program, which gets files and so cannot touch what is ours.
    limit_s
        Longest time that an answer may take.
    """

    protocol: Protocol
    make: Callable[[], Any]
    spec: str
    program: bool
    limit_s: float

    def checks(self) -> Iterator[Check]:
        """All of them, the ordinary case first."""
        yield Check(
            "answer",
            "gives a well-formed answer to textured pictures",
            "see algorithms/interface.py for the answer's form",
            self._answers,
        )
        advice = f"return one of the failures: {self.protocol.failures}"
        for name, blank in inputs.BLANKS.items():
            yield Check(
                name, f"ends with a failure where pictures are {name}", advice, partial(self._fails_on, name, blank)
            )
        yield Check("noise", "gives a well-formed answer to pictures of noise", advice, self._answers_noise)
        if self.protocol is LANDING:
            yield Check("no-range", "gives a well-formed answer without a range", advice, self._answers_no_range)
        if not self.program:
            yield Check(
                "inputs",
                "leaves its inputs as they are",
                COPIES,
                self._inputs,
            )
        yield Check(
            "deterministic",
            "gives the same answer to the same case",
            "draw from numpy.random.default_rng(a fixed seed), made in estimate; keep nothing from case to case",
            self._deterministic,
        )
        yield Check(
            "time", f"answers within {self.limit_s:g} s", "be faster, or allow more with --time-limit", self._time
        )
        if not self.program:
            yield from process_checks(self.spec, self._prepared)

    def _ask(self, measurements: Any) -> Any:
        return self.protocol.checked(self.make().estimate(own_copy(measurements)))

    def _answers(self) -> str:
        return self.protocol.told(self._ask(self.protocol.measurements()))

    def _fails_on(self, name: str, blank: inputs.Blank) -> str:
        answer = self._ask(inputs.blanked(self.protocol.measurements(), blank))
        if self.protocol.claims(answer):
            raise BreachError(f"it answers {answer.outcome.name} to pictures that are {name}: there is nothing to see")
        return str(answer.outcome.name)

    def _answers_noise(self) -> str:
        return str(self._ask(inputs.noisy(self.protocol.measurements())).outcome.name)

    def _answers_no_range(self) -> str:
        measurements = self.protocol.measurements()
        assert isinstance(measurements, LandingMeasurements)  # noqa: S101  (only that protocol asks)
        return str(self._ask(replace(measurements, slant_range_m=float("nan"))).outcome.name)

    def _inputs(self) -> str:
        measurements = own_copy(self.protocol.measurements(), writable=True)
        before = fingerprint(measurements)
        self.make().estimate(measurements)
        if fingerprint(measurements) != before:
            raise BreachError("its measurements are not what they were before it was asked")
        return ""

    def _deterministic(self) -> str:
        measurements, other = self.protocol.measurements(), inputs.noisy(self.protocol.measurements())
        seed_global_generators(1)
        first = fingerprint(self._ask(measurements))
        seed_global_generators(2)
        if fingerprint(self._ask(measurements)) != first:
            raise BreachError("asked twice, it answers differently to the same case")
        kept = self.make()
        kept.estimate(own_copy(other))
        if fingerprint(self.protocol.checked(kept.estimate(own_copy(measurements)))) != first:
            raise BreachError("its answer depends on the case that it was asked before")
        return ""

    def _time(self) -> str:
        self._ask(self.protocol.measurements())
        began = time.perf_counter()
        self._ask(self.protocol.measurements())
        taken = time.perf_counter() - began
        if taken > self.limit_s:
            raise BreachError(f"it took {taken:.3g} s")
        return f"{taken:.3g} s"

    def _prepared(self) -> Callable[[], object]:
        return partial(self.make().estimate, own_copy(self.protocol.measurements()))
