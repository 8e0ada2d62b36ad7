"""What the helicopter's computer holds: pictures, poses, the laser's range, the inclinometers' vertical."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from marsyard.scenarios.landing.faults import faulty_ranges
from marsyard.scenarios.landing.flight import Flight, calibrated_camera
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import Pair
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams


def measure(p: LandingScenarioParameters, flight: Flight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """The measurements of a case.

    The a-priori site is the ground on the first picture's optical axis, at the range measured; where the laser returned
    none, at the height that was commanded.
    """
    unit = RangingUnit.drawn(p.laser, streams.generator("laser"))
    reading = unit.readings(np.zeros(1), np.array([pair.axis_range_m]), streams.generator("laser noise"))
    slant = float(faulty_ranges(p.faults, reading.values, p.height_m)[0])
    camera = calibrated_camera(p, streams).binned(columns=1, rows=p.detector.rows_summed)
    first, second = (replace(image, camera=camera) for image in pair.images)
    ahead = (slant if np.isfinite(slant) else p.height_m) * camera.a
    return LandingMeasurements(
        images=(first, second),
        poses=flight.poses,
        slant_range_m=slant,
        up_body=flight.up_body,
        apriori_site_world=np.asarray(flight.poses[0].world_from_body.apply(ahead)),
    )
