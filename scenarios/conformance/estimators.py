"""Conformance checks of estimators; each task declares measurements, and rules for its answers (`SuiteRules`)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.answers import check_site
from marsyard.algorithms.interface import SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.checks import BreachError, Check, Suite, fingerprint, measure_time_s
from marsyard.scenarios.input_copies import copy_inputs
from marsyard.scenarios.streamed import is_image
from marsyard.scenarios.velocity import check_velocity_answer
from marsyard.sim.measurements import DescentMeasurements

#: Number of images of an ordinary stream, of a long stream, and before the interruption of a stream.
_STREAM_LENGTH, _LONG_LENGTH, _INTERRUPTED_LENGTH = 5, 10, 3


@dataclass(frozen=True)
class Unusual:
    """Unusual cases of one check.

    - text: description of the measurements
    - cases: functions that create the measurements
    - reason: why no answer can contain a result; empty if it can
    """

    text: str
    cases: tuple[Callable[[], Any], ...]
    reason: str = ""


@dataclass(frozen=True)
class SuiteRules:
    """Measurements of a task, and the rules for its answers.

    - measurements: creates the measurements of an ordinary case
    - check: returns the answer to measurements if it is valid; raises AlgorithmError or BreachError if not
    - is_valid: whether an answer contains a result (a velocity, a site or a position)
    - describe: formats an answer
    - failures: outcomes without a result, as text
    - unusual: unusual cases by name of their check
    - interface: file that defines methods and answers
    - interrupted: creates the measurements of a descent that is interrupted by an ordinary one; None without streams
    """

    measurements: Callable[[], Any]
    check: Callable[[Any, Any], Any]
    is_valid: Callable[[Any], bool]
    describe: Callable[[Any], str]
    failures: str
    unusual: Mapping[str, Unusual]
    interface: str = "algorithms/interface.py"
    interrupted: Callable[[], Any] | None = None


@dataclass(frozen=True)
class EstimatorSuite(Suite):
    """Suite of an estimator that receives all measurements at once."""

    rules: SuiteRules

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        rules = self.rules
        advice = f"see {rules.interface} for methods and answers"
        requirement = "returns a well-formed answer to textured images"
        yield Check("answer", requirement, advice, lambda: rules.describe(self._answer(rules.measurements())))
        advice = f"without a result return one of the failures {rules.failures}; raise no exception"
        for name, unusual in rules.unusual.items():
            answer = "a failure" if unusual.reason else "a well-formed answer"
            yield Check(name, f"returns {answer} to {unusual.text}", advice, partial(self._check_unusual, unusual))
        yield from self.common_checks()

    def cases(self) -> Sequence[Any]:
        """See `Suite`."""
        return [self.rules.measurements()]

    def _other_cases(self) -> Sequence[Any]:
        return [inputs.make_noisy(self.rules.measurements())]

    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        return algorithm.estimate(case)

    def _check_answer(self, answer: Any, case: Any) -> Any:
        return self.rules.check(answer, case)

    def _check_unusual(self, unusual: Unusual) -> str:
        descriptions = []
        for create in unusual.cases:
            answer = self._answer(create())
            if unusual.reason and self.rules.is_valid(answer):
                raise BreachError(f"it answers {answer.outcome.name} to {unusual.text}: {unusual.reason}")
            descriptions.append(self.rules.describe(answer))
        return "; ".join(descriptions)


class StreamSuite(EstimatorSuite):
    """Suite of one stream; `make` constructs a `StreamedEstimator`."""

    deterministic_advice = (
        "use numpy.random.default_rng(a fixed seed), created in start; reset the whole state in start"
    )
    time_verb = "answers each image"
    dependence_problem = "after another descent, its answers differ"

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        yield from super().checks()
        requirement, advice = "resets its state after an interrupted descent", "reset the whole state in start"
        yield Check("start", requirement, advice, self._check_restart)

    def _check_restart(self) -> str:
        case = self.rules.measurements()
        expected_fingerprint = fingerprint(self._answer(case))
        estimator, create_interrupted = self.make(), self.rules.interrupted or self.rules.measurements
        interrupted = copy_inputs(create_interrupted())
        estimator.stream.start(*interrupted.start_inputs)
        images = 0
        for event in interrupted.events():
            estimator.process(event)
            images += is_image(event)
            if images == _INTERRUPTED_LENGTH:
                break
        answer = self._check_answer(estimator.estimate(copy_inputs(case)), case)
        if fingerprint(answer) != expected_fingerprint:
            raise BreachError("after a restart in the middle of a descent, its answers differ")
        return ""

    def _answer_time_s(self) -> float:
        """Measure the maximum time of an image in a second descent; the first descent compiles kernels."""
        self._answer(self.rules.measurements())
        estimator, case = self.make(), copy_inputs(self.rules.measurements())
        estimator.stream.start(*case.start_inputs)
        times = [(is_image(event), measure_time_s(partial(estimator.process, event))) for event in case.events()]
        return max(elapsed_s for image, elapsed_s in times if image)


def unusual_images(
    measurements: Callable[[], Any], blanks: Mapping[str, inputs.Blank], reason: str
) -> dict[str, Unusual]:
    """Return cases with blank images, in which a result is a violation for this reason, and with images of noise."""

    def create_blank(blank: inputs.Blank) -> Any:
        return inputs.make_blank(measurements(), blank)

    cases = {
        name: Unusual(f"images that are {name}", (partial(create_blank, blank),), reason)
        for name, blank in blanks.items()
    }
    return {**cases, "noise": Unusual("images of noise", (lambda: inputs.make_noisy(measurements()),))}


def describe_velocity(estimate: VelocityEstimate) -> str:
    """Return the outcome of an estimate, and its error relative to the truth of the suite's descents."""
    if estimate.velocity_m_s is None:
        return estimate.outcome.name
    error = float(np.hypot(*(estimate.velocity_m_s - inputs.DESCENT_VELOCITY_M_S[:2])))
    return f"{estimate.outcome.name}, {error:.2f} m/s error"


