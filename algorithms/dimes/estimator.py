"""The DIMES estimator: horizontal velocity from templates tracked in two image pairs.

The method is section II of Johnson et al., "Field Testing of the MER DIMES".
"""

from dataclasses import replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.dimes import overlap, tilt
from marsyard.algorithms.dimes.ground_view import pixels_from_ground, zero_phase_pixel
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.products import DimesDetails, DimesTrack, PairDetails
from marsyard.algorithms.dimes.rectification import rectify_patch
from marsyard.algorithms.dimes.tilt import track_grid
from marsyard.algorithms.dimes.validity import failed_checks, rank_combinations, track_metrics
from marsyard.algorithms.dimes.views import BinnedView, build_views
from marsyard.algorithms.image.correlation import pseudo_normalized_correlation
from marsyard.algorithms.image.peaks import Peak, biquadratic_offset, highest_peak
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements

#: Smallest value of the correlation, at positions where the second image does not show the complete template.
MIN_CORRELATION = -1.0


def mark_border(peak: Peak, searchable: Bool[np.ndarray, "s s"]) -> Peak:
    """Mark a peak that is next to a position that cannot be searched as a peak on the border."""
    rows, columns = slice(max(peak.row - 1, 0), peak.row + 2), slice(max(peak.column - 1, 0), peak.column + 2)
    return replace(peak, on_border=peak.on_border or not searchable[rows, columns].all())


def match_corner(surface: Float[np.ndarray, "s s"], peak: Peak, options: DimesOptions) -> Vector2:
    """Match position (row, column) of the template's upper left pixel in the window, refined as `options` select."""
    integer_peak = np.array([peak.row, peak.column], dtype=np.float64)
    return integer_peak + biquadratic_offset(surface, peak) if options.subpixel else integer_peak


def camera_displacement(corner: Vector2, geometry: overlap.SearchGeometry) -> Vector2:
    """Horizontal displacement (east, north) of the camera between the images, metres.

    Let r1 and r2 be a ground point's offsets from the first and the second nadir point. The displacement is r1 - r2.
    Template and search window are centred at the same offset r1. Therefore r2 - r1 is the match's shift from the
    window's centre times the ground sample distance, with rows running south.
    """
    shift = corner - geometry.search_px
    return np.asarray(geometry.gsd_m * np.array([-shift[1], shift[0]]))


def track_pair(pair: int, first: BinnedView, second: BinnedView, options: DimesOptions) -> PairDetails:
    """Select and track the templates of one pair of views."""
    geometry = overlap.search_geometry(first, second, options)
    candidates = overlap.template_candidates(first, second, geometry, options)
    selection, contrasts = overlap.select_templates(first, candidates, options)
    tracks = []
    for index, (candidate, contrast) in enumerate(zip(selection, contrasts, strict=True)):
        ground = candidates.ground[candidate]
        template = rectify_patch(first, ground, geometry.template_px, geometry.gsd_m, full_camera=False)
        window = rectify_patch(second, ground, geometry.window_px, geometry.gsd_m, full_camera=False)
        searchable = overlap.searchable_positions(second, ground, geometry, options)
        surface = np.where(searchable, pseudo_normalized_correlation(template, window), MIN_CORRELATION)
        peak = mark_border(highest_peak(surface), searchable)
        corner = match_corner(surface, peak, options)
        metrics = track_metrics(float(contrast), surface, peak, options)
        displacement = camera_displacement(corner, geometry)
        match_pixel, _ = pixels_from_ground(second, ground - displacement)
        track = DimesTrack(
            pair=pair,
            index=index,
            template_pixel=candidates.pixels[candidate],
            match_pixel=match_pixel,
            ground_m=ground,
            template=template,
            window=window,
            match=corner + 0.5 * (geometry.template_px - 1),
            surface=surface,
            metrics=metrics,
            failed=failed_checks(metrics, options),
            velocity_m_s=displacement / (second.time_s - first.time_s),
        )
        tracks.append(track)
    return PairDetails(
        overlap_polygon=overlap.overlap_polygon(first, second, options),
        zero_phase_pixels=np.stack([zero_phase_pixel(view) for view in (first, second)]),
        gsd_m=geometry.gsd_m,
        tracks=tuple(tracks),
        views=(first, second),
    )


