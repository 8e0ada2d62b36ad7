"""Protocol of a position estimator for landing on a map: its measurements, the map, and its answers.

World frame: east, north, up; the map covers a part of its x-y plane. Body frame: that of the inertial unit. An error of
attitude is a rotation vector e in world axes: true attitude = exp(e) estimated attitude.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import ImageStream
from marsyard.sim.measurements import DetectorImage


@dataclass(frozen=True)
class MapProduct:
    """A map made from orbital images: appearance and elevation on one grid of square pixels.

    Row i, column j: the centre of the pixel is at world x = ``origin_m[0] + j * pixel_m``, y = ``origin_m[1] + i *
    pixel_m`` (row 0 is the southernmost). The standard deviations are those that the map's maker states.

    - appearance: relative brightness under the sun of the orbital images
    - elevation_m: height above the world's datum
    - origin_m: world x and y of the centre of pixel (0, 0)
    - registration_sd_m: of the horizontal position of the whole map, per axis
    - distortion_sd_m: of the horizontal position of a feature relative to the whole map, per axis
    - elevation_sd_m: of the elevation
    """

    appearance: Float32[np.ndarray, "rows columns"]
    elevation_m: Float32[np.ndarray, "rows columns"]
    origin_m: Float[np.ndarray, "2"]
    pixel_m: float
    registration_sd_m: float
    distortion_sd_m: float
    elevation_sd_m: float


@dataclass(frozen=True)
class InitialState:
    """State of inertial navigation when the estimator starts, with its covariance.

    - time_s: its time on the clock of the inertial unit
    - covariance: of the errors of position (m), velocity (m/s) and attitude (rad, world axes), in this order
    - gravity_m_s2: local gravity
    """

    time_s: float
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    world_from_body: Rotation
    covariance: Float[np.ndarray, "9 9"]
    gravity_m_s2: float


class PositionOutcome(Enum):
    """Outcome of a position estimate. All members except VALID are expected refusals: no position is reported."""

    VALID = "a position is reported"
    NO_COARSE_FIX = "the search over the map has not found a consistent position"
    INCONSISTENT = "the landmarks contradict each other, or the navigation state"
    UNCERTAIN = (
        "the standard deviation of the horizontal position, or the time since the last update, is above the limit"
    )
    OUTSIDE_INERTIAL_DATA = "the time tag of the image lies outside of the inertial data"


@dataclass(frozen=True)
class PositionEstimate:
    """Answer of a position estimator for one time.

    - outcome: result of the estimation
    - time_s: time of the state, on the clock of the inertial unit
    - position_m, velocity_m_s, world_from_body: state of the body frame's origin; None unless the outcome is VALID
    - covariance: of the errors of position (m), velocity (m/s) and attitude (rad, world axes); None unless VALID
    - details: intermediate products for figures and diagnosis, or None
    """

    outcome: PositionOutcome
    time_s: float
    position_m: Float[np.ndarray, "3"] | None = None
    velocity_m_s: Float[np.ndarray, "3"] | None = None
    world_from_body: Rotation | None = None
    covariance: Float[np.ndarray, "9 9"] | None = None
    details: object | None = None


#: Stream that estimates a lander's position on a map. `start` receives the initial state and the map. All increments
#: up to an image arrive before it. `process_image` returns the estimate at the time of the image, and `finish` that at
#: the time of the last increment; an answer with another time is a BAD_ANSWER. An image whose time tag lies outside of
#: the inertial data is refused with OUTSIDE_INERTIAL_DATA, at the nearest time of these data; such an altitude is
#: ignored.
PositionEstimator = ImageStream[[InitialState, MapProduct], DetectorImage, PositionEstimate]
