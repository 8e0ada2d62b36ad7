"""Parameters and faults of the landing scenario; a campaign may set or disperse all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.hda import HdaOptions, TrackSeed
from marsyard.scenarios.algorithm_run import AlgorithmSelection
from marsyard.scenarios.conditions import SizedFaults
from marsyard.scenarios.descent.parameters import Location, RenderParameters, SunParameters
from marsyard.scenarios.estimators import LANDING
from marsyard.scenarios.exposure import CalibrationParameters
from marsyard.scenarios.landing.helicopter import HelicopterParameters
from marsyard.scenarios.landing.relief import Limits
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.parts.scores import CustomScores, ScoredLanding
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.sim.camera import CameraModel
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
from marsyard.sim.terrain import Site, TerrainParameters, site, sites


class Faults(SizedFaults):
    """Faults of a flight; lost pictures and receiver outages need a helicopter flight."""

    black_picture: Annotated[int, bounded_field(0, 2, "number of the black picture, 1 or 2; 0: none")] = 0
    repeated_picture: Annotated[int, bounded_field(0, 1, "1: the second picture is the first again")] = 0
    lost_rows: Annotated[float, bounded_field(0.0, 1.0, "part of the second picture's rows lost, from below")] = 0.0
    lost_pictures: Annotated[float, bounded_field(0.0, 1.0, "part of the pictures; two always arrive")] = 0.0
    laser_silent: Annotated[int, bounded_field(0, 1, "1: the altimeter gives no range, to the ground")] = 0
    laser_stuck: Annotated[
        float, bounded_field(0.0, 5.0, "excess of the stuck range over the height, as a fraction")
    ] = 0.0
    gps_outage_s: Annotated[
        float, bounded_field(0.0, 300.0, "silence before the first picture; it lasts to the end")
    ] = 0.0
    listed_bad_pixels: Annotated[float, bounded_field(0.0, 0.5, "`bad_pixels` that the camera lists and fills")] = 0.0
    vehicle_shadow_m: Annotated[float, bounded_field(0.0, 100.0, "diameter of the shadow's disc; raises the sun")] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Bad pixels are filled where the camera has a list of them."""
        fraction = max(self.bad_pixels, self.listed_bad_pixels)
        listed = fraction == self.listed_bad_pixels
        defects = {"dead_fraction": fraction, "hot_fraction": fraction, "listed": listed} if fraction else {}
        return {**super().detector_changes(), "defects": defects}


def faulty_sun_deg(faults: Faults, elevation_deg: float) -> float:
    """The sun's elevation; with an own shadow its zenith distance is a quarter, so that the shadow is in the picture.

    A nadir camera sees the shadow only if the sun's zenith distance is below half of its angle of view.
    """
    return 90.0 - 0.25 * (90.0 - elevation_deg) if faults.vehicle_shadow_m else elevation_deg


def faulty_helicopter(faults: Faults, helicopter: HelicopterParameters) -> HelicopterParameters:
    """The helicopter with its receiver's outage: from before the first picture until after the landing.

    The hover before is longer by the outage, so that the filter starts with the receiver as in other flights.
    """
    if not faults.gps_outage_s:
        return helicopter
    transit, rtk = helicopter.transit, helicopter.rtk
    outage = Outage(start_s=-faults.gps_outage_s, duration_s=faults.gps_outage_s + helicopter.received_s[1])
    return helicopter.model_copy(
        update={
            "transit": transit.model_copy(update={"hover_s": transit.hover_s + faults.gps_outage_s}),
            "rtk": rtk.model_copy(update={"outages": (*rtk.outages, outage)}),
        }
    )


def draw_arrivals(faults: Faults, count: int, rng: np.random.Generator) -> Int64[np.ndarray, "n"]:
    """Sorted numbers of a flight's pictures that arrive, at least two."""
    kept = max(2, count - round(faults.lost_pictures * count))
    return np.sort(rng.permutation(count)[:kept]).astype(np.int64)


def faulty_ranges(faults: Faults, ranges_m: Float64[np.ndarray, "n"], height_m: float) -> Float64[np.ndarray, "n"]:
    """The altimeter's ranges, or the stuck or missing value in their place."""
    stuck = stuck_range_m(faults, height_m)
    if stuck is None:
        return ranges_m
    return np.full_like(ranges_m, np.nan if np.isinf(stuck) else stuck)


