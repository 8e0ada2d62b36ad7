"""What of a landing's pictures a network can learn from: each with what is true of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from marsyard.scenarios.exposure import pixel_sample
from marsyard.scenarios.landing.truth import GroundTruth, RenderedFlight
from marsyard.scenarios.samples import Sample, summed_rows

#: Values of a hazard map: a lander's footprint about the pixel's point is safe, is not, or is not all in sight.
SAFE, UNSAFE, UNKNOWN = 0, 1, 255


def landing_samples(flown: RenderedFlight) -> Iterator[Sample]:
    """The two pictures of a case as they are delivered, with the truth of their pixels."""
    p, pair = flown.p, flown.pair
    for frame, image, state in zip(pair.frames, pair.images, flown.flight.states, strict=True):
        about: dict[str, Any] = {
            "site": p.site,
            "time_s": image.time_s,
            "position_m": state.position_m.tolist(),
            "world_from_body_xyzw": state.attitude.as_quat().tolist(),
            "sun_direction": flown.world.sun.direction.tolist(),
            "lander": p.lander.model_dump(mode="json"),
        }
        hazard = hazard_map(flown.truth, frame.points_world()[summed_rows(p.detector.rows_summed)])
        yield pixel_sample(image.counts, frame, p.detector, image.camera, about, hazard)


def hazard_map(truth: GroundTruth, points: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns"]:
    """What a lander would stand on about each pixel's point, at the nearest of the truth's places."""
    origin = truth.places[0, 0]
    axes = np.stack([truth.places[0, 1] - origin, truth.places[1, 0] - origin], axis=1)
    cells = np.linalg.solve(axes, (points[..., :2] - origin).reshape(-1, 2).T).T
    inside = np.asarray(np.isfinite(cells).all(axis=1))
    columns, rows = np.rint(np.where(inside[:, None], cells, -1.0)).astype(np.int64).T
    shape = truth.covered.shape
    inside &= (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
    hazard = np.full(len(cells), UNKNOWN, dtype=np.uint8)
    at = rows[inside], columns[inside]
    told = np.where(truth.footprints.safe[at], SAFE, UNSAFE)
    hazard[inside] = np.where(truth.covered[at], told, UNKNOWN)
    return hazard.reshape(points.shape[:2])
