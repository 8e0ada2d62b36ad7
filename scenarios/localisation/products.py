"""Arrays of a localisation case for its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import PositionEstimate
from marsyard.scenarios.localisation.estimate_errors import compute_errors
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.streamed import StreamAnswers

_NAN = float("nan")

#: Side of the stored map, pixels.
_THUMBNAIL_PX = 512


def case_products(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> Mapping[str, Any]:
    """Return the arrays for a case's figures.

    ::

        track               per estimate: time, error east, north, up, sd east, north, up (m); NaN for a refusal
        outcomes            outcome of each estimate
        inliers             landmarks used in each image; NaN without a match
        true_xy_m           true positions on the map at the images; estimated_xy_m: estimates, NaN for a refusal
        initial_xy_m        initial position (east, north) of inertial navigation
        map                 appearance of the map, reduced; map_extent_m: west, east, south, north
        image_1, image_2    first and last image
        landmarks_px        measured pixels of the landmarks in the last image; landmarks_residual_px: their residuals;
                            landmarks_used: whether the position uses them
    """
    errors = compute_errors(descent, answers)
    nothing = np.full(7, np.nan)
    track = np.stack(
        [nothing if error is None else np.array([error.time_s, *error.position_m, *error.sd_m]) for error in errors]
    )
    estimates = answers.estimates
    details = [estimate.details for estimate in estimates]
    estimated = [np.full(2, np.nan) if item.position_m is None else item.position_m[:2] for item in estimates]
    map_product = descent.measurements.map_product
    side_px = min(_THUMBNAIL_PX, *map_product.appearance.shape)
    low, high = np.quantile(map_product.appearance[::4, ::4], (0.005, 0.995))
    scaled = np.clip(255.0 * (map_product.appearance - low) / max(float(high - low), 1e-9), 0.0, 255.0)
    thumbnail = cv2.resize(scaled.astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_AREA)
    west, south = map_product.origin_m - 0.5 * map_product.pixel_m
    rows, columns = map_product.appearance.shape
    values: dict[str, Any] = {
        "track": track,
        "outcomes": [estimate.outcome.name for estimate in estimates],
        "inliers": np.array(
            [
                _NAN if not isinstance(item, LocalisationDetails) or item.inliers is None else float(item.inliers)
                for item in details
            ]
        ),
        "true_xy_m": descent.map_truth.map_position(np.array([state.position_m[:2] for state in descent.states])),
        "estimated_xy_m": np.stack(estimated),
        "initial_xy_m": descent.measurements.initial.position_m[:2],
        "map": thumbnail.astype(np.uint8),
        "map_extent_m": np.array(
            [west, west + columns * map_product.pixel_m, south, south + rows * map_product.pixel_m]
        ),
    }
    if descent.images:
        values |= {"image_1": descent.images[0].counts, "image_2": descent.images[-1].counts}
    last = details[-2] if len(details) > 1 else None
    if isinstance(last, LocalisationDetails) and last.measured_px is not None:
        values |= {
            "landmarks_px": last.measured_px,
            "landmarks_residual_px": last.residuals_px,
            "landmarks_used": last.used,
        }
    return values
