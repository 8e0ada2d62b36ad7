"""Create the measurements of a landing algorithm from the images and the true motion."""

from dataclasses import replace

import numpy as np

from marsyard.scenarios.cameras import draw_calibrated
from marsyard.scenarios.landing.faults import add_range_faults
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.images import Pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor.altimeters import RangingUnit
from marsyard.sim.streams import Streams


def measure(p: LandingScenarioParameters, flight: LandingFlight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """Simulate the measurements of a case.

    The a-priori site is the point on the first optical axis at the measured range, or at the commanded height if there
    is no range.
    """
    unit = RangingUnit.draw(p.laser, streams.generator("laser"))
    reading = unit.readings(np.zeros(1), np.array([pair.range_along_m(unit.axis)]), streams.generator("laser noise"))
    slant = float(add_range_faults(p.faults, reading.values, p.height_m)[0])
    calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
    camera = p.detector.delivered_camera(calibrated)
    first, second = (replace(image, camera=camera) for image in pair.images)
    camera_to_site_m = (slant if np.isfinite(slant) else p.height_m) * camera.a
    return LandingMeasurements(
        images=(first, second),
        poses=flight.poses,
        slant_range_m=slant,
        up_body=flight.up_body,
        apriori_site_world=np.asarray(flight.poses[0].world_from_body.apply(camera_to_site_m)),
    )
