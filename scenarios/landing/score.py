"""Result columns of a landing case: answer, map, site and touchdown, compared with the truth.

Sections, figures and tables are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import numpy as np

from marsyard.algorithms.hda import HdaDetails
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.map_errors import SampledMap, count_hazards, map_errors
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.touchdown import Touchdown, horizontal_distance_m

NAN = float("nan")
#: Minimum distance of a site from hazards, as a fraction of the distance of the farthest position.
MIN_CLEARANCE_FRACTION = 0.5
#: Columns of the true ground under a lander; their prefix is the name of the position (`site`, `touchdown`).
GROUND_COLUMNS = ("east_m", "north_m", "slope_deg", "roughness_m", "hazard_distance_m", "margin")
TOUCHDOWN_COLUMNS = (
    "touchdown_error_gps_m", "touchdown_error_estimated_m", "touchdown_error_m", "gps_sd_north_m",
    "gps_sd_east_m", "gps_solutions", "landing_iterations", "landing_path_change_m", "landing_after_s",
    "touchdown_sink_m_s", "touchdown_horizontal_speed_m_s",
)  # fmt: skip


def outcome_row(estimate: SiteEstimate) -> dict[str, Scalar]:
    """Compute the outcome columns that select requirement populations; a crashed algorithm has no such columns."""
    return {
        "converged": estimate.outcome.converged,
        "site_reported": estimate.outcome is SiteOutcome.SAFE_SITE,
        "no_site_reported": estimate.outcome is SiteOutcome.NO_SAFE_SITE,
    }


def site_row(estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth) -> dict[str, Scalar]:
    """Compare the reported site with the ground truth.

    The true site is the reported site minus the navigation error at the first image. Only the outcome SAFE_SITE
    reports a site. If the algorithm did not converge, the helicopter descends to the a-priori site. The numbers of the
    site and `descent_target_safe` then describe the a-priori site, and `site_safe` is false.

    `answer_correct`: the site is safe, or no site is reported and no safe site with margin exists. Where only narrow
    sites exist, both answers are correct, because a narrow site leaves no margin for the errors of the algorithm.
    `site_clearance_fraction` is the distance of the reported site from the nearest hazard in both images, divided by
    that of the farthest position; NaN without a site or without hazards. `site_far_from_hazards`: it is at least
    `MIN_CLEARANCE_FRACTION`. The paper selects the safe site that is farthest from all hazards (section III).
    """
    position = true_site(estimate, flight)
    row = _ground_row("site", position, truth)
    is_target_safe, reports_site = bool(row["site_safe"]), estimate.outcome is SiteOutcome.SAFE_SITE
    reports_safe_site, refuses = reports_site and is_target_safe, estimate.outcome is SiteOutcome.NO_SAFE_SITE
    clearance = truth.clearance_fraction(position) if reports_site and position is not None else NAN
    return {
        **row,
        "site_safe": reports_safe_site,
        "descent_target_safe": is_target_safe,
        "safe_or_no_site_reported": reports_safe_site or refuses,
        "answer_correct": reports_safe_site or (refuses and not np.any(truth.safe_with_margin)),
        "site_clearance_fraction": clearance,
        "site_far_from_hazards": clearance >= MIN_CLEARANCE_FRACTION,
    }


def true_site(estimate: SiteEstimate, flight: LandingFlight) -> np.ndarray | None:
    """Compute the true x, y of the reported site; None without a site."""
    return None if estimate.site_world is None else (estimate.site_world - flight.position_error_m)[:2]


def _ground_row(name: str, position: np.ndarray | None, truth: GroundTruth) -> dict[str, Scalar]:
    """Compute the columns of the true ground under a lander at a position (x, y)."""
    columns = [f"{name}_{column}" for column in GROUND_COLUMNS]
    footprint = None if position is None else truth.footprint_at(position)
    if position is None or footprint is None:
        return {f"{name}_safe": False, **dict.fromkeys(columns, NAN)}
    slope_deg, roughness_m = float(np.degrees(footprint.slope_rad[0])), float(footprint.roughness_m[0])
    # smaller of the two relative margins: 0.2 if slope or roughness is at 80 % of its limit
    limits = truth.limits
    margin = 1.0 - max(float(footprint.slope_rad[0]) / limits.max_slope_rad, roughness_m / limits.max_roughness_m)
    values = (*map(float, position), slope_deg, roughness_m, truth.distance_to_hazard_m(position), margin)
    return {f"{name}_safe": bool(footprint.safe[0]), **dict(zip(columns, values, strict=True))}


def landing_row(
    touchdown: Touchdown | None, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of the touchdown and of the ground under it.

    `touchdown_error_gps_m` is the distance from the receiver's averaged solutions to the site's coordinates, as
    measured in the paper. `touchdown_error_m` is the distance from the true touchdown to the true site, which
    excludes the navigation error at the first image. `touchdown_safe` is true if the ground under the helicopter is
    safe. `touchdown_sink_m_s` and `touchdown_horizontal_speed_m_s` are the vertical and horizontal speeds at
    touchdown. `gps_solutions` is the number of averaged solutions; `gps_sd_north_m` and `gps_sd_east_m` are the
    means of the standard deviations that the receiver reports. `landing_after_s` is the time from the second image
    to touchdown. `landing_iterations` and `landing_path_change_m` are the number of iterations of flight and filter
    and the change of the path in the last iteration (`marsyard.scenarios.landing.touchdown`). Without a touchdown,
    numbers are NaN, and `touchdown_safe` is missing.
    """
    site = estimate.site_world
    if touchdown is None or site is None:
        columns = (*(f"touchdown_{column}" for column in GROUND_COLUMNS), *TOUCHDOWN_COLUMNS)
        return {"landed": False, **dict.fromkeys(columns, NAN)}
    position, velocity = touchdown.state.position_m, touchdown.state.velocity_m_s
    ground_row = _ground_row("touchdown", position[:2], truth)
    return {
        "landed": True,
        **ground_row,
        "touchdown_error_gps_m": horizontal_distance_m(touchdown.gps_m, site),
        "touchdown_error_estimated_m": horizontal_distance_m(touchdown.estimated_m, site),
        "touchdown_error_m": horizontal_distance_m(position, site - flight.position_error_m),
        "gps_sd_north_m": float(touchdown.gps_deviation_m[1]),
        "gps_sd_east_m": float(touchdown.gps_deviation_m[0]),
        "gps_solutions": touchdown.gps_solutions,
        "landing_iterations": touchdown.iterations,
        "landing_path_change_m": touchdown.path_change_m,
        "landing_after_s": touchdown.time_s - flight.states[1].time_s,
        "touchdown_sink_m_s": -float(velocity[2]),
        "touchdown_horizontal_speed_m_s": float(np.hypot(*velocity[:2])),
    }


def map_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of map errors and hazard counts; only the relief error, NaN, without a map."""
    row: dict[str, Scalar] = {"relief_error_fraction": NAN}
    if not isinstance(estimate.details, HdaDetails) or estimate.details.ground is None:
        return row
    ground = estimate.details.ground
    sampled_map = SampledMap.sample(ground, flight, truth, (p.hda.max_slope_rad, p.hda.max_roughness_m))
    return {**row, **map_errors(ground, flight, sampled_map, truth), **count_hazards(ground, sampled_map, truth)}
