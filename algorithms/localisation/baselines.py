"""Baselines of localisation: inertial navigation alone, and SIFT features with a perspective-n-point pose (OpenCV)."""

import numpy as np

from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.navigation_filter import LocalisationFilter
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage, binning_factor
from marsyard.algorithms.localisation.sift_pose import MapFeatures, solve_pose
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements


class InertialEstimator:
    """`PositionEstimator` that only propagates the initial state; always VALID."""

    def __init__(self, options: LvsOptions | None = None) -> None:
        self.options = LvsOptions() if options is None else options

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state for a new descent."""
        self._map = map_product
        self._filter = LocalisationFilter.from_initial(initial, self.options.imu)

    def process_increments(self, increments: ImuIncrements) -> None:
        """Propagate the state by inertial increments."""
        self._filter.propagate(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Ignore altitudes."""

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Return the state at the time of the image."""
        if not self._filter.is_stored(image.time_s):
            return PositionEstimate(PositionOutcome.OUTSIDE_INERTIAL_DATA, self._filter.time_s)
        return self._answer(image.time_s)

    def finish(self) -> PositionEstimate:
        """Return the state at the time of the last increment."""
        return self._answer(self._filter.time_s)

    def _answer(self, time_s: float) -> PositionEstimate:
        """Return the propagated state at a time."""
        return PositionEstimate(PositionOutcome.VALID, time_s, *self._filter.estimate(time_s))


class FeatureEstimator(InertialEstimator):
    """`PositionEstimator` that matches SIFT features of each image with those of the map.

    The pose is that of OpenCV's RANSAC for the perspective-n-point problem with the map's elevations. Its position
    updates the state of inertial navigation; its attitude is not used.
    """

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state, and extract the features of the map."""
        super().start(initial, map_product)
        self._features = MapFeatures.extract(map_product, self.options.sift_map_features)
        self._is_valid = False  # whether a pose was found in this descent
        self._altitude_m: float | None = None

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Store the altitude, which determines the scale at which an image is matched.

        An altitude is ignored if its time is outside the inertial data, or if it is not positive.
        """
        if self._filter.is_stored(measurement.time_s) and measurement.altitude_m > 0.0:
            self._altitude_m = measurement.altitude_m

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Estimate the pose from features, and update the position. Without a pose, return the propagated state."""
        if not self._filter.is_stored(image.time_s):
            return PositionEstimate(PositionOutcome.OUTSIDE_INERTIAL_DATA, self._filter.time_s)
        state = self._filter.state_at(image.time_s)
        posed = PosedImage.from_detector(image, state.position_m, state.world_from_body)
        solution = None
        if self._altitude_m is not None:
            factor = binning_factor(posed, self._altitude_m, self._map.pixel_m)
            solution = solve_pose(posed, factor, self._features, self.options)
        if solution is None:
            return self._answer(image.time_s)
        variance = self.options.sift_sd_m**2
        self._filter.update_position(image.time_s, solution.image.position_m[:2], variance * np.eye(2))
        self._is_valid = True
        return self._answer(image.time_s, LocalisationDetails("fine", inliers=solution.inliers))

    def _answer(self, time_s: float, details: LocalisationDetails | None = None) -> PositionEstimate:
        """Return the state at a time; NO_COARSE_FIX before the first pose."""
        if not self._is_valid:
            return PositionEstimate(PositionOutcome.NO_COARSE_FIX, time_s, details=details)
        return PositionEstimate(PositionOutcome.VALID, time_s, *self._filter.estimate(time_s), details=details)
