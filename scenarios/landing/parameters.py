"""Parameters and faults of the landing scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.hda import HdaOptions
from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.scenarios.case_faults import SizedFaults
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters
from marsyard.scenarios.landing.relief import Limits
from marsyard.scenarios.landing_site import LANDING
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
from marsyard.scenarios.tasks import AlgorithmSelection
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.sim.camera import CameraModel
from marsyard.sim.error_sources import DETECTOR, ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters, bounded_field
from marsyard.sim.sensor import (
    PRESETS,
    AutoExposureParameters,
    CustomCamera,
    DetectorChoice,
    LaserParameters,
    NamedOrCustomCamera,
    preset,
)
from marsyard.sim.sensor.satellite_navigation import Outage
from marsyard.sim.terrain import PhotometryChanges, Site, TerrainParameters, site, sites

#: Sources of error of poses that are drawn without a flight.
RATE = ErrorSource("motion", "motion: attitude rate")
POSE_POSITION = ErrorSource("position", "position and motion")
POSE_ATTITUDE = ErrorSource("attitude", "attitude and inclinometers")


class LandingFaults(SizedFaults):
    """Faults of a landing case; lost images and receiver outages need a helicopter flight."""

    black_image: Annotated[int, bounded_field(0, 2, "number of the black image, 1 or 2; 0: none")] = 0
    repeated_image: Annotated[int, bounded_field(0, 1, "1: the second image is a copy of the first")] = 0
    lost_rows: Annotated[
        float, bounded_field(0.0, 1.0, "fraction of the rows of image 2 that is lost, from the bottom")
    ] = 0.0
    lost_images: Annotated[float, bounded_field(0.0, 1.0, "fraction of images lost; two always arrive")] = 0.0
    laser_silent: Annotated[
        int, bounded_field(0, 1, "1: the altimeter returns no range, at the images and in the landing")
    ] = 0
    laser_stuck: Annotated[float, bounded_field(0.0, 5.0, "relative excess of the stuck range; 0: no fault")] = 0.0
    gps_outage_s: Annotated[
        float, bounded_field(0.0, 300.0, "duration of the GPS outage before image 1; it lasts to the end")
    ] = 0.0
    listed_bad_pixels: Annotated[
        float,
        DETECTOR,
        bounded_field(0.0, 0.5, "fraction of bad pixels in the camera's list, which it fills by interpolation"),
    ] = 0.0
    vehicle_shadow_m: Annotated[
        float, bounded_field(0.0, 100.0, "diameter of the disc that casts the vehicle's shadow; also raises the sun")
    ] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Return the detector parameters that the faults change; listed bad pixels are filled by the camera."""
        fraction = max(self.bad_pixels, self.listed_bad_pixels)
        is_listed = fraction == self.listed_bad_pixels
        defects = {"dead_fraction": fraction, "hot_fraction": fraction, "listed": is_listed} if fraction else {}
        return {**super().detector_changes(), "defects": defects}


def raise_sun_deg(faults: LandingFaults, elevation_deg: float) -> float:
    """Return the sun's elevation; the vehicle shadow fault reduces its zenith distance to a quarter.

    A nadir camera sees the vehicle's shadow only if the sun's zenith distance is below half its field of view.
    """
    return 90.0 - 0.25 * (90.0 - elevation_deg) if faults.vehicle_shadow_m else elevation_deg


def add_receiver_outage(faults: LandingFaults, helicopter: LandingHelicopterParameters) -> LandingHelicopterParameters:
    """Add the outage of the GPS receiver, from before the first image until after the landing.

    The outage extends the initial hover, so that the filter is initialized with the receiver as in other flights.
    """
    if not faults.gps_outage_s:
        return helicopter
    transit, rtk = helicopter.transit, helicopter.rtk
    outage = Outage(start_s=-faults.gps_outage_s, duration_s=faults.gps_outage_s + helicopter.receiver_span_s[1])
    return helicopter.model_copy(
        update={
            "transit": transit.model_copy(update={"hover_s": transit.hover_s + faults.gps_outage_s}),
            "rtk": rtk.model_copy(update={"outages": (*rtk.outages, outage)}),
        }
    )


def draw_received_images(faults: LandingFaults, count: int, rng: np.random.Generator) -> Int64[np.ndarray, "n"]:
    """Draw the images of a flight that arrive, at least two; return their sorted indices."""
    received_count = max(2, count - round(faults.lost_images * count))
    return np.sort(rng.permutation(count)[:received_count]).astype(np.int64)


def add_range_faults(
    faults: LandingFaults, ranges_m: Float64[np.ndarray, "n"], height_m: float
) -> Float64[np.ndarray, "n"]:
    """Replace the altimeter's ranges by the stuck range, or by NaN, if the altimeter has a fault."""
    stuck_m = stuck_range_m(faults, height_m)
    if stuck_m is None:
        return ranges_m
    return np.full_like(ranges_m, np.nan if np.isinf(stuck_m) else stuck_m)


def stuck_range_m(faults: LandingFaults, height_m: float) -> float | None:
    """Return the stuck range of the altimeter: infinite if it returns no range, None if it has no fault."""
    if faults.laser_silent:
        return float("inf")
    return height_m * (1.0 + faults.laser_stuck) if faults.laser_stuck else None


Angle = Annotated[float, Field(ge=-720.0, le=720.0)]


class ImagePoseParameters(Parameters):
    """Camera poses at the two images; by default level flight on a straight line.

    The motion between the images has components along the course, upwards, and rotations about the first image's
    optical axis, right direction and up direction.
    """

    height_m: float = Field(default=15.0, gt=0.0, le=2000.0, description="above the ground below the first image, m")
    baseline_fraction: float = Field(default=0.2, ge=0.0, le=2.0, description="horizontal distance divided by height")
    speed_m_s: Annotated[float, Field(ge=0.0, le=200.0, description="along the course, m/s")] = 3.0
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
        if getattr(self.preset, self.scale) is None:
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
    def preset(self) -> Site:
        """The site with the dust of the case."""
        return site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)
