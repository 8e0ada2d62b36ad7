"""The DIMES estimator: three pictures to a horizontal velocity or 'unsuccessful' (section II.B)."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.dimes.binning import usable_views
from marsyard.algorithms.dimes.consistency import combinations
from marsyard.algorithms.dimes.details import DimesDetails, PairDetails
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.tracking import track_pair
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements


@final
class DimesEstimator:
    """The Descent Image Motion Estimation System of the Mars Exploration Rovers.

    Two templates are tracked between the first and second picture and two between the second and third. The velocity
    reported is that of the second-pair track in the combination of a first- and a second-pair track whose change of
    velocity agrees best with the IMU's, if it agrees within the threshold.

    The ground is taken as level planes, at each picture's own altitude below the body. Images are trusted in their
    calibrated camera model, attitude and time tag; nothing is read from the inertial velocity but its change (and its
    vertical part, to carry altitudes to the time of the pictures).
    """

    def __init__(self, options: DimesOptions | None = None) -> None:
        self.options = DimesOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The estimate; its details are `DimesDetails`.

        Raises
        ------
        ValueError
            If the pictures' size does not bin to the size that the options ask for, or their calibration is not
            possible. Never for what the pictures show or the instruments measure.
        """
        triple = usable_views(measurements, self.options.binned_size)
        if triple is None:
            return VelocityEstimate(VelocityOutcome.NO_TEMPLATE_AREA, None, DimesDetails((), (), None))
        first, second, third = triple
        sun = measurements.sun_direction
        pairs = (
            track_pair(0, first, second, sun, self.options),
            track_pair(1, second, third, sun, self.options),
        )
        return conclude(pairs, measurements.interval_velocities_m_s, self.options.imu_threshold_m_s)


def conclude(
    pairs: tuple[PairDetails, PairDetails],
    interval_velocities_m_s: Float[np.ndarray, "2 3"],
    imu_threshold_m_s: float,
) -> VelocityEstimate:
    """The answer that the tracks of both pairs and the IMU give together."""
    if not all(pair.tracks for pair in pairs):
        return VelocityEstimate(VelocityOutcome.NO_TEMPLATE_AREA, None, DimesDetails(pairs, (), None))
    valid = [[(track.index, track.velocity_m_s) for track in pair.tracks if track.valid] for pair in pairs]
    found = combinations(valid[0], valid[1], interval_velocities_m_s)
    if not found:
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None, DimesDetails(pairs, (), None))
    if not found[0].discrepancy_m_s < imu_threshold_m_s:
        return VelocityEstimate(VelocityOutcome.IMU_MISMATCH, None, DimesDetails(pairs, found, None))
    best = found[0]
    velocity = pairs[1].tracks[best.second].velocity_m_s
    return VelocityEstimate(VelocityOutcome.VALID, velocity, DimesDetails(pairs, found, best))
