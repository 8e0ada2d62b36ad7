"""The pictures of a triple, rendered from the flight at their places and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.fieldtest.run import Run, RunKey, field_camera, worked_out
from marsyard.scenarios.optics import Optics
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.dynamics import State
from marsyard.sim.render import Scene, Sun, process_renderer
from marsyard.sim.sensor import Detector, ImageMotion
from marsyard.sim.terrain import TerrainBank, site

#: Distance of the pixels whose ground points are kept.
GRID_PX = 32


@cache
def field_optics() -> Optics:
    """The field test's camera; shared by all cases of a process."""
    return Optics.of(field_camera())


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


def take_picture(run: Run, state: State, detector: Detector, rng: np.random.Generator) -> Picture:
    """The picture taken in a state of the flight."""
    optics = field_optics()
    p = run.key.field_test
    scene = _scene(run.key, state.time_s)
    frame = process_renderer(p.backend).render(scene, optics.rays, state.world_from_body, state.time_s)
    motion = ImageMotion.seen(
        optics.camera,
        frame.range_m,
        frame.world_from_body,
        state.velocity_m_s,
        state.attitude.apply(state.body_rate_rad_s),
    )
    air = site(run.parameters.site).environment
    brightness = air.direct_share(float(np.arcsin(scene.sun.direction[2]))) * air.solar_irradiance / p.detector.sunlight
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


# as many as the paper's field sites, for cases take turns among their runs
@lru_cache(maxsize=3)
def site_ground(site_name: str, samples: int, bank_seed: int) -> SiteGround:
    """The ground of a site."""
    preset = site(site_name)
    terrain = preset.terrain("descent").model_copy(update={"samples": samples})
    bank = TerrainBank(terrain, bank_seed)
    return SiteGround(preset, terrain, bank.terrain(0), bank.rocks(0))


def _scene(key: RunKey, time_s: float) -> Scene:
    """The site around the middle of the line under the sun of a time.

    The sun may not be held from one picture to the next: shadows of clouds 2.5 km up move by a third of a metre a
    second with it, and would leap by as much as it was held for.
    """
    sun = sun_at(worked_out(key), time_s)
    return replace(_first_light(key), sun=sun, photometry=_ground(key).photometry(sun))


def _ground(key: RunKey) -> SiteGround:
    """The ground that a run flies over."""
    p = key.field_test
    return site_ground(p.runs[key.number].site, p.samples, p.bank_seed)


@lru_cache(maxsize=5)
def _first_light(key: RunKey) -> Scene:
    """A run's scene as it begins: what stands on the ground stays as the sun moves. Kept for each run of the paper."""
    run, p = worked_out(key), key.field_test
    east, north, _ = run.flight.origin_m.tolist()
    eye = Eye(east, north, p.helicopter.lowest_m, field_optics().rays.pixel_rad)
    return replace(site_scene(_ground(key), eye, sun_at(run, 0.0)), clouds=run.clouds)
