"""Hazard detection and avoidance as a system: a helicopter selects its landing site."""

from pathlib import Path

from marsyard.scenarios.systems import System
from marsyard.scenarios.template import CampaignTemplate

_FOLDER = Path(__file__).resolve().parent

SYSTEM = System(
    name="hda",
    title="Hazard detection and avoidance (HDA)",
    summary="A safe landing site from two images of a moving camera.",
    scenarios={"landing": "marsyard.scenarios.landing.scenario:LandingScenario"},
    tasks=("marsyard.scenarios.landing_task:LANDING",),
    folder=_FOLDER,
    columns={"landing": "marsyard.scenarios.landing.columns:COLUMNS"},
    compilation_campaigns={"hda-benign": ("terrain.samples=512",)},
    templates={
        "landing": CampaignTemplate(
            file=_FOLDER / "new.toml.j2",
            scale="ground",
            site="heli-hazardous",
            bound=0.99,
            bound_text="minimum fraction of safe sites among the selected sites",
            max_bound=1.0,
            unsupported_options={
                "flight": "--flight: only descents accept a recorded trajectory, and landing is not a descent"
            },
        )
    },
    report="marsyard.reports.hda.presentation:HDA",
    # sources of values, in the notation of `System.conditions`
    conditions={
        "site": ("terrain.source.dtm|site",),
        "camera": ("camera.file|camera|=xc-55",),
        "sun_elevation_deg": ("sun_elevation_deg",),
        "slope_deg": ("terrain.rms_slope_deg|site.ground.rms_slope_deg",),
        "optical_depth": ("dust_opacity|site.environment.optical_depth",),
        "range_m": ("range_m",),
    },
)
