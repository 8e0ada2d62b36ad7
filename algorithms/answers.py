"""Validation of an algorithm's answers against the interface: types, shapes, finite numbers, consistent outcomes.

Used for algorithms in this process and in external programs (`marsyard.algorithms.exchange`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms import interface
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.sim.measurements import MastCalibration

#: Largest asymmetry of a covariance due to rounding, as a fraction of its largest entry.
_MAX_ASYMMETRY = 1e-9
#: Largest distance, m, of a returned a-priori site from the given one: three decimals round off at most 0.9 mm.
_SAME_SITE_M = 1e-3


def check_velocity(answer: Any, tags_s: Sequence[float] | None = None) -> VelocityEstimate:
    """Validate a `VelocityEstimate`; return a copy with plain float64 arrays and Python numbers.

    `tags_s` are the images' time tags, None if unknown; `span_s` must lie between the first and the last tag. Raises
    AlgorithmError (BAD_ANSWER) with the reason.
    """
    check_type("the answer", answer, VelocityEstimate)
    check_type("outcome", answer.outcome, interface.VelocityOutcome)
    if answer.after_images:
        raise bad_answer("after_images is given; it must be empty: the caller sets it")
    if (answer.outcome is interface.VelocityOutcome.VALID) != (answer.velocity_m_s is not None):
        problem = "is missing" if answer.velocity_m_s is None else "is given"
        allowed = "a velocity if and only if the outcome is VALID"
        raise bad_answer(f"outcome is {answer.outcome.name}, but velocity_m_s {problem}; allowed: {allowed}")
    velocity = check_numbers("velocity_m_s", answer.velocity_m_s, (2,))
    if answer.covariance_m2_s2 is not None and velocity is None:
        raise bad_answer("covariance_m2_s2 is given without a velocity")
    covariance = check_numbers("covariance_m2_s2", answer.covariance_m2_s2, (2, 2))
    if covariance is not None:
        check_covariance("covariance_m2_s2", covariance)
    span = None if answer.span_s is None else _check_span(answer.span_s, tags_s)
    if span is None and tags_s is not None and len(tags_s) < 2 and velocity is not None:
        raise bad_answer("one image has no last interval; allowed: a velocity with a span_s, or a failure outcome")
    attitude_error = check_numbers("attitude_error_rad", answer.attitude_error_rad, (3,))
    return VelocityEstimate(answer.outcome, velocity, answer.details, covariance, span, (), attitude_error)


def check_and_set_span(answer: object, tags_s: Sequence[float]) -> VelocityEstimate:
    """Validate an estimate; a missing time span becomes the last image interval.

    Raises the same error as `check_velocity`.
    """
    estimate = check_velocity(answer, tags_s)
    if estimate.span_s is not None or len(tags_s) < 2:
        return estimate
    return replace(estimate, span_s=(tags_s[-2], tags_s[-1]))


def _check_span(answer_span: Any, tags_s: Sequence[float] | None) -> tuple[float, float]:
    """Validate an averaging interval; it must lie within the images' time tags, if these are known."""
    is_pair = isinstance(answer_span, tuple) and len(answer_span) == 2
    if not is_pair or not all(isinstance(tag, float | int) for tag in answer_span):
        raise bad_answer(f"span_s is {answer_span!r}; allowed: a tuple of two time tags, or None")
    span = (float(answer_span[0]), float(answer_span[1]))
    if not (np.all(np.isfinite(span)) and span[0] <= span[1]):
        raise bad_answer(f"span_s is {span}; allowed: two finite time tags, the first not after the second")
    if tags_s and not tags_s[0] <= span[0] <= span[1] <= tags_s[-1]:
        allowed = f"within the images' time tags, {tags_s[0]} to {tags_s[-1]} s"
        raise bad_answer(f"span_s is {span}; allowed: {allowed}")
    return span


