"""Run times of a descent image, a new terrain and a complete case of the descent scenario."""

from functools import partial

import numpy as np

from benchmarks.images import descent_pose, descent_scene
from benchmarks.stages import DESCENT_STAGES, measure_stages
from benchmarks.timing import Measurement, case_runner, core_seconds
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import DescentCameraParameters
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.terrain import TerrainParameters, synthesise
from marsyard.sim.terrain.sites import sites


def measure_frame(repeats: int) -> list[Measurement]:
    """Measure a frame of the descent scene with prepared terrain, mesh and shadows."""
    scene, surface = descent_scene()
    optics = camera_optics(DescentCameraParameters())
    renderer = process_renderer(default_backend())
    pose = descent_pose(surface)
    return [
        Measurement(
            "descent frame, 1024 x 1024 px",
            core_seconds(lambda: renderer.render(scene, optics.rays, pose), repeats),
            limit=0.1,
        )
    ]


def measure_case(repeats: int) -> list[Measurement]:
    """Measure complete `dimes-gusev` cases over one prepared terrain, their stages, and cases over new terrains."""
    prepared, campaign = (load_campaign("dimes-gusev", overrides) for overrides in (["location.bank=1"], []))
    prepared.scenario.prepare(prepared.base_parameters(), 0)
    run = case_runner()
    run_next = partial(run, prepared)
    return [
        Measurement(
            "dimes-gusev case: 3 frames, detector, instruments, DIMES", core_seconds(run_next, repeats), limit=0.6
        ),
        *measure_stages("dimes-gusev case", run_next, repeats, DESCENT_STAGES),
        Measurement("dimes-gusev case over a new terrain", core_seconds(partial(run, campaign), repeats), limit=0.9),
    ]


def measure_new_terrains(repeats: int) -> list[Measurement]:
    """Measure the synthesis of a descent terrain of 4096 x 4096 samples, with default parameters and for every site."""
    parameters = {"default parameters": TerrainParameters()} | {
        name: site.descent for name, site in sites().items() if site.descent is not None
    }
    return [
        Measurement(
            f"generation of a descent terrain: {name}",
            core_seconds(partial(synthesise, site_parameters, np.random.default_rng(0)), repeats),
            limit=2.0,
        )
        for name, site_parameters in parameters.items()
    ]