@final
class DimesEstimator:
    """Horizontal velocity estimator: the Descent Image Motion Estimation System (DIMES) of the Mars Exploration Rovers.

    Two templates are tracked in each pair of consecutive images. Each track defines a mean velocity over its pair. The
    estimator selects the combination of a first-pair and a second-pair track whose velocity change agrees best with the
    IMU. It reports the velocity of the second track if the discrepancy is below `DimesOptions.imu_threshold_m_s`. The
    ground is modelled as a level plane at each image's altitude. The IMU is used for velocity changes, and to propagate
    altitudes to the images.
    """

    def __init__(self, options: DimesOptions | None = None) -> None:
        self.options = DimesOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity, with `DimesDetails`.

        Raises ValueError if the images cannot be binned to the size in the options, or if the exposure is too short to
        correct frame transfer; never because of image content or measured values.
        """
        views = build_views(measurements, self.options.binned_size)
        if views is None:
            return VelocityEstimate(VelocityOutcome.NO_TEMPLATE_AREA, None, DimesDetails((), (), None))
        first, second, third = views
        pairs = (track_pair(0, first, second, self.options), track_pair(1, second, third, self.options))
        answer = combine_pairs(pairs, measurements.interval_velocities_m_s, self.options.imu_threshold_m_s)
        return correct_tilt(answer, self.options) if self.options.correct_tilt else answer


def combine_pairs(
    pairs: tuple[PairDetails, PairDetails], interval_velocities_m_s: Float[np.ndarray, "2 3"], imu_threshold_m_s: float
) -> VelocityEstimate:
    """Select the combination of tracks that agrees best with the IMU; return its velocity or a failure outcome."""
    first, second = ([(track.index, track.velocity_m_s) for track in pair.tracks if track.valid] for pair in pairs)
    candidates = rank_combinations(first, second, interval_velocities_m_s)
    if candidates and candidates[0].discrepancy_m_s < imu_threshold_m_s:
        velocity = pairs[1].tracks[candidates[0].second].velocity_m_s
        return VelocityEstimate(VelocityOutcome.VALID, velocity, DimesDetails(pairs, candidates, candidates[0]))
    outcome = VelocityOutcome.IMU_MISMATCH if candidates else VelocityOutcome.NO_VALID_TRACK
    if not all(pair.tracks for pair in pairs):
        outcome = VelocityOutcome.NO_TEMPLATE_AREA
    return VelocityEstimate(outcome, None, DimesDetails(pairs, candidates, None))


def correct_tilt(answer: VelocityEstimate, options: DimesOptions) -> VelocityEstimate:
    """Correct a valid answer for the common tilt of the attitudes, which the inclination of the ground shows.

    The published answer remains if there are too few tracks, or if the fit contradicts the errors of the instruments.
    An inclination that neither tilt nor slope explains is refused, unless its effect on the velocity is small.
    """
    details = answer.details
    if not isinstance(details, DimesDetails) or details.selected is None:
        return answer
    selected = (details.selected.first, details.selected.second)
    velocities = [pair.tracks[index].velocity_m_s for pair, index in zip(details.pairs, selected, strict=True)]
    grids = [
        track_grid(*pair.views, velocity, options) for pair, velocity in zip(details.pairs, velocities, strict=True)
    ]
    if min(len(grid.first) for grid in grids) < tilt.MIN_TRACKS:
        return answer
    fit = tilt.fit_ground(grids, velocities, options)
    if min(fit.tracks) < tilt.MIN_TRACKS or not fit.agrees_with_instruments:
        return answer
    details = replace(details, ground=fit)
    if tilt.is_plausible(fit.inclination, options):
        error = tilt.expected_attitude_error(fit.inclination, options)
        velocity = tilt.levelled_velocity(fit, grids[1].interval_s, error)
        return replace(answer, velocity_m_s=velocity, details=details, attitude_error_rad=error)
    apparent_m_s = np.hypot(*fit.inclination) * abs(fit.displacements_m[1, 2]) / grids[1].interval_s
    if apparent_m_s < options.imu_threshold_m_s:
        return replace(answer, details=details)
    return VelocityEstimate(VelocityOutcome.INCLINED_GROUND, None, details)


def propagate_velocity(
    velocity_m_s: Vector2, inertial_at_estimate_m_s: Vector2, inertial_at_end_m_s: Vector2
) -> Vector2:
    """Propagate a horizontal velocity by the IMU, m/s, as to the firing of the thrusters near 100 m (section I).

    `inertial_at_estimate_m_s` is the mean inertial velocity over the interval of the estimate (second pair),
    `inertial_at_end_m_s` the inertial velocity at the end of the propagation. An error common to both has no effect.
    """
    return np.asarray(velocity_m_s + (inertial_at_end_m_s - inertial_at_estimate_m_s))
