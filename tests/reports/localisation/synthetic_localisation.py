"""Products of a synthetic descent over a map, and rows of a synthetic campaign with known statistics."""

from typing import Any

import numpy as np
import pandas as pd

#: Number of images of the descent; the first two have no estimate.
IMAGES, REFUSED = 6, 2


def synthetic_products() -> dict[str, Any]:
    """Return products in the layout of `localisation.products.case_products`."""
    rng = np.random.default_rng(1)
    times = np.append(0.5 + 2.0 * np.arange(IMAGES), 11.0)
    true = np.array([100.0, -50.0]) + times[:IMAGES, np.newaxis] * np.array([8.0, 3.0])
    errors = rng.normal(0.0, 3.0, (IMAGES + 1, 3))
    # time (s), errors and standard deviations east, north and up (m)
    track = np.column_stack([times, errors, np.full((IMAGES + 1, 3), (3.0, 3.0, 4.0))])
    estimated = np.vstack([true, true[-1]]) + errors[:, :2]
    track[:REFUSED], estimated[:REFUSED] = np.nan, np.nan
    pixels = rng.uniform(10.0, 118.0, (30, 2))
    return {
        "track": track,
        "outcomes": ["NO_COARSE_FIX"] * REFUSED + ["VALID"] * (IMAGES + 1 - REFUSED),
        "inliers": np.array([np.nan] * REFUSED + [80.0, 90.0, 85.0, 24.0] + [np.nan]),
        "true_xy_m": true,
        "estimated_xy_m": estimated,
        "initial_xy_m": np.array([400.0, 300.0]),
        "map": rng.integers(0, 255, (64, 64)).astype(np.uint8),
        "map_extent_m": np.array([-1000.0, 1000.0, -900.0, 1100.0]),
        "image_1": rng.integers(0, 255, (128, 128)).astype(np.uint16),
        "image_2": rng.integers(0, 255, (128, 128)).astype(np.uint16),
        "landmarks_px": pixels,
        "landmarks_residual_px": rng.normal(0.0, 0.3, (30, 2)),
        "landmarks_used": np.arange(30) % 5 > 0,
    }


def refused_products() -> dict[str, Any]:
    """Return products of a descent without images, whose only answer is a refusal."""
    products = synthetic_products()
    for name in ("image_1", "image_2", "landmarks_px", "landmarks_residual_px", "landmarks_used"):
        del products[name]
    no_estimate = {
        "track": np.full((1, 7), np.nan),
        "estimated_xy_m": np.full((1, 2), np.nan),
        "inliers": np.array([np.nan]),
    }
    return {**products, **no_estimate, "outcomes": ["NO_COARSE_FIX"]}


def localisation_frame(cases: int, fixed_fraction: float = 0.9, seed: int = 1) -> pd.DataFrame:
    """Return rows of descents; `fixed_fraction` of them report a position with errors of 4 m (1 sigma) per axis."""
    rng = np.random.default_rng(seed)
    is_fixed = rng.random(cases) < fixed_fraction
    errors = rng.normal(0.0, 4.0, (cases, 3))

    def mask_unreported(values: Any) -> Any:
        return np.where(is_fixed, values, np.nan)

    horizontal = np.hypot(errors[:, 0], errors[:, 1])
    return pd.DataFrame(
        {
            "case": np.arange(cases),
            "outcome": np.where(is_fixed, "VALID", "NO_COARSE_FIX"),
            "answered": is_fixed,
            "fixed_in_time": is_fixed,
            "false_fix": False,
            "coarse_error_m": mask_unreported(2.5 * horizontal),
            "fix_after_s": mask_unreported(rng.uniform(7.1, 9.0, cases)),
            "position_error_at_10_s_m": mask_unreported(1.5 * horizontal),
            "position_error_m": mask_unreported(horizontal),
            "position_error_max_m": mask_unreported(2.0 * horizontal),
            "position_error_world_m": mask_unreported(horizontal + 60.0),
            "position_error_east_m": mask_unreported(errors[:, 0]),
            "position_error_north_m": mask_unreported(errors[:, 1]),
            "position_error_up_m": mask_unreported(errors[:, 2]),
            "position_nees": mask_unreported((horizontal / 4.0) ** 2),
            "velocity_error_m_s": mask_unreported(np.abs(rng.normal(0.0, 0.2, cases))),
            "attitude_error_deg": mask_unreported(np.abs(rng.normal(0.0, 0.05, cases))),
            "inliers_median": mask_unreported(rng.integers(40, 140, cases)),
            "inliers_min": mask_unreported(rng.integers(12, 40, cases)),
            "image_time_max_s": rng.uniform(0.5, 1.5, cases),
            "image_time_median_s": rng.uniform(0.1, 0.3, cases),
            "sun_difference_deg": rng.uniform(0.0, 60.0, cases),
            "image_contrast": rng.uniform(0.02, 0.2, cases),
            "initial_error_m": rng.rayleigh(1000.0, cases),
            "images": 24,
            "terrain": rng.integers(0, 4, cases),
            "wall_time_s": 1.0,
            "cpu_time_s": 1.0,
            "error": "",
            "traceback": "",
        }
    )
