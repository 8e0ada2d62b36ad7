"""Localisation on a map as a system: position of a lander."""

from pathlib import Path

from marsyard.scenarios.systems import System

_FOLDER = Path(__file__).resolve().parent

SYSTEM = System(
    name="localisation",
    title="Localisation on a map",
    summary="Position of a lander on a map, from descent images and inertial data.",
    scenarios={"localisation": "marsyard.scenarios.localisation.scenario:LocalisationScenario"},
    tasks=("marsyard.scenarios.localisation.task:LOCALISATION",),
    folder=_FOLDER,
    columns={"localisation": "marsyard.scenarios.localisation.columns:COLUMNS"},
    compilation_campaigns={
        # small terrain, map and image: the cases only compile the kernels
        "loc-smoke": (
            "terrain.samples=1024",
            "map.side_px=512",
            "camera.pixels=256",
            "camera.pixel_mrad=6.68",
            # small enough for a coarse fix, after which the fine stage runs
            "initial.horizontal_sd_m=100",
        )
    },
    report="marsyard.reports.localisation.presentation:LOCALISATION",
    # sources of each quantity, in the notation of `System.conditions`; 4200 m is the default of `altitude_start_m`
    conditions={
        "site": ("terrain.source.dtm|site",),
        "camera": ("=lander vision camera",),
        "sun_elevation_deg": ("sun_elevation_deg",),
        "slope_deg": ("terrain.rms_slope_deg|site.descent.rms_slope_deg",),
        "optical_depth": ("dust_opacity|site.environment.optical_depth",),
        "range_m": ("flight.altitude_start_m|=4200", "altitude_last_m"),
    },
    find_site="marsyard.scenarios.localisation.sites:localisation_site",
)
