"""The pictures of a triple, rendered from the flight at their places and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.exposure import render_state, sunlight_ratio
from marsyard.scenarios.fieldtest.run import Run, RunKey, field_camera
from marsyard.scenarios.optics import camera_optics
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.dynamics import State
from marsyard.sim.render import Scene, Sun
from marsyard.sim.sensor import Detector
from marsyard.sim.terrain import site

#: Distance of the pixels whose ground points are kept.
GRID_PX = 32


@dataclass(frozen=True)
class Picture:
    """A picture taken.

    Attributes
    ----------
    counts
        As the detector delivers them.
    ground_m
        Points of the ground that it shows, on a coarse grid of its pixels, world axes.
    """

    counts: UInt16[np.ndarray, "rows columns"]
    ground_m: Float64[np.ndarray, "m n 3"]


def take_picture(
    run: Run, first_light: Scene, ground: SiteGround, state: State, detector: Detector, rng: np.random.Generator
) -> Picture:
    """The picture taken in a state of the flight; see `scene_at`."""
    p, scene = run.key.field_test, scene_at(run, first_light, ground, state.time_s)
    frame, motion = render_state(p.backend, scene, camera_optics(field_camera()), state)
    brightness = sunlight_ratio(ground.site.environment, float(np.arcsin(scene.sun.direction[2])), p.detector)
    counts = detector.expose(frame.radiance * np.float32(brightness), rng, motion)
    return Picture(counts, frame.points_world(GRID_PX))


def cloud_transmittances(
    run: Run, ground_m: Float64[np.ndarray, "m n 3"], times_s: Sequence[float]
) -> Float64[np.ndarray, "times m n"]:
    """Share of the direct sun that clouds let through to points of the ground, at each of these times."""
    if run.clouds is None:
        return np.ones((len(times_s), *ground_m.shape[:2]))
    layer = run.clouds
    return np.stack([layer.transmittance(ground_m, sun_at(run, time), time) for time in times_s])


def sun_at(run: Run, time_s: float) -> Sun:
    """The sun over a run's site at a time of the run."""
    return Sun(run.sun(time_s), site(run.parameters.site).environment.sun_radius_rad)


def scene_at(run: Run, first_light: Scene, ground: SiteGround, time_s: float) -> Scene:
    """The run's scene as it begins, under the sun of a time.

    The sun may not be held from one picture to the next: shadows of clouds 2.5 km up move by a third of a metre a
    second with it, and would leap by as much as it was held for.
    """
    sun = sun_at(run, time_s)
    return replace(first_light, sun=sun, photometry=ground.photometry(sun))


def ground_of(key: RunKey, load_ground: LoadGround = SiteGround.from_bank) -> SiteGround:
    """The ground that a run flies over."""
    p = key.field_test
    name = p.runs[key.number].site
    return load_ground(site(name), p.terrain(name), p.bank_seed, 0)


def first_light(run: Run, ground: SiteGround) -> Scene:
    """A run's scene as it begins: what stands on the ground stays as the sun moves."""
    east, north, _ = run.flight.origin_m.tolist()
    pixel_rad = camera_optics(field_camera()).rays.pixel_rad
    eye = Eye(east, north, run.key.field_test.helicopter.lowest_m, pixel_rad)
    return replace(site_scene(ground, eye, sun_at(run, 0.0)), clouds=run.clouds)
