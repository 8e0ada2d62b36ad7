"""Validation of an algorithm's answers against the interface: types, shapes, finite numbers, consistent outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms import interface
from marsyard.sim.measurements import MastCalibration


class Fault(Enum):
    """How an algorithm failed to answer at all. None of these is an expected failure: those are in its own outcomes."""

    CRASHED = "it raised, or its process ended without an answer"
    TIMED_OUT = "it took longer than it may"
    OUT_OF_MEMORY = "it asked for more memory than it may have"
    TOO_MUCH_OUTPUT = "it wrote more than it may"
    BAD_ANSWER = "its answer is not of the form that the interface states"


def describe_error(error: BaseException | None) -> str:
    """Type and message of an error; the type alone if the message cannot be formatted."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return f"{type(error).__name__}, whose message cannot be had"


class AlgorithmError(Exception):
    """Failure of an algorithm under test to answer; `stderr` is the end of its standard error output, if known."""

    def __init__(self, fault: Fault, message: str, stderr: str = "") -> None:
        super().__init__(message)
        self.fault = fault
        self.stderr = stderr

    def __reduce__(self) -> tuple[type[AlgorithmError], tuple[Fault, str, str]]:
        return type(self), (self.fault, str(self), self.stderr)


def bad_answer(message: str) -> AlgorithmError:
    """The error for an answer of the wrong form."""
    return AlgorithmError(Fault.BAD_ANSWER, message)


#: Largest asymmetry of a covariance, as a fraction of its largest entry.
_ROUNDING = 1e-9


def check_velocity(answer: Any, tags_s: Sequence[float] | None = None) -> interface.VelocityEstimate:
    """A copy of a valid `VelocityEstimate` in plain float64 arrays and Python numbers.

    `tags_s` are the time tags of the images, between which the span must lie; None if unknown. Raises AlgorithmError
    (BAD_ANSWER) that names the fault.
    """
    _check_type("the answer", answer, interface.VelocityEstimate)
    _check_type("outcome", answer.outcome, interface.VelocityOutcome)
    if (answer.outcome is interface.VelocityOutcome.VALID) != (answer.velocity_m_s is not None):
        count = "none" if answer.velocity_m_s is None else "one"
        fault = f"but of velocity_m_s {count} is given; allowed: one with VALID alone"
        raise bad_answer(f"outcome is {answer.outcome.name}, {fault}")
    velocity = _check_numbers("velocity_m_s", answer.velocity_m_s, (2,))
    if answer.covariance_m2_s2 is not None and velocity is None:
        raise bad_answer("covariance_m2_s2 is given without a velocity")
    covariance = _check_numbers("covariance_m2_s2", answer.covariance_m2_s2, (2, 2))
    if covariance is not None:
        scale = float(np.abs(covariance).max())
        if not np.allclose(covariance, covariance.T, rtol=0.0, atol=_ROUNDING * scale):
            raise bad_answer(f"covariance_m2_s2 is not symmetric: {covariance.tolist()}")
        if scale == 0.0 or float(np.linalg.eigvalsh(covariance)[0]) <= 0.0:
            raise bad_answer(f"covariance_m2_s2 is not positive definite: {covariance.tolist()}")
    span, answered = None, answer.span_s
    if answered is not None:
        if (
            not isinstance(answered, tuple)
            or len(answered) != 2
            or not all(isinstance(n, float | int) for n in answered)
        ):
            raise bad_answer(f"span_s is {answered!r}; allowed: a tuple of two time tags, or None")
        span = (float(answered[0]), float(answered[1]))
        if not (np.all(np.isfinite(span)) and span[0] <= span[1]):
            raise bad_answer(f"span_s is {span}; allowed: two finite time tags, the first not after the second")
        if tags_s and not tags_s[0] <= span[0] <= span[1] <= tags_s[-1]:
            raise bad_answer(f"span_s is {span}; allowed: within the pictures' tags, {tags_s[0]} to {tags_s[-1]} s")
    elif tags_s is not None and len(tags_s) < 2 and velocity is not None:
        raise bad_answer("of one picture there is no last interval; allowed: a velocity with a span_s, or a failure")
    return interface.VelocityEstimate(answer.outcome, velocity, answer.details, covariance, span, answer.after_pictures)


