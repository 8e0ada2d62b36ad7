"""Holds what an algorithm answers against the interface: right types, finite numbers, an answer where one is claimed.

What a user's own class or program returns is not to be trusted: a velocity of NaN that is called VALID would otherwise
be scored as if it were none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import (
    MastAim,
    PixelBox,
    SiteEstimate,
    SiteOutcome,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
)
from marsyard.algorithms.interface import VelocityOutcome as Outcome
from marsyard.sim.measurements import MastCalibration

#: Share of its largest variance by which a covariance may be off symmetry.
_ROUNDING = 1e-9


def checked_velocity(answer: object, tags_s: Sequence[float] | None = None) -> VelocityEstimate:
    """The answer in plain float64 arrays and Python numbers of its own, if it is a valid `VelocityEstimate`.

    Parameters
    ----------
    answer
        What an algorithm returned.
    tags_s
        Time tags of the pictures that it has, between which its span must lie; None where they are not known.

    Raises
    ------
    AlgorithmError
        BAD_ANSWER, and what is wrong with it.
    """
    if not isinstance(answer, VelocityEstimate):
        raise _bad(f"the answer is a {_kind(answer)}; allowed: a VelocityEstimate")
    if not isinstance(answer.outcome, Outcome):
        raise _bad(f"outcome is a {_kind(answer.outcome)}; allowed: a VelocityOutcome")
    if (answer.outcome is Outcome.VALID) != (answer.velocity_m_s is not None):
        given = "none is given" if answer.velocity_m_s is None else "one is given"
        raise _bad(f"outcome is {answer.outcome.name}, but of velocity_m_s {given}; allowed: one with VALID alone")
    velocity = None if answer.velocity_m_s is None else _numbers("velocity_m_s", answer.velocity_m_s, (2,))
    covariance = None
    if answer.covariance_m2_s2 is not None:
        if velocity is None:
            raise _bad("covariance_m2_s2 is given without a velocity")
        covariance = _numbers("covariance_m2_s2", answer.covariance_m2_s2, (2, 2))
        _check_covariance(covariance)
    span = None if answer.span_s is None else _span(answer.span_s, tags_s)
    if span is None and tags_s is not None and len(tags_s) < 2 and velocity is not None:
        raise _bad("of one picture there is no last interval; allowed: a velocity with a span_s, or a failure")
    return VelocityEstimate(answer.outcome, velocity, answer.details, covariance, span, answer.after_pictures)


def checked_site(answer: object) -> SiteEstimate:
    """The answer in plain arrays, if it is a valid `SiteEstimate`; raises as `checked_velocity`."""
    if not isinstance(answer, SiteEstimate):
        raise _bad(f"the answer is a {_kind(answer)}; allowed: a SiteEstimate")
    if not isinstance(answer.outcome, SiteOutcome):
        raise _bad(f"outcome is a {_kind(answer.outcome)}; allowed: a SiteOutcome")
    if (answer.outcome is SiteOutcome.NO_SAFE_SITE) != (answer.site_world is None):
        given = "none is given" if answer.site_world is None else "one is given"
        raise _bad(f"outcome is {answer.outcome.name}, but site_world: {given}; allowed: none with NO_SAFE_SITE only")
    site = None if answer.site_world is None else _numbers("site_world", answer.site_world, (3,))
    return SiteEstimate(answer.outcome, site, answer.details)


def checked_update(answer: object) -> TargetUpdate:
    """The answer in plain arrays, if it is a valid `TargetUpdate`; raises as `checked_velocity`."""
    if not isinstance(answer, TargetUpdate):
        raise _bad(f"the answer is a {_kind(answer)}; allowed: a TargetUpdate")
    if not isinstance(answer.state, TrackingState):
        raise _bad(f"state is a {_kind(answer.state)}; allowed: a TrackingState")
    position = None if answer.position_rover is None else _numbers("position_rover", answer.position_rover, (3,))
    if answer.state is TrackingState.NORMAL and position is None:
        raise _bad("state is NORMAL, but position_rover is None")
    return TargetUpdate(answer.state, answer.losses, position, answer.details)


def checked_aim(answer: object, mast: MastCalibration) -> MastAim | None:
    """The answer, if it is None or a valid `MastAim` for this mast; raises as `checked_velocity`."""
    if answer is None:
        return None
    if not isinstance(answer, MastAim):
        raise _bad(f"the aim is a {_kind(answer)}; allowed: a MastAim, or None")
    limits = {
        "azimuth_rad": mast.geometry.azimuth_limits_rad,
        "elevation_rad": mast.geometry.elevation_limits_rad,
    }
    for name, (least, most) in limits.items():
        angle = getattr(answer, name)
        if not isinstance(angle, float | int) or not least <= angle <= most:
            raise _bad(f"{name} is {angle!r}; allowed: {least:g} to {most:g}")
    for name, camera in (("left", mast.left), ("right", mast.right)):
        _check_box(name, getattr(answer, name), camera.size)
    return MastAim(float(answer.azimuth_rad), float(answer.elevation_rad), answer.left, answer.right)


def _check_box(name: str, box: Any, size: tuple[int, int]) -> None:
    """Raises where a box is no part of a frame of this size."""
    if not isinstance(box, PixelBox):
        raise _bad(f"{name} is a {_kind(box)}; allowed: a PixelBox")
    for corner, extent, whole in zip(box.corner, box.size, size, strict=True):
        whole_numbers = all(isinstance(one, int | np.integer) for one in (corner, extent))
        if not whole_numbers or corner < 0 or extent < 1 or corner + extent > whole:
            raise _bad(f"{name} is {box.corner} and {box.size}; allowed: a part of the frame of {size} pixels")


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """A plain copy of an array of finite floats of this shape: no subclass whose operators could do anything."""
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {_kind(value)}"
        raise _bad(f"{name} is {kind}; allowed: a NumPy array of floats, shape {shape}")
    plain = np.array(value, dtype=np.float64, subok=False)
    if plain.shape != shape:
        raise _bad(f"{name} has the shape {plain.shape}; allowed: {shape}")
    if not np.all(np.isfinite(plain)):
        raise _bad(f"{name} is not finite: {plain.tolist()}")
    return plain


def _span(given: Any, tags_s: Sequence[float] | None) -> tuple[float, float]:
    if not isinstance(given, tuple) or len(given) != 2 or not all(isinstance(one, float | int) for one in given):
        raise _bad(f"span_s is {given!r}; allowed: a tuple of two time tags, or None")
    span = (float(given[0]), float(given[1]))
    if not (np.all(np.isfinite(span)) and span[0] <= span[1]):
        raise _bad(f"span_s is {span}; allowed: two finite time tags, the first not after the second")
    if tags_s and not tags_s[0] <= span[0] <= span[1] <= tags_s[-1]:
        raise _bad(f"span_s is {span}; allowed: within the pictures' tags, {tags_s[0]} to {tags_s[-1]} s")
    return span


def _check_covariance(matrix: np.ndarray) -> None:
    scale = float(np.abs(matrix).max())
    if not np.allclose(matrix, matrix.T, rtol=0.0, atol=_ROUNDING * scale):
        raise _bad(f"covariance_m2_s2 is not symmetric: {matrix.tolist()}")
    if scale == 0.0 or float(np.linalg.eigvalsh(matrix)[0]) <= 0.0:
        raise _bad(f"covariance_m2_s2 is not positive definite: {matrix.tolist()}")


def _bad(message: str) -> AlgorithmError:
    return AlgorithmError(Fault.BAD_ANSWER, message)


def _kind(value: object) -> str:
    return type(value).__name__
