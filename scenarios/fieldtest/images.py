"""Imaging of a field test run: ground and scene with the moving sun, and exposure of an image."""

from dataclasses import replace

import numpy as np
from jaxtyping import UInt16

from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.fieldtest.flight import FlownRun, RunKey, field_camera
from marsyard.scenarios.radiance import add_haze, sunlight_ratio
from marsyard.scenarios.views import SiteGround, Viewpoint, load_ground, render_state, site_scene
from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Scene, Sun
from marsyard.sim.sensor import Detector
from marsyard.sim.terrain import site


def take_image(
    run: FlownRun, start_scene: Scene, ground: SiteGround, state: State, detector: Detector, rng: np.random.Generator
) -> tuple[UInt16[np.ndarray, "rows columns"], Frame]:
    """Render and expose an image; return its counts and the rendered frame."""
    p, scene = run.key.field_test, scene_at(run, start_scene, ground, state.time_s)
    frame, motion = render_state(p.backend, scene, camera_optics(field_camera()), state)
    brightness = sunlight_ratio(ground.site.environment, float(np.arcsin(scene.sun.direction[2])), p.detector)
    air = ground.site.environment
    height = float(state.position_m[2]) - float(ground.surface.height(*state.position_m[:2]))
    radiance = add_haze(frame, air, scene.sun, air.mean_extinction_m(height))
    return detector.expose(radiance * np.float32(brightness), rng, motion), frame


def sun_at(run: FlownRun, time_s: float) -> Sun:
    """Return the sun at a run's site at a time of the flight."""
    return Sun(run.sun(time_s), site(run.parameters.site).environment.sun_radius_rad)


def scene_at(run: FlownRun, start_scene: Scene, ground: SiteGround, time_s: float) -> Scene:
    """Return the run's scene with the sun at a given time.

    The sun is updated for every image: its motion moves the shadows of clouds at 2.5 km height by 0.3 m/s.
    """
    sun = sun_at(run, time_s)
    return start_scene.with_light(sun, ground.photometry(sun))


def run_ground(key: RunKey) -> SiteGround:
    """Load the ground of a run."""
    p = key.field_test
    name = p.runs[key.number].site
    return load_ground(site(name), p.terrain(name), p.bank_seed, 0)


def build_start_scene(run: FlownRun, ground: SiteGround, height_m: float | None = None) -> Scene:
    """Build a run's scene with the sun at its start; later images use the same objects with a new sun.

    The scene contains the rocks that are resolved from a height above the ground, by default the lowest of the passes.
    """
    east, north, _ = run.flight.origin_m.tolist()
    lowest_m = run.key.field_test.helicopter.lowest_m
    pixel_rad = camera_optics(field_camera()).rays.pixel_rad
    viewpoint = Viewpoint(east, north, lowest_m if height_m is None else height_m, pixel_rad)
    return replace(site_scene(ground, viewpoint, sun_at(run, 0.0)), clouds=run.clouds)