def check_site(answer: Any) -> interface.SiteEstimate:
    """A copy of a valid `SiteEstimate` in plain arrays; raises as `check_velocity`."""
    _check_type("the answer", answer, interface.SiteEstimate)
    _check_type("outcome", answer.outcome, interface.SiteOutcome)
    if (answer.outcome is interface.SiteOutcome.NO_SAFE_SITE) != (answer.site_world is None):
        answered = "none" if answer.site_world is None else "one"
        fault = f"but site_world: {answered} is given; allowed: none with NO_SAFE_SITE only"
        raise bad_answer(f"outcome is {answer.outcome.name}, {fault}")
    return interface.SiteEstimate(answer.outcome, _check_numbers("site_world", answer.site_world, (3,)), answer.details)


def check_update(answer: Any) -> interface.TargetUpdate:
    """A copy of a valid `TargetUpdate` in plain arrays; raises as `check_velocity`."""
    _check_type("the answer", answer, interface.TargetUpdate)
    _check_type("state", answer.state, interface.TrackingState)
    position = _check_numbers("position_rover", answer.position_rover, (3,))
    if answer.state is interface.TrackingState.NORMAL and position is None:
        raise bad_answer("state is NORMAL, but position_rover is None")
    return interface.TargetUpdate(answer.state, answer.losses, position, answer.details)


def check_aim(answer: Any, mast: MastCalibration) -> interface.MastAim | None:
    """A copy of a valid `MastAim` for this mast, or None; raises as `check_velocity`."""
    if answer is None:
        return None
    if not isinstance(answer, interface.MastAim):
        raise bad_answer(f"the aim is a {_type_name(answer)}; allowed: a MastAim, or None")
    for name in ("azimuth", "elevation"):
        angle, (low, high) = getattr(answer, f"{name}_rad"), getattr(mast.geometry, f"{name}_limits_rad")
        if not isinstance(angle, float | int) or not low <= angle <= high:
            raise bad_answer(f"{name}_rad is {angle!r}; allowed: {low:g} to {high:g}")
    for name, camera in (("left", mast.left), ("right", mast.right)):
        box = getattr(answer, name)
        if not isinstance(box, interface.PixelBox):
            raise bad_answer(f"{name} is a {_type_name(box)}; allowed: a PixelBox")
        for corner, extent, whole in zip(box.corner, box.size, camera.size, strict=True):
            whole_numbers = all(isinstance(n, int | np.integer) for n in (corner, extent))
            if not whole_numbers or corner < 0 or extent < 1 or corner + extent > whole:
                allowed = f"a part of the frame of {camera.size} pixels"
                raise bad_answer(f"{name} is {box.corner} and {box.size}; allowed: {allowed}")
    return interface.MastAim(float(answer.azimuth_rad), float(answer.elevation_rad), answer.left, answer.right)


def _check_numbers(name: str, value: Any, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."] | None:
    """A plain copy of an array of finite floats of this shape, never a subclass of ndarray; None stays None."""
    if value is None:
        return None
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {_type_name(value)}"
        raise bad_answer(f"{name} is {kind}; allowed: a NumPy array of floats, shape {shape}")
    plain = np.array(value, dtype=np.float64, subok=False)
    if plain.shape != shape:
        raise bad_answer(f"{name} has the shape {plain.shape}; allowed: {shape}")
    if not np.all(np.isfinite(plain)):
        raise bad_answer(f"{name} is not finite: {plain.tolist()}")
    return plain


def _check_type(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise bad_answer(f"{name} is a {_type_name(value)}; allowed: a {kind.__name__}")


def _type_name(value: object) -> str:
    return type(value).__name__
