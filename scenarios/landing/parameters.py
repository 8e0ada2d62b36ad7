"""Parameters of the landing scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.hda import HdaOptions
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.scenarios.landing.faults import LandingFaults
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters
from marsyard.scenarios.landing.relief import Limits
from marsyard.scenarios.landing_task import LANDING
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.parts.scores import CustomScores, ScoredLanding
from marsyard.scenarios.site_parameters import (
    DustOpacity,
    Location,
    RenderParameters,
    SunParameters,
    complete_terrain,
    preset_terrain,
)
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.sim.camera import CameraModel
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor import (
    PRESETS,
    AutoExposureParameters,
    CustomCamera,
    DetectorChoice,
    LaserParameters,
    NamedOrCustomCamera,
    preset,
)
from marsyard.sim.terrain import PhotometryChanges, Site, TerrainParameters, site, sites

#: Sources of error of poses that are drawn without a flight.
RATE = ErrorSource("motion", "motion: attitude rate")
POSE_POSITION = ErrorSource("position", "position and motion")
POSE_ATTITUDE = ErrorSource("attitude", "attitude and inclinometers")
#: Angles in degrees.
Angle = Annotated[float, Field(ge=-720.0, le=720.0)]


class ImagePoseParameters(Parameters):
    """Camera poses at the two images; by default level flight on a straight line.

    The motion between the images has components along the course, upwards, and rotations about the first image's
    optical axis, right direction and up direction.
    """

    height_m: float = Field(default=15.0, gt=0.0, le=2000.0, description="above the ground below the first image, m")
    baseline_fraction: float = Field(default=0.2, ge=0.0, le=2.0, description="horizontal distance divided by height")
    speed_m_s: Annotated[float, Field(ge=0.0, le=200.0, description="along the line between the images, m/s")] = 3.0
    heading_deg: Annotated[Angle, Field(description="azimuth of the image's upper edge")] = 0.0
    course_deg: Annotated[Angle, Field(description="clockwise from the upper edge; 90: along the rows")] = 90.0
    tilt_deg: Annotated[float, Field(ge=0.0, le=60.0, description="angle of the first optical axis from nadir")] = 0.0
    tilt_towards_deg: Annotated[Angle, Field(description="azimuth towards which the first optical axis is tilted")] = (
        0.0
    )
    climb_fraction: float = Field(default=0.0, gt=-0.9, le=5.0, description="change of height divided by height")
    roll_deg: Annotated[Angle, Field(description="rotation about the optical axis between the images")] = 0.0
    pitch_deg: Annotated[Angle, Field(description="rotation about the image's right direction")] = 0.0
    yaw_deg: Annotated[Angle, Field(description="rotation about the image's up direction")] = 0.0
    rate_deg_s: Annotated[NonNegative, RATE, Field(le=100.0, description="RMS attitude rate per axis at an image")] = (
        0.0
    )


class PoseErrorParameters(Parameters):
    """Standard deviations per axis of the on-board poses and of the inclinometers, sampled for a case."""

    position_m: Annotated[NonNegative, POSE_POSITION] = Field(
        default=0.02, le=100.0, description="SD of the position, common to both images"
    )
    motion_m: Annotated[
        NonNegative, POSE_POSITION, Field(le=10.0, description="SD of the motion between images, m")
    ] = 0.01
    tilt_deg: Annotated[NonNegative, POSE_ATTITUDE] = Field(
        default=0.3, le=30.0, description="SD of roll and pitch, common to both images"
    )
    azimuth_deg: Annotated[NonNegative, POSE_ATTITUDE] = Field(
        default=1.0, le=30.0, description="SD of the azimuth, common to both images"
    )
    rotation_deg: Annotated[
        NonNegative, POSE_ATTITUDE, Field(le=10.0, description="SD of the rotation between images")
    ] = 0.1
    inclinometer_deg: Annotated[NonNegative, POSE_ATTITUDE] = Field(
        default=0.2, le=30.0, description="SD of the inclinometers' roll and pitch"
    )


class PairParameters(Parameters):
    """Score of a pair of images: overlap times baseline, with the baseline limited to a fraction of the range.

    The paper mentions baseline and overlap; the weighting is assumed.
    """

    max_baseline_fraction: float = Field(default=0.2, gt=0.0, le=2.0, description="limit of baseline divided by range")
    min_overlap: float = Field(default=0.5, ge=0.0, le=1.0, description="fraction of the first image's ground")


class LanderParameters(Parameters):
    """Limits of the lander, and its shadow."""

    diameter_m: float = Field(default=2.0, gt=0.0, le=100.0, description="diameter of the footprint disc (paper, IV)")
    max_slope_deg: Annotated[float, Field(gt=0.0, lt=90.0, description="slope of the plane under the lander")] = 15.0
    max_roughness_m: float = Field(default=0.2, gt=0.0, le=100.0, description="maximum distance from the plane")
    caster_diameter_m: NonNegative = Field(
        default=0.0, le=100.0, description="diameter of the disc that casts the lander's shadow; 0: none"
    )

    @property
    def limits(self) -> Limits:
        """The limits in SI units."""
        return Limits(self.diameter_m, float(np.radians(self.max_slope_deg)), self.max_roughness_m)


class LandingScenarioParameters(AlgorithmSelection, CustomScores):
    """All parameters of the landing scenario; `terrain` changes the site's terrain at the selected scale."""

    task = LANDING
    scored = ScoredLanding

    site: Annotated[str, Field(description="preset of terrain, light, texture and rocks")] = "heli-hazardous"
    scale: Annotated[Literal["ground", "descent"], Field(description="terrain of the site")] = "ground"
    terrain_site: str | None = Field(default=None, description="site of the terrain; set automatically from `site`")
    terrain: CheckedTerrain = TerrainParameters()
    location: Location = Location()
    meshes: Annotated[tuple[MeshParameters, ...], Field(description="custom meshes on the ground")] = ()
    texture: NonNegative = Field(
        default=1.0, le=10.0, description="contrast of the fine texture of the ground, relative to its nominal value"
    )
    sun: SunParameters = SunParameters()
    dust_opacity: DustOpacity = None
    photometry: PhotometryChanges = PhotometryChanges()
    camera: NamedOrCustomCamera = Field(default="xc-55", description="nadir camera preset, or a table with file")
    calibration: CalibrationParameters = Field(default=CalibrationParameters(), description="camera calibration errors")
    detector: DetectorChoice = Field(default_factory=lambda: preset("xc-55").detector)
    exposure: Annotated[AutoExposureParameters, Field(description="exposure control")] = AutoExposureParameters()
    image_poses: ImagePoseParameters = Field(
        default=ImagePoseParameters(),
        description="camera poses at the images; a helicopter flight uses only the azimuths",
    )
    navigation: PoseErrorParameters = Field(
        default=PoseErrorParameters(), description="navigation errors of cases without a helicopter flight"
    )
    helicopter: LandingHelicopterParameters | None = Field(default=None, description="helicopter flight and landing")
    pair: PairParameters = Field(default=PairParameters(), description="choice of two images of a helicopter flight")
    laser: LaserParameters = LaserParameters()
    lander: LanderParameters = LanderParameters()
    faults: LandingFaults = LandingFaults()
    algorithm: str = Field(default="hda", description="hda, essential-matrix, semi-global, or a custom 'module:Class'")
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions()
    render: RenderParameters = Field(default_factory=RenderParameters)

    @field_validator("site")
    @classmethod
    def _check_site(cls, name: str) -> str:
        if name not in sites():
            raise ValueError(f"no site is called '{name}'; allowed: {', '.join(sites())}")
        return name

    @field_validator("camera")
    @classmethod
    def _check_camera(cls, name: str | CustomCamera) -> str | CustomCamera:
        nadir_presets = [preset_name for preset_name in PRESETS if preset(preset_name).design.down]
        if not isinstance(name, CustomCamera) and name not in nadir_presets:
            raise ValueError(f"'{name}' is not a downward-looking camera preset; allowed: {', '.join(nadir_presets)}")
        return name

    @model_validator(mode="before")
    @classmethod
    def _complete_terrain(cls, parameters: Any) -> Any:
        def find(name: str, tables: Mapping[str, Any]) -> TerrainParameters | None:
            is_complete = "terrain_site" in tables
            return None if is_complete else preset_terrain(name, str(tables.get("scale", "ground")))

        return complete_terrain(parameters, "heli-hazardous", find)

    @model_validator(mode="after")
    def _check_consistency(self) -> LandingScenarioParameters:
        """Check terrain and light (they must come from the same site), row binning, and faults."""
        if getattr(self.site_preset, self.scale) is None:
            raise ValueError(f"site {self.site} has no terrain at the scale '{self.scale}'")
        rows = self.optics.size[1]
        if rows % self.detector.rows_summed:
            raise ValueError(f"detector.rows_summed {self.detector.rows_summed} does not divide the {rows} camera rows")
        if self.terrain_site != self.site:
            raise ValueError(f"site is {self.site}, but terrain is of {self.terrain_site}; `site` cannot be dispersed")
        for name in ("lost_images", "gps_outage_s"):
            if getattr(self.faults, name) and self.helicopter is None:
                raise ValueError(f"faults.{name} needs a helicopter flight; add the table helicopter")
        return self

    @property
    def optics(self) -> CameraModel:
        """The camera in the body frame."""
        return self.camera.camera() if isinstance(self.camera, CustomCamera) else preset(self.camera).cameras()[0]

    @property
    def height_m(self) -> float:
        """Commanded height of the images above the ground."""
        return self.image_poses.height_m if self.helicopter is None else self.helicopter.transit.height_m

    @property
    def site_preset(self) -> Site:
        """The site with the dust and the photometry of the case."""
        return site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)
