"""Map-relative localisation as in the Lander Vision System of Mars 2020: coarse stage, fine stage, navigation filter.

1. Inertial data propagate the state from the start.
2. The coarse stage matches large patches of the first images over the whole uncertainty of the position.
3. The fine stage matches landmarks of the map in each further image; they update the filter.

The sources of the steps and of the options are in `marsyard.algorithms.localisation.options`. If the fine stage fails
in several consecutive images, the fix is discarded: the filter returns to the state of pure inertial navigation, and
the coarse stage is repeated.
"""

import copy

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.localisation.coarse import CoarseFix, find_coarse_position
from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.fine import match_landmarks
from marsyard.algorithms.localisation.inertial_state import MOTION, POSITION
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.landmarks import Landmarks, select_landmarks
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.navigation_filter import LocalisationFilter
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.algorithms.localisation.state_updates import GroundHeight, GroundModel, LandmarkMeasurement, UpdateOutcome
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements

#: Distance over which the slope of the map's elevation is measured, map pixels.
_SLOPE_PX = 4.0


class MapRelativeEstimator:
    """`PositionEstimator` with a coarse and a fine stage."""

    def __init__(self, options: LvsOptions | None = None) -> None:
        self.options = LvsOptions() if options is None else options

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state for a new descent, and select the landmarks of the map."""
        self._map = map_product
        self._landmarks: Landmarks = select_landmarks(map_product, self.options)
        # pure inertial navigation: the filter returns to it when a coarse fix is discarded
        self._inertial = LocalisationFilter.from_initial(initial, self.options.imu)
        self._filter = self._inertial
        self._has_fix = False
        self._increments_since_fix: list[ImuIncrements] = []
        self._coarse_images: list[tuple[PosedImage, float]] = []
        self._altitudes: list[AltitudeMeasurement] = []
        self._failures = 0
        self._is_contradicted = False
        self._last_update_s: float | None = None

    def process_increments(self, increments: ImuIncrements) -> None:
        """Propagate the state by inertial increments; pure inertial navigation follows if the fix is discarded."""
        self._filter.propagate(increments)
        if self._has_fix:
            self._increments_since_fix.append(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Update the state by an altitude, if the position on the map is known; store it otherwise.

        An altitude outside of the stored inertial data is ignored.
        """
        if not self._filter.is_stored(measurement.time_s):
            return
        self._altitudes = [*self._altitudes, measurement][-self.options.coarse_altitudes :]
        if self._has_fix:
            self._update_altitude(measurement, self._ground_height)

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Match an image with the map, and return the state at its time.

        An image outside of the stored inertial data is refused with OUTSIDE_INERTIAL_DATA, and not used.
        """
        if not self._filter.is_stored(image.time_s):
            return PositionEstimate(PositionOutcome.OUTSIDE_INERTIAL_DATA, self._filter.time_s)
        state = self._filter.state_at(image.time_s)
        posed = PosedImage.from_detector(image, state.position_m, state.world_from_body)
        coarse_position = None
        if not self._has_fix:
            coarse_position = self._run_coarse_stage(posed)
            if coarse_position is None:
                return self._answer(image.time_s, LocalisationDetails("coarse"))
            state = self._filter.state_at(image.time_s)
            posed = PosedImage.from_detector(image, state.position_m, state.world_from_body)
        return self._run_fine_stage(image, posed, coarse_position)

    def finish(self) -> PositionEstimate:
        """Return the state at the time of the last increment."""
        return self._answer(self._filter.time_s, None)

    def _run_coarse_stage(self, image: PosedImage) -> Float[np.ndarray, "2"] | None:
        """Collect images; with enough of them, search the map. Returns the position found (east, north)."""
        height = self._height_above_ground(image.time_s)
        if height is None:
            return None
        self._coarse_images = [*self._coarse_images, (image, height)][-self.options.coarse_images :]
        if len(self._coarse_images) < self.options.coarse_images:
            return None
        state = self._inertial.state_at(image.time_s)
        images, heights = zip(*self._coarse_images, strict=True)
        fix = find_coarse_position(images, heights, self._map, state.covariance[MOTION, MOTION], self.options)
        if not isinstance(fix, CoarseFix):
            return None
        position_m = state.position_m[:2] + fix.offset_m
        updated = copy.deepcopy(self._inertial)
        if updated.update_position(image.time_s, position_m, fix.covariance) is not UpdateOutcome.APPLIED:
            return None
        self._filter = updated
        self._has_fix, self._failures, self._is_contradicted, self._last_update_s = True, 0, False, None
        for altitude in self._altitudes:
            # at the time of the altitude, the state does not yet contain the fix
            if self._inertial.is_stored(altitude.time_s):
                below_m = self._inertial.state_at(altitude.time_s).position_m[:2] + fix.offset_m
                level_ground = elevation_at(self._map, below_m), np.zeros(2)
                self._update_altitude(altitude, level_ground)
        return np.asarray(position_m)

    def _run_fine_stage(
        self, image: DetectorImage, posed: PosedImage, coarse_position: Float[np.ndarray, "2"] | None
    ) -> PositionEstimate:
        """Match landmarks and update the state; after several failures the coarse stage is repeated."""
        options, covariance = self.options, self._filter.state_at(image.time_s).covariance
        position_sd_m = np.sqrt(np.diag(covariance)[POSITION])  # east, north, up
        matches = match_landmarks(posed, self._landmarks, self._map, position_sd_m, options)
        if len(matches) == 0:
            return self._count_failure(
                image.time_s, LocalisationDetails("fine", coarse_position), is_contradicted=False
            )
        point_sd_m = np.array([self._map.distortion_sd_m, self._map.distortion_sd_m, self._map.elevation_sd_m])
        height_m = max(float(posed.position_m[2]) - elevation_at(self._map, posed.position_m[:2]), 0.0)
        # error common to all landmarks of an image: of the map, and of the camera's alignment (horizontal)
        common_sd_m = np.hypot(
            options.common_fraction * point_sd_m, height_m * options.calibration_sd_rad * np.array([1.0, 1.0, 0.0])
        )
        # The filter treats these errors as independent between images, but they are equal in N successive images. Its
        # mean over N images has the right variance if that of one image is multiplied by N.
        filter_common_sd_m = np.sqrt(options.correlated_images) * common_sd_m
        measurement = LandmarkMeasurement(
            image.camera,
            matches.points_m,
            matches.measured_px,
            pixel_sd=options.landmark_sd_px * matches.working_pixel,
            point_sd_m=point_sd_m,
            common_sd_m=filter_common_sd_m,
            is_rigid=True,
            alignment_sd_rad=options.calibration_sd_rad,
        )
        result = self._filter.update_landmarks(image.time_s, measurement)
        details = LocalisationDetails(
            "fine",
            coarse_position,
            int(np.count_nonzero(result.inliers)),
            matches.measured_px,
            matches.residuals_px,
            result.inliers,
        )
        if result.outcome is not UpdateOutcome.APPLIED:
            return self._count_failure(image.time_s, details, is_contradicted=True)
        self._failures, self._is_contradicted, self._last_update_s = 0, False, image.time_s
        return self._answer(image.time_s, details)

    def _count_failure(self, time_s: float, details: LocalisationDetails, *, is_contradicted: bool) -> PositionEstimate:
        """Count an image without an update, and return its answer; after `max_failures` of them, discard the fix.

        Landmarks that contradict the state make its covariance doubtful: no position is reported until the next update.
        """
        self._failures += 1
        self._is_contradicted |= is_contradicted
        if self._failures >= self.options.max_failures:
            self._has_fix, self._filter, self._coarse_images = False, self._inertial, []
            for increments in self._increments_since_fix:
                self._inertial.propagate(increments)
            self._increments_since_fix = []
            return PositionEstimate(PositionOutcome.INCONSISTENT, time_s, details=details)
        return self._answer(time_s, details)

    def _answer(self, time_s: float, details: LocalisationDetails | None) -> PositionEstimate:
        """Return the state at a time, if it is supported by a recent update and the position is certain enough."""
        if not self._has_fix:
            return PositionEstimate(PositionOutcome.NO_COARSE_FIX, time_s, details=details)
        if self._is_contradicted:
            return PositionEstimate(PositionOutcome.INCONSISTENT, time_s, details=details)
        last_s, limit_s = self._last_update_s, self.options.max_update_age_s
        if last_s is None or time_s - last_s > limit_s:
            return PositionEstimate(PositionOutcome.UNCERTAIN, time_s, details=details)
        motion = self._filter.estimate(time_s)
        horizontal = motion.covariance[:2, :2]
        if float(np.sqrt(np.linalg.eigvalsh(horizontal)[-1])) > self.options.max_position_sd_m:
            return PositionEstimate(PositionOutcome.UNCERTAIN, time_s, details=details)
        return PositionEstimate(PositionOutcome.VALID, time_s, *motion, details=details)

    def _height_above_ground(self, time_s: float) -> float | None:
        """Height above the ground at a time, from the last altitude and the inertial vertical velocity."""
        if not self._altitudes:
            return None
        last = self._altitudes[-1]
        velocity = self._inertial.state_at(time_s).velocity_m_s
        return last.altitude_m + float(velocity[2]) * (time_s - last.time_s)

    def _update_altitude(self, measurement: AltitudeMeasurement, ground: GroundModel) -> None:
        """Update the state by an altitude above the ground, by the errors of the altitude and the map's elevation."""
        sd_m = float(np.hypot(self.options.altitude_sd * measurement.altitude_m, self._map.elevation_sd_m))
        self._filter.update_altitude(measurement.time_s, measurement.altitude_m, ground, sd_m)

    def _ground_height(self, position_m: Float[np.ndarray, "2"]) -> GroundHeight:
        """Elevation of the map and its slope (east, north) at a position."""
        step = _SLOPE_PX * self._map.pixel_m
        height = elevation_at(self._map, position_m)
        slope = [
            (elevation_at(self._map, position_m + offset) - elevation_at(self._map, position_m - offset)) / (2.0 * step)
            for offset in step * np.eye(2)
        ]
        return height, np.array(slope)
