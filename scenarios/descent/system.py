"""DIMES as a system: velocity of a lander under its parachute."""

from pathlib import Path

from marsyard.scenarios.systems import System
from marsyard.scenarios.template import CampaignTemplate, Choices

_FOLDER = Path(__file__).resolve().parent


def _camera_values(choices: Choices) -> dict[str, tuple[int, int]]:
    """Return the size to which DIMES bins the images of a user's camera."""
    from marsyard.algorithms.dimes.views import binned_size_for
    from marsyard.sim.camera import read_camera

    return {"binned_size": binned_size_for(*read_camera(choices.camera).size)} if choices.camera else {}


SYSTEM = System(
    name="dimes",
    title="Descent Image Motion Estimation System (DIMES)",
    summary="Horizontal velocity of a lander under its parachute, from three images.",
    scenarios={"descent": "marsyard.scenarios.descent.scenario:DescentScenario"},
    tasks=("marsyard.scenarios.velocity:VELOCITY",),
    folder=_FOLDER,
    columns={"descent": "marsyard.scenarios.descent.columns:COLUMNS"},
    compilation_campaigns={"dimes-smoke": ("terrain.samples=512",)},
    templates={
        "velocity": CampaignTemplate(
            file=_FOLDER / "new.toml.j2",
            scale="descent",
            site="gusev",
            bound=5.0,
            bound_text="maximum error of the horizontal velocity, m/s (DIMES requirement: 5)",
            values=_camera_values,
        )
    },
    report="marsyard.reports.dimes.presentation:DIMES",
    # sources of values, in the notation of `System.conditions`
    conditions={
        "site": ("terrain.source.dtm|site",),
        "camera": ("camera.model.file|=mer-descent-flown",),
        "sun_elevation_deg": ("sun_elevation_deg",),
        "slope_deg": ("terrain.rms_slope_deg|site.descent.rms_slope_deg",),
        "optical_depth": ("dust_opacity|site.environment.optical_depth",),
        "range_m": ("altitude_[0-9]*_m",),
    },
)
