"""What of a landing's pictures a network can learn from: each with what is true of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import Pair, take_pictures
from marsyard.scenarios.landing.truth import GroundTruth
from marsyard.scenarios.landing.world import World, camera_optics
from marsyard.scenarios.samples import Sample, summed_rows
from marsyard.sim.streams import Streams

#: Values of a hazard map: a lander's footprint about the pixel's point is safe, is not, or is not all in sight.
SAFE, UNSAFE, UNKNOWN = 0, 1, 255


def landing_samples(p: LandingScenarioParameters, streams: Streams) -> Iterator[Sample]:
    """The two pictures of a case as they are delivered, with the truth of their pixels."""
    world = World.of(p)
    flight = Flight.of(p, world.ground.surface, streams)
    pair = take_pictures(p, world, flight, camera_optics(p.optics), streams)
    truth = GroundTruth.of(world, flight, pair, p.lander.limits)
    for number in range(2):
        yield _sample(p, world, flight, pair, truth, number)


def _sample(
    p: LandingScenarioParameters, world: World, flight: Flight, pair: Pair, truth: GroundTruth, number: int
) -> Sample:
    frame, image, state = pair.frames[number], pair.images[number], flight.states[number]
    rows = summed_rows(p.detector.rows_summed)
    points = frame.points_world()[rows]
    about: dict[str, Any] = {
        "site": p.site,
        "time_s": image.time_s,
        "position_m": state.position_m.tolist(),
        "world_from_body_xyzw": state.attitude.as_quat().tolist(),
        "sun_direction": world.sun.direction.tolist(),
        "lander": p.lander.model_dump(mode="json"),
    }
    return Sample(
        image=image.counts,
        bits=p.detector.bits,
        range_m=frame.range_m[rows].astype(np.float32),
        normal=frame.normal[rows],
        rocks=(frame.body[rows] >= 0).astype(np.uint8),
        hazard=hazard_map(truth, points),
        camera=image.camera,
        about=about,
    )


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
