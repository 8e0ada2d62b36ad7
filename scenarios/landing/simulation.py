"""Simulated landing case: world, flight, images, ground truth and measurements, which all algorithms use."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.scenarios.cameras import camera_optics, draw_calibrated
from marsyard.scenarios.landing.faults import add_range_faults
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.images import Pair, take_images
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.world import LandingWorld
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor.altimeters import RangingUnit
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class RenderedFlight:
    """A flight with its world, images and ground truth."""

    p: LandingScenarioParameters
    world: LandingWorld
    flight: LandingFlight
    pair: Pair
    truth: GroundTruth

    @classmethod
    def simulate(cls, p: LandingScenarioParameters, streams: Streams) -> RenderedFlight:
        """Simulate the flight of a case and take its images."""
        world = LandingWorld.from_parameters(p)
        flight = LandingFlight.from_parameters(p, world.ground.surface, streams)
        pair = take_images(p, world, flight, camera_optics(p.optics), streams)
        return cls(p, world, flight, pair, GroundTruth.from_images(world, flight, pair, p.lander.limits))


def measure(p: LandingScenarioParameters, flight: LandingFlight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """Simulate the measurements of a case; the time tag of an image is that of its pose.

    The a-priori site is the point on the first optical axis at the measured range, or at the commanded height if there
    is no range.
    """
    unit = RangingUnit.draw(p.laser, streams.generator("laser"))
    # one reading at each image: its noise is that with which the flight chose the pair
    count = 1 if flight.transit is None else flight.transit.times_s.size
    ranges = unit.read(np.full(count, pair.range_along_m(unit.axis)), streams.generator("laser noise"))
    slant = float(add_range_faults(p.faults, ranges, p.height_m)[flight.first])
    calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
    camera = p.detector.delivered_camera(calibrated)
    first, second = (
        replace(image, camera=camera, time_s=pose.time_s) for image, pose in zip(pair.images, flight.poses, strict=True)
    )
    camera_to_site_m = (slant if np.isfinite(slant) else p.height_m) * camera.a
    return LandingMeasurements(
        images=(first, second),
        poses=flight.poses,
        slant_range_m=slant,
        up_body=flight.up_body,
        apriori_site_world=np.asarray(flight.poses[0].world_from_body.apply(camera_to_site_m)),
    )
