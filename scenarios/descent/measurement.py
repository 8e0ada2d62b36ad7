"""What the lander's computer holds when the third picture has arrived."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenarios.descent.exposure import Exposure
from scenarios.descent.flight import mean_velocities
from scenarios.descent.optics import Optics
from scenarios.descent.parameters import DescentScenarioParameters
from sim.dynamics import ParachuteDescent
from sim.measurements import AltitudeMeasurement, DescentMeasurements, DetectorImage
from sim.render import Sun
from sim.sensor import Altimeter, Detector, Navigation
from sim.streams import Streams


def measure(
    p: DescentScenarioParameters,
    descent: ParachuteDescent,
    exposures: Sequence[Exposure],
    sun: Sun,
    optics: Optics,
    detector: Detector,
    altimeter: Altimeter,
    streams: Streams,
) -> DescentMeasurements:
    """Pictures and readings. Attitude and altitude are those of the tagged times, not of the exposures."""
    navigation = Navigation.drawn(p.navigation, streams.generator("navigation bias"))
    clock = streams.generator("image time tags")
    attitude_noise = streams.generator("attitude noise")
    altitude_noise = streams.generator("altimeter noise")
    velocity_noise = streams.generator("velocity noise")
    camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
    images, attitudes, altitudes = [], [], []
    for exposure in exposures:
        tag = navigation.tag(exposure.state.time_s, clock)
        at_tag = descent.state(tag)
        images.append(DetectorImage(exposure.counts, tag, camera, detector.calibration))
        attitudes.append(navigation.attitude(at_tag.attitude, tag, attitude_noise))
        altitudes.append(AltitudeMeasurement(altimeter.measure(at_tag.position_m, altitude_noise), tag))
    true = mean_velocities([exposure.state for exposure in exposures])
    velocities = [navigation.velocity(one, velocity_noise) for one in true]
    return DescentMeasurements(
        images=(images[0], images[1], images[2]),
        attitudes=(attitudes[0], attitudes[1], attitudes[2]),
        altitudes=(altitudes[0], altitudes[1], altitudes[2]),
        interval_velocities_m_s=np.stack(velocities),
        sun_direction=sun.direction,
    )
