"""Columns and figures of velocity estimates, compared with the truth.

An estimate is a mean velocity over a span: the interval between two time tags. Its truth is the true mean velocity over
the same span.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.algorithms.dimes import DimesDetails, dimes_products
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.interface import Scalar

#: Horizontal velocity (east, north), m/s.
Horizontal = Float64[np.ndarray, "2"]
#: Time tags of the start and end of the interval of a mean velocity, s; equal for an instantaneous velocity.
Span = tuple[float, float]


class _AnswerAfterImage(NamedTuple):
    """Answer of a stream after an image: its span, velocity and true velocity; NaN without a velocity."""

    span_s: Span = (np.nan, np.nan)
    velocity_m_s: Horizontal = np.full(2, np.nan)
    true_m_s: Horizontal = np.full(2, np.nan)


def _answers_after_images(
    estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]
) -> list[_AnswerAfterImage]:
    """Return the answers of a stream after each image; empty for other estimators."""
    return [
        _AnswerAfterImage()
        if answer is None or answer.velocity_m_s is None or answer.span_s is None
        else _AnswerAfterImage(answer.span_s, answer.velocity_m_s, truth(answer.span_s))
        for answer in (estimate.after_images if estimate is not None else ())
    ]


def stream_row(estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]) -> dict[str, Scalar]:
    """Return the error columns of a stream after each image, NaN without a velocity; empty for other estimators.

    `images_before_answer` is the number of images before the first velocity, 0 if there is none.
    """
    answers = _answers_after_images(estimate, truth)
    errors = [float(np.hypot(*(answer.velocity_m_s - answer.true_m_s))) for answer in answers]
    if not errors:
        return {}
    first = next((number for number, error in enumerate(errors, start=1) if not np.isnan(error)), 0)
    row: dict[str, Scalar] = {"stream_images": len(errors), "images_before_answer": first}
    return row | {f"velocity_error_after_{number}_m_s": error for number, error in enumerate(errors, start=1)}


def velocity_row(name: str, estimate: Horizontal | None, truth: Horizontal) -> dict[str, Scalar]:
    """Return a velocity's error with the estimated and true velocity; NaN without an estimate."""
    estimate_or_nan = np.full(2, np.nan) if estimate is None else estimate
    error = estimate_or_nan - truth
    row: dict[str, Scalar] = {f"{name}_error_m_s": float(np.hypot(*error))}
    for kind, values in (("error", error), ("estimated", estimate_or_nan), ("true", truth)):
        row |= {f"{name}_{kind}_{axis}_m_s": float(value) for axis, value in zip("xy", values, strict=True)}
    return row


def consistency_row(estimate: VelocityEstimate | None, truth: Horizontal) -> dict[str, Scalar]:
    """Return the error relative to the reported covariance; empty without a covariance.

    `velocity_nees` is the squared error normalised by the covariance P, e' P^-1 e: for a consistent estimator with a
    normally distributed error it follows the chi-square distribution with 2 degrees of freedom (Bar-Shalom, Li &
    Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.2).
    `velocity_normalised_x` and `_y` are the errors divided by their standard deviations: standard normal in that case.
    """
    if estimate is None or estimate.velocity_m_s is None or estimate.covariance_m2_s2 is None:
        return {}
    error, covariance = estimate.velocity_m_s - truth, estimate.covariance_m2_s2
    deviations = np.sqrt(np.diag(covariance))
    return {
        "velocity_sd_x_m_s": float(deviations[0]),
        "velocity_sd_y_m_s": float(deviations[1]),
        "velocity_correlation": float(covariance[0, 1] / (deviations[0] * deviations[1])),
        "velocity_normalised_x": float(error[0] / deviations[0]),
        "velocity_normalised_y": float(error[1] / deviations[1]),
        "velocity_nees": float(error @ np.linalg.solve(covariance, error)),
    }


def velocity_products(
    images: Sequence[UInt16[np.ndarray, "rows columns"]], estimate: VelocityEstimate | None, truth: Horizontal
) -> dict[str, object]:
    """Return the arrays for the figures of a case: images, DIMES' intermediate results, true and estimated velocity."""
    arrays: dict[str, object] = {f"image_{number}": counts for number, counts in enumerate(images, start=1)}
    if estimate is not None and isinstance(estimate.details, DimesDetails):
        arrays.update(dimes_products(estimate.details))
    arrays["velocity_true_m_s"] = truth
    if estimate is not None and estimate.velocity_m_s is not None:
        arrays["velocity_estimated_m_s"] = estimate.velocity_m_s
    return arrays


def stream_products(estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]) -> dict[str, object]:
    """Return the answers of a stream for the figures of a case, with their truth; empty for other estimators.

    The arrays have one row per image: span, velocity and true velocity, NaN without a velocity.
    """
    answers = _answers_after_images(estimate, truth)
    if not answers:
        return {}
    return {
        "after_spans_s": np.array([answer.span_s for answer in answers]),
        "after_velocities_m_s": np.array([answer.velocity_m_s for answer in answers]),
        "after_true_m_s": np.array([answer.true_m_s for answer in answers]),
    }