def stuck_range_m(faults: Faults, height_m: float) -> float | None:
    """The stuck range of the altimeter, infinite if it is silent; None if it works."""
    if faults.laser_silent:
        return float("inf")
    return height_m * (1.0 + faults.laser_stuck) if faults.laser_stuck else None


Angle = Annotated[float, Field(ge=-720.0, le=720.0)]


class PassParameters(Parameters):
    """Camera poses at the two pictures; by default level flight on a straight line.

    The change between the pictures is given by its components: along the course, up, and rotations about the first
    picture's optical axis, its columns and its rows.
    """

    height_m: float = Field(default=15.0, gt=0.0, le=2000.0, description="above the ground below the first picture, m")
    baseline_fraction: float = Field(default=0.2, ge=0.0, le=2.0, description="horizontal distance over height")
    speed_m_s: Annotated[float, Field(ge=0.0, le=200.0, description="along the course, m/s")] = 3.0
    heading_deg: Annotated[Angle, Field(description="azimuth of the picture's upper edge")] = 0.0
    course_deg: Annotated[Angle, Field(description="of the course from there, clockwise: 90 is along the rows")] = 90.0
    tilt_deg: Annotated[float, Field(ge=0.0, le=60.0, description="of the first picture's axis from nadir")] = 0.0
    tilt_towards_deg: Annotated[Angle, Field(description="azimuth towards which it is tilted")] = 0.0
    climb_fraction: float = Field(default=0.0, gt=-0.9, le=5.0, description="change of height over height")
    roll_deg: Annotated[Angle, Field(description="rotation about the optical axis between the pictures")] = 0.0
    pitch_deg: Annotated[Angle, Field(description="rotation about the picture's right")] = 0.0
    yaw_deg: Annotated[Angle, Field(description="rotation about the picture's up direction")] = 0.0
    rate_deg_s: Annotated[NonNegative, Field(le=100.0, description="RMS attitude rate per axis at a picture")] = 0.0


class NavigationParameters(Parameters):
    """Standard deviations per axis of the on-board poses and of the inclinometers, drawn for a case."""

    position_m: NonNegative = Field(default=0.02, le=100.0, description="of the position, common to both pictures")
    motion_m: Annotated[NonNegative, Field(le=10.0, description="of the motion between the pictures, m")] = 0.01
    tilt_deg: NonNegative = Field(default=0.3, le=30.0, description="of roll and pitch, common to both pictures")
    azimuth_deg: NonNegative = Field(default=1.0, le=30.0, description="of the azimuth, common to both pictures")
    turn_deg: Annotated[NonNegative, Field(le=10.0, description="of the rotation between the pictures")] = 0.1
    inclinometer_deg: NonNegative = Field(default=0.2, le=30.0, description="of the inclinometers' roll and pitch, deg")


class PairParameters(Parameters):
    """The criterion: overlap times baseline, which counts up to `max_baseline_fraction` of the range.

    The paper names baseline and overlap; their weighting is assumed.
    """

    max_baseline_fraction: float = Field(
        default=0.2, gt=0.0, le=2.0, description="maximum of baseline over range that counts"
    )
    min_overlap: float = Field(default=0.5, ge=0.0, le=1.0, description="of the first picture's ground in the second")


class LanderParameters(Parameters):
    """Limits of the lander, and its shadow."""

    diameter_m: float = Field(default=2.0, gt=0.0, le=100.0, description="of its footprint, a disc (paper, IV)")
    max_slope_deg: Annotated[float, Field(gt=0.0, lt=90.0, description="of the plane under it")] = 15.0
    max_roughness_m: float = Field(default=0.2, gt=0.0, le=100.0, description="distance of the ground from the plane")
    caster_diameter_m: NonNegative = Field(
        default=0.0, le=100.0, description="of the disc that casts its shadow; 0: none"
    )

    @property
    def limits(self) -> Limits:
        """The limits in SI units."""
        return Limits(self.diameter_m, float(np.radians(self.max_slope_deg)), self.max_roughness_m)


