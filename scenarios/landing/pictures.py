"""The two pictures, taken through the camera, and what is true of the first one's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.exposure import render_state
from marsyard.scenarios.faults import faulty_detector
from marsyard.scenarios.landing.faults import delivered
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.world import World
from marsyard.scenarios.optics import Optics
from marsyard.scenarios.views import Eye
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.render import Frame
from marsyard.sim.sensor import Detector, auto_expose
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Pair:
    """Two pictures."""

    images: tuple[DetectorImage, DetectorImage]  #: As delivered, with the true camera
    frames: tuple[Frame, Frame]  #: What was to be seen, without detector

    @property
    def counts(self) -> tuple[UInt16[np.ndarray, "rows columns"], UInt16[np.ndarray, "rows columns"]]:
        """The pictures' counts."""
        return self.images[0].counts, self.images[1].counts

    @property
    def axis_range_m(self) -> float:
        """True range along the first picture's optical axis to ground or rock, metres."""
        frame = self.frames[0]
        column, row = self.images[0].camera.project(np.array([self.images[0].camera.a]))[0][0]
        # the four pixels about the axis, of which the nearest sees at most 0.7 px beside it
        near = frame.range_m[int(row) : int(row) + 2, int(column) : int(column) + 2]
        return float(np.median(near))


def take_pictures(p: LandingScenarioParameters, world: World, flight: Flight, optics: Optics, streams: Streams) -> Pair:
    """The pictures of a flight. The exposure is set on the first and kept."""
    detector = Detector.drawn(
        optics.fall_off, faulty_detector(p.faults, p.detector), streams.generator("detector response")
    )
    caster = max(p.lander.caster_diameter_m, p.faults.own_shadow_m)
    lower = min(flight.states, key=lambda state: float(state.position_m[2]))
    scene = world.scene(Eye.of(optics.rays, lower.world_from_body, world.ground.surface), caster)
    noise = streams.generator("detector noise")
    seen = [render_state(p.render.backend, scene, optics, state) for state in flight.states]
    frames, motions = zip(*seen, strict=True)
    light = [frame.radiance * np.float32(world.brightness) for frame in frames]
    detector = auto_expose(detector, light[0], p.exposure, streams.generator("test pictures")).detector
    counts = [detector.expose(one, noise, motion) for one, motion in zip(light, motions, strict=True)]
    camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
    first, second = (
        DetectorImage(one, state.time_s, camera, detector.calibration)
        for one, state in zip(delivered(p.faults, counts), flight.states, strict=True)
    )
    return Pair((first, second), (frames[0], frames[1]))


def seen_by_both(pair: Pair, flight: Flight, points_m: Float64[np.ndarray, "n 3"], border_px: float) -> np.ndarray:
    """Whether points of the ground (world axes) lie in both pictures, this far from their borders at least."""
    seen = np.ones(len(points_m), dtype=bool)
    for image, state in zip(pair.images, flight.states, strict=True):
        pixels, ahead = image.camera.moved(state.world_from_body).project(points_m)
        with np.errstate(invalid="ignore"):
            low, high = pixels >= border_px, pixels <= np.array(image.camera.size) - 1.0 - border_px
        seen &= ahead & np.all(low & high, axis=1)
    return seen
