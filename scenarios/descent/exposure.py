"""The three pictures, taken through the camera as it is truly mounted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from scenarios.descent.optics import Optics
from scenarios.descent.parameters import DescentScenarioParameters
from scenarios.descent.world import World
from sim.dynamics import State
from sim.render import process_renderer
from sim.sensor import Detector, ImageMotion
from sim.streams import Streams


@dataclass(frozen=True)
class Exposure:
    """Truth and picture of one exposure."""

    state: State
    counts: UInt16[np.ndarray, "rows columns"]


def expose(
    p: DescentScenarioParameters,
    world: World,
    states: Sequence[State],
    optics: Optics,
    detector: Detector,
    streams: Streams,
) -> list[Exposure]:
    """The pictures of these states, in their order."""
    renderer = process_renderer(p.render.backend)
    first, last = states[0].position_m, states[-1].position_m
    lowest = float(last[2] - world.surface.height(last[0], last[1]))
    pixel_rad = float(np.median(optics.rays.pixel_angles))
    scene = world.scene(float(first[0]), float(first[1]), lowest, pixel_rad, p.lander.caster_diameter_m)
    mounting = _mounting(p, streams)
    noise = streams.generator("detector noise")
    exposures = []
    for state in states:
        frame = renderer.render(scene, optics.rays, state.world_from_body * mounting)
        # the camera sits at the body's origin: its mounting turns it, but moves it nowhere
        motion = ImageMotion.seen(
            optics.camera,
            frame.range_m,
            frame.world_from_body,
            state.velocity_m_s,
            state.attitude.apply(state.body_rate_rad_s),
        )
        light = frame.radiance * np.float32(world.brightness)
        exposures.append(Exposure(state, detector.expose(light, noise, motion)))
    return exposures


def _mounting(p: DescentScenarioParameters, streams: Streams) -> RigidTransform:
    """How the camera is truly turned in the body: by a little, not known to the lander."""
    tilt = np.radians(p.camera.alignment_error_deg) * streams.generator("camera alignment").standard_normal(3)
    return RigidTransform.from_rotation(Rotation.from_rotvec(tilt))
