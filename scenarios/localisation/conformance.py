"""Conformance checks of position estimators: synthetic descents over level, textured ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.localisation.answers import check_estimate
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.algorithm_run import copy_inputs
from marsyard.scenarios.conformance.checks import BreachError, Check, Suite, fingerprint, measure_time_s
from marsyard.scenarios.localisation import conformance_inputs as inputs
from marsyard.scenarios.localisation.conformance_inputs import Descent
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements

#: Largest difference between the time of an answer and that of its image or of the last increment, s.
_TIME_TOLERANCE_S = 1e-6
#: Number of images before an interruption: enough for a coarse stage.
_INTERRUPTED_IMAGES = 3


@dataclass(frozen=True)
class PositionSuite(Suite):
    """Suite of one position estimator; the answer to a case is one estimate per image, and the final one."""

    deterministic_advice = (
        "use numpy.random.default_rng(a fixed seed), created in start; reset the whole state in start"
    )
    time_verb = "answers each image"
    dependence_problem = "after another descent, its answers differ"

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        advice = "see algorithms/localisation/interface.py for the methods and answers"
        rule = "returns a well-formed answer to each image and at the end"
        yield Check("answer", rule, advice, lambda: _describe(self._answer(inputs.ordinary_descent())))
        refusals = ", ".join(outcome.name for outcome in PositionOutcome if outcome is not PositionOutcome.VALID)
        advice = f"without a position return one of {refusals}; no method may raise an exception"
        for name, (create, text) in inputs.UNUSUAL.items():
            yield Check(name, f"returns well-formed answers to {text}", advice, partial(self._check_unusual, create))
        yield from self.common_checks()
        rule, advice = "resets its state after an interrupted descent", "reset the whole state in start"
        yield Check("start", rule, advice, self._check_restart)

    def cases(self) -> Sequence[Descent]:
        """See `Suite`."""
        return [inputs.ordinary_descent()]

    def _other_cases(self) -> Sequence[Descent]:
        return [inputs.descent_with_noise_images()]

    def _call(self, algorithm: Any, case: Descent, seed: int) -> tuple[Any, ...]:
        return run(algorithm, case)

    def _check_answer(self, answer: Any, case: Descent) -> tuple[PositionEstimate, ...]:
        images = [event for event in case.events if isinstance(event, DetectorImage)]
        times = [*(image.time_s for image in images), case.end_s]
        estimates = tuple(check_estimate(estimate, (case.initial.time_s, case.end_s)) for estimate in answer)
        for number, (estimate, time_s) in enumerate(zip(estimates, times, strict=True), start=1):
            if abs(estimate.time_s - time_s) > _TIME_TOLERANCE_S:
                name = f"image {number}" if number <= len(images) else "finish"
                raise BreachError(f"the time_s of its answer to {name} is {estimate.time_s} s; expected {time_s} s")
        return estimates

    def _check_unusual(self, create: Callable[[], Descent]) -> str:
        return _describe(self._answer(create()))

    def _check_restart(self) -> str:
        case = inputs.ordinary_descent()
        expected_fingerprint = fingerprint(self._answer(case))
        estimator, interrupted = self.make(), copy_inputs(inputs.descent_on_shifted_map())
        estimator.start(interrupted.initial, interrupted.map_product)
        images = 0
        for event in interrupted.events:
            send(estimator, event)
            images += isinstance(event, DetectorImage)
            if images == _INTERRUPTED_IMAGES:
                break
        if fingerprint(self._check_answer(run(estimator, copy_inputs(case)), case)) != expected_fingerprint:
            raise BreachError("after a restart in the middle of a descent, its answers differ")
        return ""

    def _answer_time_s(self) -> float:
        """Measure the maximum time of an image in a second descent; the first descent compiles kernels."""
        self._answer(inputs.ordinary_descent())
        estimator, case = self.make(), copy_inputs(inputs.ordinary_descent())
        estimator.start(case.initial, case.map_product)
        times = []
        for event in case.events:
            elapsed_s = measure_time_s(partial(send, estimator, event))
            times += [elapsed_s] if isinstance(event, DetectorImage) else []
        return max(times)


def run(estimator: Any, descent: Descent) -> tuple[Any, ...]:
    """Run an estimator over a descent; return its answers to the images, and the final one."""
    estimator.start(descent.initial, descent.map_product)
    answers = [send(estimator, event) for event in descent.events]
    images = [answer for answer, event in zip(answers, descent.events, strict=True) if isinstance(event, DetectorImage)]
    return (*images, estimator.finish())


def send(estimator: Any, event: object) -> Any:
    """Call the method of an estimator for a measurement."""
    if isinstance(event, ImuIncrements):
        return estimator.imu(event)
    return estimator.altitude(event) if isinstance(event, AltitudeMeasurement) else estimator.image(event)


def _describe(estimates: Sequence[PositionEstimate]) -> str:
    """Return the number of positions, and the outcome or the horizontal error at the end."""
    valid = sum(estimate.outcome is PositionOutcome.VALID for estimate in estimates[:-1])
    final = estimates[-1]
    end = final.outcome.name
    if final.position_m is not None:
        error_m = float(np.hypot(*(final.position_m - inputs.true_position(final.time_s))[:2]))
        end = f"{error_m:.1f} m error at the end"
    return f"{valid} of {len(estimates) - 1} images {PositionOutcome.VALID.name}; {end}"
