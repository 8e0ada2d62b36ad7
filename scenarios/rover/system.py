"""Visual target tracking as a system: a rover drives to a target."""

from pathlib import Path

from marsyard.scenarios.systems import System
from marsyard.scenarios.template import CampaignTemplate

_FOLDER = Path(__file__).resolve().parent
_NO_CAMERA_FILE = (
    "--camera and --detector: tracking uses the stereo cameras of a mast; see camera.preset and camera.custom"
)

SYSTEM = System(
    name="vtt",
    title="Visual target tracking (VTT)",
    summary="Position of a target that a rover approaches, tracked in the images of its mast cameras.",
    scenarios={
        "rover": "marsyard.scenarios.rover.scenario:RoverScenario",
        "rover-drive": "marsyard.scenarios.rover.shared_drive:SharedDriveScenario",
    },
    tasks=("marsyard.scenarios.rover.task:TRACKING",),
    folder=_FOLDER,
    columns={
        "rover": "marsyard.scenarios.rover.columns:COLUMNS",
        "rover-drive": "marsyard.scenarios.rover.columns:DRIVE_COLUMNS",
    },
    compilation_campaigns={"vtt-checkout-2": ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5")},
    templates={
        "tracking": CampaignTemplate(
            file=_FOLDER / "new.toml.j2",
            scale="ground",
            site="mars-yard",
            bound=0.03,
            bound_text="maximum error of the target's position at the goal, m",
            unsupported_options={
                "camera": _NO_CAMERA_FILE,
                "detector": _NO_CAMERA_FILE,
                "flight": "--flight: only descents accept a recorded trajectory, and tracking is not a descent",
            },
        )
    },
    report="marsyard.reports.vtt.presentation:VTT",
    # sources of values, in the notation of `System.conditions`
    conditions={
        "site": ("site",),
        "camera": ("camera",),
        "sun_elevation_deg": ("sun_elevation_deg",),
        "slope_deg": ("site.ground.rms_slope_deg",),
        "optical_depth": ("world.dust_opacity|site.environment.optical_depth",),
        "range_m": ("range_start_m", "range_end_m"),
    },
)
