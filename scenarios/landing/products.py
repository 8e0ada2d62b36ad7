"""Arrays of a landing case for its figures.

Sections and figures are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from typing import Any

import numpy as np

from marsyard.algorithms.hda import HdaDetails, hda_products
from marsyard.algorithms.interface import SiteEstimate
from marsyard.scenarios.landing.motion_columns import true_motion
from marsyard.scenarios.landing.rendered_flight import RenderedFlight
from marsyard.scenarios.landing.score import true_site


def case_products(case: RenderedFlight, estimate: SiteEstimate) -> dict[str, Any]:
    """Return the arrays for the case's figures.

    The arrays are those of `marsyard.algorithms.hda.hda_products` (Figs. 1-5 and 7), and:

    - `image_1`, `image_2`: the images;
    - `true_rotation`, `true_translation`: true motion from the first to the second camera's frame;
    - `true_positions`, `true_slope`, `true_roughness`, `true_safe`, `true_covered`: sampling grid of the truth,
      world axes;
    - `true_heights`, `true_corner`, `true_spacing`: exact heights, world axes (row i at y = corner[1] + i spacing);
    - `camera_true`, `camera_estimated`: body poses at the first image (4 x 4), true and estimated on board;
    - `limits`: the algorithm's limits of slope (radians) and roughness (metres), and the lander's diameter;
    - `site_true`: true x, y of the reported site (see `site_row`).
    """
    p, flight, pair, truth = case.p, case.flight, case.pair, case.truth
    arrays: dict[str, Any] = {"image_1": pair.counts[0], "image_2": pair.counts[1]}
    if isinstance(estimate.details, HdaDetails):
        arrays |= hda_products(estimate.details)
    second_from_first = true_motion(flight, pair)
    arrays |= {
        "true_rotation": second_from_first.rotation.as_matrix(),
        "true_translation": np.array(second_from_first.translation),
        "true_positions": truth.positions,
        "true_slope": truth.footprints.slope_rad,
        "true_roughness": truth.footprints.roughness_m,
        "true_safe": truth.footprints.safe,
        "true_covered": truth.covered,
        "true_heights": truth.relief.heights_m,
        "true_corner": np.array([truth.relief.west_m, truth.relief.south_m]),
        "true_spacing": np.array([truth.relief.spacing_m]),
        "camera_true": flight.states[0].world_from_body.as_matrix(),
        "camera_estimated": flight.poses[0].world_from_body.as_matrix(),
        "limits": np.array([p.hda.max_slope_rad, p.hda.max_roughness_m, truth.limits.diameter_m]),
    }
    site = true_site(estimate, flight)
    return arrays if site is None else {**arrays, "site_true": site}
