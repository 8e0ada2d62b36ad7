"""Intermediate products of map-relative localisation, for figures and diagnosis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class LocalisationDetails:
    """Intermediate results of one image.

    - stage: Last stage that was run: `coarse` (search over the map) or `fine` (landmarks)
    - coarse_position_m: Position found by the coarse stage (east, north); None if it found none, or was not run
    - inliers: Number of landmarks that agree with each other and with the state; the update uses only these. The number
      is also given if the update was not applied, for example because they are too few. None without a match. For the
      SIFT baseline: number of features that agree with the solved position.
    - measured_px: Measured pixels of the matched landmarks; None without a match
    - residuals_px: Measured minus expected pixels, after the estimated correction of the state; NaN if not visible
    - used: Whether a matched landmark is one of the inliers, also if the update was not applied
    """

    stage: str
    coarse_position_m: Float[np.ndarray, "2"] | None = None
    inliers: int | None = None
    measured_px: Float[np.ndarray, "n 2"] | None = None
    residuals_px: Float[np.ndarray, "n 2"] | None = None
    used: Bool[np.ndarray, "n"] | None = None
