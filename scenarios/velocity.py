"""What every scenario with a velocity estimator stores of its answer: errors, their consistency, and products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt16

from algorithms.dimes import DimesDetails, dimes_products
from algorithms.interface import VelocityEstimate
from scenarios.interface import Scalar

Horizontal = Float64[np.ndarray, "2"]


def velocity_row(name: str, estimated: Horizontal | None, true: Horizontal) -> dict[str, Scalar]:
    """A velocity's error (m/s) with the two velocities; NaN where none was reported."""
    given = np.full(2, np.nan) if estimated is None else estimated
    error = given - true
    row: dict[str, Scalar] = {f"{name}_error_m_s": float(np.hypot(*error))}
    for kind, values in (("error", error), ("estimated", given), ("true", true)):
        row |= {f"{name}_{kind}_{axis}_m_s": float(value) for axis, value in zip("xy", values, strict=True)}
    return row


def consistency_row(estimate: VelocityEstimate | None, true: Horizontal) -> dict[str, Scalar]:
    """The error against the covariance that came with it; nothing where none did.

    `velocity_nees` is the error squared in units of the covariance P, e' P^-1 e: for a consistent estimator of a normal
    error it is distributed as chi-square with 2 degrees of freedom (Bar-Shalom, Li & Kirubarajan, "Estimation with
    Applications to Tracking and Navigation", 2001, section 5.4.2). `velocity_normalised_x` and `_y` are the errors over
    their standard deviations, standard normal then.
    """
    if estimate is None or estimate.velocity_m_s is None or estimate.covariance_m2_s2 is None:
        return {}
    error, covariance = estimate.velocity_m_s - true, estimate.covariance_m2_s2
    sd = np.sqrt(np.diag(covariance))
    return {
        "velocity_sd_x_m_s": float(sd[0]),
        "velocity_sd_y_m_s": float(sd[1]),
        "velocity_correlation": float(covariance[0, 1] / (sd[0] * sd[1])),
        "velocity_normalised_x": float(error[0] / sd[0]),
        "velocity_normalised_y": float(error[1] / sd[1]),
        "velocity_nees": float(error @ np.linalg.solve(covariance, error)),
    }


def velocity_products(
    pictures: Sequence[UInt16[np.ndarray, "rows columns"]], estimate: VelocityEstimate | None, true: Horizontal
) -> dict[str, object]:
    """Arrays from which a case's figures are drawn."""
    kept: dict[str, object] = {f"image_{number}": counts for number, counts in enumerate(pictures, start=1)}
    if estimate is not None and isinstance(estimate.details, DimesDetails):
        kept.update(dimes_products(estimate.details))
    kept["velocity_true_m_s"] = true
    if estimate is not None and estimate.velocity_m_s is not None:
        kept["velocity_estimated_m_s"] = estimate.velocity_m_s
    return kept
