"""The protocols that algorithms under test implement, and the answers they give."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from jaxtyping import Float

from sim.measurements import DescentMeasurements


class VelocityOutcome(Enum):
    """How a velocity estimation ended. Every member but VALID is an expected failure: no velocity is reported."""

    VALID = "a velocity is reported"
    NO_TEMPLATE_AREA = "no place in an image pair has room for a template and its search window"
    NO_VALID_TRACK = "in an image pair no template passed the validity checks"
    IMU_MISMATCH = "no combination of tracks agrees with the change of velocity measured by the IMU"


@dataclass(frozen=True)
class VelocityEstimate:
    """An answer to "how fast does the lander move over the ground".

    Attributes
    ----------
    outcome
        How the estimation ended.
    velocity_m_s
        Horizontal velocity (east, north) in m/s: the mean velocity of the camera between the second and the third
        picture; None unless the outcome is VALID.
    details
        The algorithm's intermediate products for figures and diagnosis; None where it keeps none.
    """

    outcome: VelocityOutcome
    velocity_m_s: Float[np.ndarray, "2"] | None
    details: object | None = None


class VelocityEstimator(Protocol):
    """Estimates horizontal velocity from three descent pictures and the measurements taken with them."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The estimate; never raises for a picture, attitude or altitude that an instrument can deliver."""
        ...