class LandingScenarioParameters(AlgorithmSelection, CustomScores):
    """All parameters of the landing scenario; `terrain` holds changes of the site's terrain at the stated scale."""

    task = LANDING
    scored = ScoredLanding

    site: Annotated[str, Field(description="preset of terrain, light, texture and rocks")] = "heli-hazardous"
    scale: Annotated[Literal["ground", "descent"], Field(description="which of the site's terrains")] = "ground"
    terrain_of: str | None = Field(default=None, description="site of the terrain; filled in, not to be set")
    terrain: CheckedTerrain = TerrainParameters()
    location: Location = Location()
    meshes: Annotated[tuple[MeshParameters, ...], Field(description="custom meshes on the ground")] = ()
    texture: NonNegative = Field(default=1.0, le=10.0, description="contrast of the fine texture, over the site's own")
    sun: SunParameters = SunParameters()
    camera: NamedOrCustomCamera = Field(default="xc-55", description="nadir camera preset, or a table with file")
    calibration: CalibrationParameters = Field(default=CalibrationParameters(), description="camera calibration errors")
    detector: DetectorChoice = Field(default_factory=lambda: preset("xc-55").detector)
    exposure: Annotated[AutoExposureParameters, Field(description="how the exposure is set")] = AutoExposureParameters()
    flown: PassParameters = Field(
        default=PassParameters(), description="poses at the pictures; a helicopter's flight uses the azimuths"
    )
    navigation: Annotated[NavigationParameters, Field(description="pose errors without helicopter")] = (
        NavigationParameters()
    )
    helicopter: HelicopterParameters | None = Field(default=None, description="flown for pictures and landing")
    pair: PairParameters = Field(default=PairParameters(), description="which two of a helicopter's pictures are used")
    laser: LaserParameters = LaserParameters()
    lander: LanderParameters = LanderParameters()
    faults: Faults = Faults()
    algorithm: str = Field(default="hda", description="hda, essential-matrix, semi-global, or a custom 'module:Class'")
    hda: Annotated[HdaOptions, Field(description="options of the hazard detection and avoidance")] = HdaOptions(
        track_seed=TrackSeed.POSE
    )
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
        down = [known for known in PRESETS if preset(known).design.down]
        if not isinstance(name, CustomCamera) and name not in down:
            raise ValueError(f"no camera preset that looks down is called '{name}'; allowed: {', '.join(down)}")
        return name

    @model_validator(mode="before")
    @classmethod
    def _complete_terrain(cls, stated: Any) -> Any:
        if not isinstance(stated, Mapping):
            return stated
        name, scale = stated.get("site", "heli-hazardous"), stated.get("scale", "ground")
        changes = stated.get("terrain", {})
        known = sites().get(name) if isinstance(name, str) else None
        if "terrain_of" in stated or getattr(known, str(scale), None) is None or not isinstance(changes, Mapping):
            return stated
        return {**stated, "terrain_of": name, "terrain": site(name).terrain(scale).with_changes(changes).model_dump()}

    @model_validator(mode="after")
    def _check_consistency(self) -> LandingScenarioParameters:
        """Check terrain (one completed for a site must not have another's light), row binning, and faults."""
        if getattr(self.preset, self.scale) is None:
            raise ValueError(f"site {self.site} has no terrain at the scale '{self.scale}'")
        rows = self.optics.size[1]
        if rows % self.detector.rows_summed:
            raise ValueError(
                f"detector.rows_summed {self.detector.rows_summed} does not divide the camera's {rows} rows"
            )
        if self.terrain_of != self.site:
            raise ValueError(f"site is {self.site}, but the terrain is of {self.terrain_of}; a site is not dispersed")
        for name in ("lost_pictures", "gps_outage_s"):
            if getattr(self.faults, name) and self.helicopter is None:
                raise ValueError(f"faults.{name} is that of a helicopter's flight; state the table helicopter")
        return self

    @property
    def optics(self) -> CameraModel:
        """The camera in the body frame."""
        return self.camera.camera() if isinstance(self.camera, CustomCamera) else preset(self.camera).cameras()[0]

    @property
    def height_m(self) -> float:
        """Commanded height of the pictures above the ground."""
        return self.flown.height_m if self.helicopter is None else self.helicopter.transit.height_m

    @property
    def preset(self) -> Site:
        """The site."""
        return site(self.site)
