"""Validation of the answers of a position estimator."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.answers import check_covariance, check_numbers, check_type
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome


def check_estimate(answer: Any, span_s: tuple[float, float]) -> PositionEstimate:
    """Validate a `PositionEstimate`; return a copy with plain arrays.

    `span_s` are the first and the last time of the inertial data, between which the answer's time must lie. Raises
    AlgorithmError (BAD_ANSWER) with the reason.
    """
    check_type("the answer", answer, PositionEstimate)
    check_type("outcome", answer.outcome, PositionOutcome)
    if not isinstance(answer.time_s, float | int) or not span_s[0] <= answer.time_s <= span_s[1]:
        raise bad_answer(f"time_s is {answer.time_s!r}; allowed: {span_s[0]} to {span_s[1]}")
    state = {name: getattr(answer, name) for name in ("position_m", "velocity_m_s", "world_from_body", "covariance")}
    is_valid = answer.outcome is PositionOutcome.VALID
    for name, value in state.items():
        if is_valid != (value is not None):
            problem = "is missing" if value is None else "is given"
            allowed = "all parts of the state if and only if the outcome is VALID"
            raise bad_answer(f"outcome is {answer.outcome.name}, but {name} {problem}; allowed: {allowed}")
    if not is_valid:
        refusal: PositionEstimate = answer
        return replace(refusal, time_s=float(answer.time_s))
    check_type("world_from_body", answer.world_from_body, Rotation)
    if not answer.world_from_body.single:
        raise bad_answer(f"world_from_body contains {len(answer.world_from_body)} rotations; allowed: one")
    if not np.all(np.isfinite(answer.world_from_body.as_quat())):
        raise bad_answer("world_from_body is not finite")
    covariance = np.asarray(check_numbers("covariance", answer.covariance, (9, 9)))
    check_covariance("covariance", covariance)
    estimate: PositionEstimate = answer
    return replace(
        estimate,
        time_s=float(answer.time_s),
        position_m=check_numbers("position_m", answer.position_m, (3,)),
        velocity_m_s=check_numbers("velocity_m_s", answer.velocity_m_s, (3,)),
        covariance=covariance,
    )