def _first_images(number: int) -> DescentMeasurements:
    """Return the descent of an ordinary stream with its first images only."""
    return inputs.inertial_descent(_STREAM_LENGTH).select(tuple(range(number)))


_NO_TEXTURE = "they contain no texture"
_create_stream = partial(inputs.inertial_descent, _STREAM_LENGTH)
VELOCITY_RULES = SuiteRules(
    measurements=inputs.descent,
    check=lambda answer, measurements: check_velocity_answer(answer, measurements.tags_s),
    is_valid=lambda estimate: estimate.outcome is VelocityOutcome.VALID,
    describe=describe_velocity,
    failures=", ".join(outcome.name for outcome in VelocityOutcome if outcome is not VelocityOutcome.VALID),
    unusual=unusual_images(inputs.descent, inputs.BLANKS, _NO_TEXTURE),
)
STREAM_RULES = replace(
    VELOCITY_RULES,
    measurements=_create_stream,
    unusual={
        **unusual_images(_create_stream, inputs.BLANKS, _NO_TEXTURE),
        "few": Unusual(
            "zero images and to one image",
            (partial(_first_images, 0), partial(_first_images, 1)),
            "no motion is visible",
        ),
        "number": Unusual(
            f"2, 3 and {_LONG_LENGTH} images",
            (partial(_first_images, 2), partial(_first_images, 3), partial(inputs.inertial_descent, _LONG_LENGTH)),
        ),
        "no-increments": Unusual("a descent without increments", (partial(inputs.descent, _STREAM_LENGTH),)),
    },
    interrupted=lambda: inputs.make_noisy(_create_stream()),
)
LANDING_RULES = SuiteRules(
    measurements=inputs.landing,
    check=lambda answer, measurements: check_site(answer, measurements.apriori_site_world),
    is_valid=lambda estimate: estimate.outcome.converged,
    describe=lambda estimate: str(estimate.outcome.name),
    failures=", ".join(outcome.name for outcome in SiteOutcome if not outcome.converged),
    unusual={
        **unusual_images(inputs.landing, inputs.BLANKS, _NO_TEXTURE),
        "no-range": Unusual("a missing range", (lambda: replace(inputs.landing(), slant_range_m=float("nan")),)),
    },
)
