"""What of a descent's pictures a network can learn from: each with what is true of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from marsyard.scenarios.descent.exposure import exposures
from marsyard.scenarios.descent.flight import flown_descent, picture_states
from marsyard.scenarios.descent.optics import camera_optics
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import World
from marsyard.scenarios.exposure import pixel_sample
from marsyard.scenarios.faults import faulty_detector
from marsyard.scenarios.samples import Sample
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams


def descent_samples(p: DescentScenarioParameters, streams: Streams) -> Iterator[Sample]:
    """The pictures of a case as the detector made them, with the truth of their pixels."""
    world = World.of(p)
    states = picture_states(p, flown_descent(p, world.surface, streams))
    optics = camera_optics(p.camera)
    detector = Detector.drawn(
        optics.fall_off, faulty_detector(p.faults, p.detector), streams.generator("detector response")
    )
    taken = exposures(p, world, states, optics, detector, streams)
    camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
    for state, exposure in zip(states, taken, strict=True):
        frame = exposure.frame
        about: dict[str, Any] = {
            "site": p.site or "plain",
            "time_s": state.time_s,
            # the camera's axes are the body's, turned by the error of its alignment
            "position_m": np.asarray(frame.world_from_body.translation).tolist(),
            "world_from_body_xyzw": frame.world_from_body.rotation.as_quat().tolist(),
            "velocity_m_s": state.velocity_m_s.tolist(),
            "sun_direction": world.sun.direction.tolist(),
        }
        yield pixel_sample(exposure.counts, frame, p.detector, camera, about)
