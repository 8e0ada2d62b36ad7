"""Tests of the validation of position estimates: malformed answers raise BAD_ANSWER, valid ones are copied."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.localisation.exchange import check_estimate
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome

#: Fields of the state, which a valid answer contains and a refusal does not.
STATE_FIELDS = ("position_m", "velocity_m_s", "world_from_body", "covariance")


def _make_valid() -> PositionEstimate:
    position, velocity = np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, -90.0])
    return PositionEstimate(
        PositionOutcome.VALID, 12.5, position, velocity, Rotation.from_rotvec([0.1, 0.0, 0.2]), np.eye(9), details="d"
    )


class _Malformed(PositionEstimate):
    """A `PositionEstimate` whose fields are not checked at creation, as without the run-time checks of the tests."""

    def __init__(self, **changes: object) -> None:
        for name, value in {**vars(_make_valid()), **changes}.items():
            object.__setattr__(self, name, value)


def _expect_bad(answer: object, message: str) -> None:
    """Assert that the answer raises BAD_ANSWER with this message on one line."""
    with pytest.raises(AlgorithmError, match=message) as caught:
        check_estimate(answer)
    assert caught.value.fault is Fault.BAD_ANSWER
    assert "\n" not in str(caught.value)


def test_values_of_another_type_are_refused() -> None:
    for answer in (None, 3.0, SimpleNamespace(**vars(_make_valid())), PositionOutcome.VALID):
        _expect_bad(answer, rf"the answer is a {type(answer).__name__}; allowed: a PositionEstimate")
    for outcome in ("VALID", None, 1):
        _expect_bad(_Malformed(outcome=outcome), rf"outcome is a {type(outcome).__name__}; allowed: a PositionOutcome")
    for time_s in (np.nan, np.inf, None, "12.5", np.array(12.5)):
        _expect_bad(_Malformed(time_s=time_s), r"time_s is .*; allowed: a finite number")


@pytest.mark.parametrize("name", STATE_FIELDS)
def test_valid_answers_have_all_state_fields_and_refusals_none(name: str) -> None:
    _expect_bad(_Malformed(**{name: None}), rf"outcome is VALID, but {name} is missing; allowed: all parts")
    no_state: dict[str, Any] = dict.fromkeys(STATE_FIELDS)
    fields = {**no_state, name: getattr(_make_valid(), name)}
    for outcome in set(PositionOutcome) - {PositionOutcome.VALID}:
        _expect_bad(_Malformed(outcome=outcome, **fields), rf"outcome is {outcome.name}, but {name} is given; allowed")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("position_m", np.zeros(2), r"position_m has the shape \(2,\); allowed: \(3,\)"),
        ("position_m", np.zeros((3, 1)), r"position_m has the shape \(3, 1\); allowed: \(3,\)"),
        ("position_m", [1.0, 2.0, 3.0], r"position_m is a list; allowed: a NumPy array of floats"),
        ("position_m", np.arange(3), r"position_m is an array of int64; allowed: a NumPy array of floats"),
        ("position_m", np.array([1.0, np.nan, 0.0]), r"position_m is not finite: \[1.0, nan, 0.0\]"),
        ("velocity_m_s", np.zeros(4), r"velocity_m_s has the shape \(4,\); allowed: \(3,\)"),
        ("velocity_m_s", np.array([np.inf, 0.0, 0.0]), r"velocity_m_s is not finite"),
        ("world_from_body", np.eye(3), r"world_from_body is a ndarray; allowed: a Rotation"),
        ("world_from_body", Rotation.from_rotvec(np.zeros((2, 3))), r"world_from_body contains 2 rotations; allowed"),
        ("covariance", np.eye(3), r"covariance has the shape \(3, 3\); allowed: \(9, 9\)"),
        ("covariance", np.full((9, 9), np.nan), r"covariance is not finite"),
        ("covariance", np.eye(9) + np.eye(9, k=1), r"covariance is not symmetric"),
        ("covariance", np.zeros((9, 9)), r"covariance is not positive definite"),
        ("covariance", np.diag([1.0] * 8 + [-1.0]), r"covariance is not positive definite"),
    ],
)
def test_malformed_state_is_refused(name: str, value: object, message: str) -> None:
    _expect_bad(_Malformed(**{name: value}), message)


def test_valid_answer_is_copied() -> None:
    """A later change of the algorithm's arrays does not change the copy."""
    answer = replace(_make_valid(), time_s=-0.2)
    checked = check_estimate(answer)
    assert checked.outcome is PositionOutcome.VALID
    assert (checked.details, checked.time_s) == ("d", -0.2)
    for name in ("position_m", "velocity_m_s", "covariance"):
        original = getattr(answer, name)
        expected = original.copy()
        original += 100.0
        np.testing.assert_array_equal(getattr(checked, name), expected)
        assert getattr(checked, name).dtype == np.float64
    assert checked.world_from_body.approx_equal(Rotation.from_rotvec([0.1, 0.0, 0.2]), atol=1e-12)
    # other types of numbers are converted
    single = np.array([1.0, 2.0, 3.0], dtype=np.float32)
    converted = check_estimate(_Malformed(position_m=single, time_s=3))
    assert (converted.position_m.dtype, type(converted.time_s)) == (np.float64, float)


def test_refusal_without_a_state_is_valid() -> None:
    for outcome in set(PositionOutcome) - {PositionOutcome.VALID}:
        answer = PositionEstimate(outcome, 2.0, details=("diagnosis",))
        checked = check_estimate(answer)
        assert checked == answer
        assert checked is not answer
