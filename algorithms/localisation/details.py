"""Intermediate products of map-relative localisation, for figures and diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class LocalisationDetails:
    """Stages of one image.

    - stage: `coarse` (search over the map) or `fine` (landmarks)
    - coarse_offset_m: horizontal correction of the coarse stage (east, north); None if it found none, or was not run
    - inliers: landmarks that updated the state; None without a match
    - measured_px, residuals_px, used: measured pixels of the matched landmarks, their residuals after the common
      correction of the pose, and whether they updated the state; None without a match
    """

    stage: str
    coarse_offset_m: Float[np.ndarray, "2"] | None = None
    inliers: int | None = None
    measured_px: Float[np.ndarray, "n 2"] | None = None
    residuals_px: Float[np.ndarray, "n 2"] | None = None
    used: Bool[np.ndarray, "n"] | None = None
