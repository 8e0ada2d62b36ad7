"""World, pictures and measurements of a landing case."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.exposure import render_state, sunlight_ratio
from marsyard.scenarios.faults import faulty_detector
from marsyard.scenarios.landing.faults import deliver_pictures, faulty_ranges, faulty_sun_deg
from marsyard.scenarios.landing.flight import Flight, calibrated_camera
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.optics import Optics
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.measurements import DetectorImage, LandingMeasurements
from marsyard.sim.render import Frame, Sun
from marsyard.sim.sensor import Detector, auto_expose
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import site
from marsyard.sim.terrain.sites import SiteTexture

#: Grounds that a worker keeps: their rocks take a second or two to place.
KEPT_GROUNDS = 64


@dataclass(frozen=True)
class World:
    """Terrain with rocks, custom meshes and sun of a landing."""

    ground: SiteGround
    sun: Sun
    meshes: tuple[MeshParameters, ...]
    brightness: float  #: sunlight at the ground relative to that of the detector's stated responsivity

    @classmethod
    def of(cls, p: LandingScenarioParameters, load_ground: LoadGround = SiteGround.from_bank) -> World:
        """The world of a case."""
        ground = load_ground(site(p.site), p.terrain, p.location.bank_seed, p.location.terrain)
        texture = p.preset.ground_texture
        textured = SiteTexture(
            coarsest_m=texture.coarsest_m, amplitudes=tuple(p.texture * one for one in texture.amplitudes)
        )
        ground = replace(ground, site=p.preset.model_copy(update={"ground_texture": textured}))
        air = p.preset.environment
        elevation = float(np.radians(faulty_sun_deg(p.faults, p.sun.elevation_deg)))
        sun = Sun(direction(np.radians(p.sun.azimuth_deg), elevation), air.sun_radius_rad)
        return cls(ground, sun, p.meshes, sunlight_ratio(air, elevation, p.detector))


@dataclass(frozen=True)
class Pair:
    """Two pictures of a flight."""

    images: tuple[DetectorImage, DetectorImage]  #: as delivered, with the true camera
    frames: tuple[Frame, Frame]  #: rendered radiance and truth

    @property
    def counts(self) -> tuple[UInt16[np.ndarray, "rows columns"], UInt16[np.ndarray, "rows columns"]]:
        """The pictures' counts."""
        return self.images[0].counts, self.images[1].counts

    @property
    def axis_range_m(self) -> float:
        """True range along the first picture's optical axis to ground or rock, metres."""
        frame = self.frames[0]
        column, row = self.images[0].camera.project(np.array([self.images[0].camera.a]))[0][0]
        # the four pixels about the axis, at most 0.7 px away
        near = frame.range_m[int(row) : int(row) + 2, int(column) : int(column) + 2]
        return float(np.median(near))


def take_pictures(p: LandingScenarioParameters, world: World, flight: Flight, optics: Optics, streams: Streams) -> Pair:
    """The pictures of a flight; both have the exposure that suits the first."""
    detector = Detector.drawn(
        optics.fall_off, faulty_detector(p.faults, p.detector), streams.generator("detector response")
    )
    caster = max(p.lander.caster_diameter_m, p.faults.vehicle_shadow_m)
    lower = min(flight.states, key=lambda state: float(state.position_m[2]))
    # one scene for both pictures, as detailed as the lower one needs
    eye = Eye.of(optics.rays, lower.world_from_body, world.ground.surface)
    scene = add_meshes(site_scene(world.ground, eye, world.sun), world.meshes, (eye.east_m, eye.north_m))
    scene = replace(scene, caster_diameter_m=caster)
    noise = streams.generator("detector noise")
    rendered = [render_state(p.render.backend, scene, optics, state) for state in flight.states]
    frames, motions = zip(*rendered, strict=True)
    light = [frame.radiance * np.float32(world.brightness) for frame in frames]
    detector = auto_expose(detector, light[0], p.exposure, streams.generator("test pictures")).detector
    counts = [detector.expose(one, noise, motion) for one, motion in zip(light, motions, strict=True)]
    camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
    first, second = (
        DetectorImage(one, state.time_s, camera, detector.calibration)
        for one, state in zip(deliver_pictures(p.faults, counts), flight.states, strict=True)
    )
    return Pair((first, second), (frames[0], frames[1]))


def visible_in_both(pair: Pair, flight: Flight, points_m: Float64[np.ndarray, "n 3"], border_px: float) -> np.ndarray:
    """Whether points of the ground (world axes) lie in both pictures, at least `border_px` from their borders."""
    visible = np.ones(len(points_m), dtype=bool)
    for image, state in zip(pair.images, flight.states, strict=True):
        pixels, ahead = image.camera.moved(state.world_from_body).project(points_m)
        with np.errstate(invalid="ignore"):
            low, high = pixels >= border_px, pixels <= np.array(image.camera.size) - 1.0 - border_px
        visible &= ahead & np.all(low & high, axis=1)
    return visible


def measure(p: LandingScenarioParameters, flight: Flight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """The measurements of a case.

    The a-priori site is the ground on the first picture's optical axis, at the measured range; without one, at the
    commanded height.
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
