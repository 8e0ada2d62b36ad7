"""The three pictures, taken through the camera as it truly is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.descent.faults import clouds_over, delivered
from marsyard.scenarios.descent.haze import veiled
from marsyard.scenarios.descent.heat_shield import HeatShield
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import World
from marsyard.scenarios.exposure import render_state
from marsyard.scenarios.optics import Optics
from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Scene
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams


def expose(
    p: DescentScenarioParameters,
    world: World,
    states: Sequence[State],
    optics: Optics,
    detector: Detector,
    streams: Streams,
) -> list[UInt16[np.ndarray, "rows columns"]]:
    """The pictures of these states as they are delivered, in their order."""
    taken = exposures(p, world, states, optics, detector, streams)
    return delivered(p.faults, [one.counts for one in taken])


@dataclass(frozen=True)
class Exposure:
    """A picture as the detector made it, and the frame that it saw."""

    counts: UInt16[np.ndarray, "rows columns"]
    frame: Frame


def exposures(
    p: DescentScenarioParameters,
    world: World,
    states: Sequence[State],
    optics: Optics,
    detector: Detector,
    streams: Streams,
) -> Iterator[Exposure]:
    """The pictures of these states before faults of their delivery, one after the other."""
    scene = _scene(p, world, states, optics, streams)
    mounting = _mounting(p, streams)
    shield = _shield(p, states[0], streams)
    noise = streams.generator("detector noise")
    for state in states:
        # the camera sits at the body's origin: its mounting turns it, but moves it nowhere
        frame, motion = render_state(p.render.backend, scene, optics, state, mounting)
        yield Exposure(detector.expose(_light(p, world, frame, shield, state.time_s), noise, motion), frame)


def _scene(
    p: DescentScenarioParameters, world: World, states: Sequence[State], optics: Optics, streams: Streams
) -> Scene:
    """One scene for all pictures."""
    first, last = states[0].position_m, states[-1].position_m
    below_first, below_last = (float(world.surface.height(place[0], place[1])) for place in (first, last))
    return world.scene(
        float(first[0]),
        float(first[1]),
        float(last[2]) - below_last,
        optics.rays.pixel_rad,
        caster_diameter_m=p.lander.caster_diameter_m,
        clouds=clouds_over(p.faults, below_first, streams.generator("clouds")),
    )


def _light(
    p: DescentScenarioParameters, world: World, frame: Frame, shield: HeatShield | None, time_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Radiance factor at the lens, over the sunlight for which the detector's responsivity is stated."""
    radiance = frame.radiance
    if p.faults.haze > 0.0:
        radiance = veiled(frame, p.faults.haze, world.sun, world.air)
    if shield is not None:
        radiance = shield.over(radiance, frame, world.sun, time_s)
    return radiance * np.float32(world.brightness)


def _mounting(p: DescentScenarioParameters, streams: Streams) -> RigidTransform:
    """How the camera is truly turned in the body: by a little, not known to the lander."""
    tilt = np.radians(p.camera.alignment_error_deg) * streams.generator("camera alignment").standard_normal(3)
    return RigidTransform.from_rotation(Rotation.from_rotvec(tilt))


def _shield(p: DescentScenarioParameters, first: State, streams: Streams) -> HeatShield | None:
    if p.faults.heat_shield_deg == 0.0:
        return None
    return HeatShield.drawn(first, float(np.radians(p.faults.heat_shield_deg)), streams.generator("heat shield"))