def check_site(answer: Any, apriori_m: Float64[np.ndarray, "3"] | None = None) -> interface.SiteEstimate:
    """Validate a `SiteEstimate`; return a copy with plain arrays. Raises the same error as `check_velocity`.

    `apriori_m` is the a-priori site, None if unknown. Without convergence no other site is allowed: the helicopter
    would land there, but HDA-SAFE, which requires safe sites, would not count it.
    """
    check_type("the answer", answer, interface.SiteEstimate)
    check_type("outcome", answer.outcome, interface.SiteOutcome)
    if (answer.outcome is interface.SiteOutcome.NO_SAFE_SITE) != (answer.site_world is None):
        problem = "is missing" if answer.site_world is None else "is given"
        allowed = "None if and only if the outcome is NO_SAFE_SITE"
        raise bad_answer(f"outcome is {answer.outcome.name}, but site_world {problem}; allowed: {allowed}")
    site = check_numbers("site_world", answer.site_world, (3,))
    distance_m = 0.0 if site is None or apriori_m is None else float(np.linalg.norm(site - apriori_m))
    if not answer.outcome.converged and distance_m > _SAME_SITE_M:
        problem = f"site_world is {distance_m:.3g} m from the a-priori site"
        raise bad_answer(f"outcome is {answer.outcome.name}, but {problem}; allowed: the a-priori site")
    return interface.SiteEstimate(answer.outcome, site, answer.details)


def check_update(answer: Any) -> interface.TargetUpdate:
    """Validate a `TargetUpdate`; return a copy with plain arrays. Raises the same error as `check_velocity`."""
    check_type("the answer", answer, interface.TargetUpdate)
    check_type("state", answer.state, interface.TrackingState)
    losses = answer.losses
    if not isinstance(losses, tuple | list) or not all(isinstance(loss, interface.TargetLoss) for loss in losses):
        raise bad_answer(f"losses is {losses!r}; allowed: a tuple of members of TargetLoss")
    position = check_numbers("position_rover", answer.position_rover, (3,))
    if answer.state is interface.TrackingState.NORMAL and position is None:
        raise bad_answer("state is NORMAL, but position_rover is None")
    return interface.TargetUpdate(answer.state, tuple(losses), position, answer.details)


def check_aim(answer: Any, mast: MastCalibration) -> interface.MastAim | None:
    """Validate a `MastAim` for this mast, or None; return a copy. Raises the same error as `check_velocity`."""
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
        check_type(name, box, interface.PixelBox)
        if not _is_inside(box, camera.size):
            allowed = f"whole pixels inside the frame of {camera.size} pixels"
            raise bad_answer(f"{name} has corner {box.corner} and size {box.size}; allowed: {allowed}")
    return interface.MastAim(float(answer.azimuth_rad), float(answer.elevation_rad), answer.left, answer.right)


def _is_inside(box: interface.PixelBox, frame_size: tuple[int, int]) -> bool:
    """Whether a region consists of whole pixels of a frame of this size (columns, rows)."""
    for pair in (box.corner, box.size):
        if not isinstance(pair, tuple | list | np.ndarray) or len(pair) != 2:
            return False
        if not all(isinstance(number, int | np.integer) for number in pair):
            return False
    axes = zip(box.corner, box.size, frame_size, strict=True)
    return all(corner >= 0 and 1 <= extent <= frame_extent - corner for corner, extent, frame_extent in axes)


def check_covariance(name: str, covariance: Float64[np.ndarray, "n n"]) -> None:
    """Raise AlgorithmError (BAD_ANSWER) unless a covariance is symmetric and positive definite."""
    scale = float(np.abs(covariance).max())
    if not np.allclose(covariance, covariance.T, rtol=0.0, atol=_MAX_ASYMMETRY * scale):
        raise bad_answer(f"{name} is not symmetric: {covariance.tolist()}")
    if scale == 0.0 or float(np.linalg.eigvalsh(covariance)[0]) <= 0.0:
        raise bad_answer(f"{name} is not positive definite: {covariance.tolist()}")


def check_numbers(name: str, value: Any, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."] | None:
    """Validate an array of finite floats of this shape; return a float64 copy. None is valid and returned as None."""
    if value is None:
        return None
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {_type_name(value)}"
        raise bad_answer(f"{name} is {kind}; allowed: a NumPy array of floats, shape {shape}")
    numbers = np.array(value, dtype=np.float64, subok=False)
    if numbers.shape != shape:
        raise bad_answer(f"{name} has the shape {numbers.shape}; allowed: {shape}")
    if not np.all(np.isfinite(numbers)):
        raise bad_answer(f"{name} is not finite: {numbers.tolist()}")
    return numbers


def check_type(name: str, value: Any, kind: type) -> None:
    """Raise AlgorithmError (BAD_ANSWER) unless a value has this type; `name` is that of the value in the message."""
    if not isinstance(value, kind):
        raise bad_answer(f"{name} is a {_type_name(value)}; allowed: a {kind.__name__}")


def _type_name(value: object) -> str:
    return type(value).__name__
