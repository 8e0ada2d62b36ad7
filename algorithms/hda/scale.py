"""The scale of motion and structure from the laser altimeter."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.hda.motion import Motion
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.structure import depth_bounds, match_pixels
from marsyard.algorithms.hda.view import View

#: Pixels about the laser's spot that are matched: their median depth is the spot's.
SPOT_OFFSETS_PX = np.arange(-4.0, 5.0, 2.0)
#: Least number of them that must be found for it.
LEAST_IN_SPOT = 5


def scale_factor(
    views: tuple[View, View], motion: Motion, places: Float[np.ndarray, "n 2"], range_m: float, options: HdaOptions
) -> float:
    """By what lengths of the motion are to be multiplied for the depth on the optical axis to be the laser's range.

    The pixels about the laser's spot are matched as structure is; where too few are found, the depth is that of the
    plane through the features' inverse depths (`places` are their undistorted coordinates). The paper sets the
    features' initial depths by the range and leaves the scale where the iteration leaves it.
    """
    spot, _ = views[0].camera.project(np.array([[0.0, 0.0, 1.0]]))
    across, down = np.meshgrid(SPOT_OFFSETS_PX, SPOT_OFFSETS_PX)
    pixels = np.rint(spot) + np.column_stack([across.ravel(), down.ravel()])
    room = options.search_half_px + 1
    inside = np.all((pixels >= room) & (pixels < np.array(views[0].camera.size) - room), axis=1)
    bounds = depth_bounds(motion.depth_range_m, options.depth_margin)
    spot_matches = match_pixels(views, motion.second_from_first, pixels[inside], bounds, options)
    depths = spot_matches.depths[spot_matches.accepted]
    if len(depths) >= LEAST_IN_SPOT:
        return range_m / float(np.median(depths))
    design = np.column_stack([places, np.ones(len(places))])[motion.inliers]
    plane = np.linalg.lstsq(design, 1.0 / motion.depths[motion.inliers], rcond=None)[0]
    return range_m * float(plane[2])
