"""Everything that a campaign of landings may set or disperse."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.hda import HdaOptions, TrackSeed
from marsyard.scenarios.chosen import ChosenAlgorithms
from marsyard.scenarios.descent.parameters import Place, RenderParameters, SunParameters
from marsyard.scenarios.estimators import LANDING
from marsyard.scenarios.landing.faults import Faults
from marsyard.scenarios.landing.helicopter import HelicopterParameters
from marsyard.scenarios.landing.pair_choice import PairParameters
from marsyard.scenarios.landing.relief import Limits
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.optics import CalibrationParameters
from marsyard.scenarios.parts.scores import OwnScores, ScoredLanding
from marsyard.scenarios.terrain_files import check_terrain
from marsyard.sim.camera import CameraModel
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor import (
    PRESETS,
    AutoExposureParameters,
    DetectorChoice,
    LaserParameters,
    NamedOrOwnCamera,
    OwnCamera,
    preset,
)
from marsyard.sim.terrain import Site, TerrainParameters, site, sites

Angle = Annotated[float, Field(ge=-720.0, le=720.0)]


class PassParameters(Parameters):
    """Where the camera is at the two pictures: at one height over a straight line, as far as nothing else is asked for.

    The change between the pictures that tracking must bear is stated by its parts: along the course, up, and turned
    about the first picture's optical axis, its columns and its rows.
    """

    height_m: float = Field(default=15.0, gt=0.0, le=2000.0, description="above the ground below the first picture, m")
    baseline_share: float = Field(
        default=0.2, ge=0.0, le=2.0, description="horizontal distance of the pictures over height"
    )
    speed_m_s: Annotated[float, Field(ge=0.0, le=200.0, description="along the course, m/s")] = 3.0
    heading_deg: Annotated[Angle, Field(description="azimuth of the picture's upper edge")] = 0.0
    course_deg: Annotated[Angle, Field(description="from there to the course, clockwise: 90 is along the rows")] = 90.0
    tilt_deg: Annotated[float, Field(ge=0.0, le=60.0, description="of the first picture's axis from nadir")] = 0.0
    tilt_towards_deg: Annotated[Angle, Field(description="azimuth towards which it is tilted")] = 0.0
    climb_share: float = Field(
        default=0.0, gt=-0.9, le=5.0, description="change of height between the pictures over height"
    )
    roll_deg: Annotated[Angle, Field(description="turn about the optical axis between the pictures")] = 0.0
    pitch_deg: Annotated[Angle, Field(description="turn about the picture's columns' direction, its right")] = 0.0
    yaw_deg: Annotated[Angle, Field(description="turn about the picture's rows' direction, its upper edge's")] = 0.0
    rate_deg_s: Annotated[NonNegative, Field(le=100.0, description="RMS attitude rate per axis at a picture")] = 0.0


class NavigationParameters(Parameters):
    """Errors of the on-board poses and of the inclinometers, drawn for a case; one standard deviation per axis."""

    position_m: NonNegative = Field(default=0.02, le=100.0, description="of the position, the same at both pictures, m")
    motion_m: Annotated[NonNegative, Field(le=10.0, description="of the motion between the pictures, m")] = 0.01
    tilt_deg: NonNegative = Field(
        default=0.3, le=30.0, description="of the attitude's roll and pitch, common to both, deg"
    )
    azimuth_deg: NonNegative = Field(default=1.0, le=30.0, description="of the attitude's azimuth, common to both, deg")
    turn_deg: Annotated[NonNegative, Field(le=10.0, description="of the turn between the pictures, deg")] = 0.1
    inclinometer_deg: NonNegative = Field(default=0.2, le=30.0, description="of the inclinometers' roll and pitch, deg")


class LanderParameters(Parameters):
    """The lander: what it can stand on, and the shadow that it casts."""

    diameter_m: float = Field(
        default=2.0, gt=0.0, le=100.0, description="of its footprint, a disc; the helicopter: 2 m (paper, IV)"
    )
    max_slope_deg: Annotated[float, Field(gt=0.0, lt=90.0, description="steepest plane that it can stand on")] = 15.0
    max_roughness_m: float = Field(
        default=0.2, gt=0.0, le=100.0, description="farthest that ground may be off that plane, m"
    )
    caster_diameter_m: NonNegative = Field(
        default=0.0, le=100.0, description="diameter of the disc that casts its shadow; 0: none"
    )

    @property
    def limits(self) -> Limits:
        """What it can stand on."""
        return Limits(self.diameter_m, float(np.radians(self.max_slope_deg)), self.max_roughness_m)


class LandingScenarioParameters(ChosenAlgorithms, OwnScores):
    """Everything that a campaign of landings may set or disperse.

    The keys that the table `terrain` sets are changes of the site's own terrain at the stated scale.
    """

    task = LANDING
    scored = ScoredLanding

    site: Annotated[str, Field(description="preset of terrain, light, texture and rocks")] = "heli-hazardous"
    scale: Annotated[Literal["ground", "descent"], Field(description="which of the site's terrains")] = "ground"
    terrain_of: str | None = Field(
        default=None, description="whose terrain is below; filled in, and not to be set otherwise"
    )
    terrain: TerrainParameters = TerrainParameters()
    place: Place = Place()
    meshes: Annotated[tuple[MeshParameters, ...], Field(description="own bodies on the ground")] = ()
    texture: NonNegative = Field(default=1.0, le=10.0, description="contrast of the fine texture, over the site's own")
    sun: SunParameters = SunParameters()
    camera: NamedOrOwnCamera = Field(
        default="xc-55", description="nadir camera preset; or a custom camera: a table with file"
    )
    calibration: CalibrationParameters = Field(
        default=CalibrationParameters(), description="errors of the calibrated camera"
    )
    detector: DetectorChoice = Field(default_factory=lambda: preset("xc-55").detector)
    exposure: Annotated[AutoExposureParameters, Field(description="how the exposure is set")] = AutoExposureParameters()
    flown: PassParameters = Field(
        default=PassParameters(), description="poses at the two pictures; a helicopter's flight uses the azimuths only"
    )
    navigation: NavigationParameters = Field(
        default=NavigationParameters(), description="pose errors without a helicopter"
    )
    helicopter: HelicopterParameters | None = Field(
        default=None, description="flown for the pictures and to the site; none: a pair as stated"
    )
    pair: PairParameters = Field(default=PairParameters(), description="which two of a helicopter's pictures are used")
    laser: LaserParameters = LaserParameters()
    lander: LanderParameters = LanderParameters()
    faults: Faults = Faults()
    algorithm: str = Field(
        default="hda", description="estimator under test: hda, essential-matrix, semi-global, or your own"
    )
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions(
        track_seed=TrackSeed.POSE
    )
    render: RenderParameters = Field(default_factory=RenderParameters)

    @field_validator("site")
    @classmethod
    def _site_is_there(cls, name: str) -> str:
        if name not in sites():
            raise ValueError(f"no site is called '{name}'; allowed: {', '.join(sites())}")
        return name

    @field_validator("camera")
    @classmethod
    def _camera_looks_down(cls, name: str | OwnCamera) -> str | OwnCamera:
        if isinstance(name, OwnCamera):
            return name
        down = [known for known in PRESETS if preset(known).design.down]
        if name not in down:
            raise ValueError(f"no camera preset that looks down is called '{name}'; allowed: {', '.join(down)}")
        return name

    @field_validator("terrain")
    @classmethod
    def _terrain_files_can_be_used(cls, terrain: TerrainParameters) -> TerrainParameters:
        check_terrain(terrain)
        return terrain

    @model_validator(mode="before")
    @classmethod
    def _terrain_of_the_site(cls, stated: Any) -> Any:
        """Completes the table `terrain` with the site's own."""
        if not isinstance(stated, Mapping):
            return stated
        name, scale = stated.get("site", "heli-hazardous"), stated.get("scale", "ground")
        if (
            not isinstance(name, str)
            or name not in sites()
            or getattr(sites()[name], str(scale), None) is None
            or "terrain_of" in stated
        ):
            return stated
        changes = stated.get("terrain", {})
        if not isinstance(changes, Mapping):
            return stated
        return {**stated, "terrain_of": name, "terrain": site(name).terrain(scale).changed(changes).model_dump()}

    @model_validator(mode="after")
    def _terrain_is_the_sites(self) -> LandingScenarioParameters:
        """A terrain that was completed for one site must not be lit as another's."""
        if getattr(self.preset, self.scale) is None:
            raise ValueError(f"site {self.site} has no terrain at the scale '{self.scale}'")
        rows = self.optics.size[1]
        if rows % self.detector.rows_summed:
            raise ValueError(
                f"detector.rows_summed {self.detector.rows_summed} does not divide the camera's {rows} rows"
            )
        if self.terrain_of != self.site:
            raise ValueError(f"site is {self.site}, but the terrain is of {self.terrain_of}; a site is not dispersed")
        return self

    @property
    def optics(self) -> CameraModel:
        """The camera in the body frame."""
        return self.camera.camera() if isinstance(self.camera, OwnCamera) else preset(self.camera).cameras()[0]

    @model_validator(mode="after")
    def _faults_of_a_flight_are_flown(self) -> LandingScenarioParameters:
        for name in ("lost_pictures", "gps_outage_s"):
            if getattr(self.faults, name) and self.helicopter is None:
                raise ValueError(f"faults.{name} is that of a helicopter's flight; state the table helicopter")
        return self

    @property
    def height_m(self) -> float:
        """The height above the ground at which pictures are commanded to be taken."""
        return self.flown.height_m if self.helicopter is None else self.helicopter.transit.height_m

    @property
    def preset(self) -> Site:
        """The site."""
        return site(self.site)
