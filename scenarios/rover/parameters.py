"""Parameters of the rover scenario: world, target, route, cameras, timing, and tracker."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.vtt import VttOptions
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.parts.scores import CustomScores, ScoredRun
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.site_parameters import site_validator
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driving import SlipParameters
from marsyard.sim.error_sources import CLOUDS, DETECTOR, OPTICS, SHADOW, ErrorSource
from marsyard.sim.frames import direction
from marsyard.sim.measurements import MastCalibration
from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.render import CloudParameters, Sun
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.sensor import AutoExposureParameters, CustomCameraChoice, DetectorChoice, DetectorParameters, preset
from marsyard.sim.sensor.mast import MASTS, PointingParameters, StereoCalibrationParameters, mount_on_head, stereo_mast
from marsyard.sim.sensor.odometry import OdometryParameters
from marsyard.sim.terrain import MAX_TERRAINS, PhotometryChanges, Site, site

#: Angles in degrees: relative angles, and azimuths.
RelativeAngle = Annotated[float, Field(ge=-180.0, le=180.0)]
Azimuth = Annotated[float, Field(ge=-360.0, le=720.0)]


class InclineParameters(Parameters):
    """A plane slope around the target that rises to the east, and the direction of the route on it."""

    name: Annotated[str, Field(min_length=1, description="name in the report")] = "flat ground"
    slope_deg: Annotated[float, Field(ge=0.0, le=40.0, description="0: no slope")] = 0.0
    oblique_deg: RelativeAngle = Field(default=0.0, description="angle added to the bearing of the start")


class WorldParameters(Parameters):
    """One terrain of a site's terrain bank, with large rocks removed from the route."""

    site: Annotated[
        str, site_validator("a rover", "ground"), Field(description="preset of terrain, rocks, texture and light")
    ] = "mars-yard"
    bank: Annotated[int, Field(ge=1, le=MAX_TERRAINS, description="number of terrains in the terrain bank")] = 8
    bank_seed: Annotated[int, Field(ge=0, description="seed of the bank's terrains")] = 1
    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank, from 0")] = 0
    samples: Annotated[int, Field(ge=256, le=8192, description="samples along each side, every 2.5 cm")] = 2048
    incline: InclineParameters = InclineParameters()
    rms_slope_deg: Annotated[float | None, bounded_field(0.0, 30.0, "ground's RMS slope; default: the site's")] = None
    dust_opacity: Annotated[
        float | None, bounded_field(0.0, 10.0, "optical depth of the dusty air; default: the site's")
    ] = None
    photometry: PhotometryChanges = PhotometryChanges()
    rock_abundance: Annotated[
        float | None, bounded_field(0.0, 0.4, "fraction of the ground covered by rocks; default: the site's")
    ] = None
    largest_near_m: Annotated[NonNegative, Field(description="maximum diameter of rocks on the route")] = 0.08
    east_m: float = Field(default=8.0, description="east position of the target's rock on the periodic terrain, m")
    north_m: float = Field(default=8.0, description="north position of the target's rock on the periodic terrain, m")
    rocks_underfoot: bool = Field(default=False, description="whether the wheels roll over rocks too, not only ground")
    background_half_deg: Annotated[
        Positive, Field(le=180.0, description="half angle of the sector behind the target in which rocks are rendered")
    ] = 50.0

    @property
    def lit_site(self) -> Site:
        """The site with the dust and the reflectance of the case."""
        return site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)

    @model_validator(mode="after")
    def _check_terrain(self) -> WorldParameters:
        if self.terrain >= self.bank:
            raise ValueError(f"terrain {self.terrain} is not in the bank; allowed: 0 to {self.bank - 1}")
        if self.samples & (self.samples - 1):
            raise ValueError(f"samples is {self.samples}; allowed: powers of two")
        if self.incline.slope_deg and site(self.site).terrain("ground").ramp is not None:
            raise ValueError(f"world.incline.slope_deg cannot be set: site {self.site} already has a slope")
        return self


class ObstacleParameters(Parameters):
    """A rock on or next to the route, positioned relative to the target."""

    towards_start_m: Annotated[float, Field(description="distance from the target towards the start, m")] = 4.0
    right_m: Annotated[float, Field(description="offset to the right of that line, seen from the start, m")] = 0.0
    diameter_m: Annotated[float, Field(gt=0.0, le=5.0)] = 0.3
    height_m: Annotated[Positive | None, Field(description="default: half the diameter")] = None


class TargetParameters(Parameters):
    """The target's rock, the designated point on it, and the form of its designation (section 3).

    The point is selected in the view from the start: `across` is its horizontal position from the left (-1) to the
    right (1) outline of the rock, `up` its vertical position from the foot (0) to the top (1). `designation` is the
    form in which the tracker receives the point: a pixel, or a position in the rover or site frame.
    """

    diameter_m: Annotated[float, Field(gt=0.01, le=5.0, description="diameter of the rock")] = 0.8
    height_m: Annotated[Positive | None, Field(description="height of the rock; default: half the diameter")] = None
    shape: Annotated[
        int | None, Field(ge=0, le=31, description="number of the rock's shape; random if omitted, see PlacedRock")
    ] = None
    yaw_deg: Annotated[float | None, Field(description="yaw of the rock, deg; random if omitted")] = None
    across: Annotated[
        float,
        Field(ge=-1.0, le=1.0, description="designated point on the rock: -1 at its left edge, 1 at its right edge"),
    ] = 0.0
    up: Annotated[
        float, Field(ge=0.0, le=1.0, description="designated point on the rock: 0 at its foot, 1 at its top")
    ] = 0.5
    designation: Literal["pixel", "rover", "site"] = Field(default="pixel", description="kind of designation")


class StartParameters(Parameters):
    """The rover's position and heading at the start, relative to the target."""

    distance_m: float = Field(
        default=10.0, gt=1.0, le=40.0, description="horizontal distance from mast to designated point"
    )
    bearing_deg: Azimuth = Field(
        default=270.0, description="azimuth from the target to the rover at the start, clockwise from north"
    )
    target_azimuth_deg: RelativeAngle = Field(default=0.0, description="direction of the target, to the right of ahead")


class LegParameters(Parameters):
    """A leg of a run; the target is tracked after each step.

    ========== ========================================================================================================
    stay       does not move for `steps` updates
    approach   drives towards the target's latest estimate until its distance is `goal_m`
    back-off   drives backwards, away from the target, until its distance is `goal_m`
    straight   drives `steps` times `step_m` along its heading (backwards if negative)
    turn       turns in place `steps` times by `step_deg` (to the right if positive)
    circle     crabs around the target's latest estimate, facing it, `steps` times by `step_deg` (clockwise from above)
    ========== ========================================================================================================
    """

    motion: Literal["stay", "approach", "back-off", "straight", "turn", "circle"] = "approach"
    steps: Annotated[int, bounded_field(1, 200, "number of steps; the maximum of an approach or back-off")] = 60
    step_fraction: float = Field(
        default=0.1, gt=0.0, le=0.9, description="step length divided by the camera's distance from the target"
    )
    step_m: Annotated[float | None, Field(description="fixed step length; required for straight")] = None
    step_deg: Annotated[RelativeAngle, Field(description="step of a turn or circle")] = 5.0
    goal_m: Positive = Field(default=2.0, description="final horizontal distance of the rover's origin from the target")
    ends_with_steps: bool = Field(
        default=False, description="whether the leg is complete after all steps, even before goal_m"
    )
    offset_right_m: float = Field(default=0.0, description="offset of the goal to the right of the target's direction")
    shuffle_m: NonNegative = Field(
        default=0.0, description="length of a short drive after each step of a turn, alternately forward and back"
    )
    visual_odometry: Annotated[bool, Field(description="whether the pose is corrected by visual odometry")] = False
    visual_odometry_step_m: Positive = Field(
        default=0.75, description="maximum drive between two image pairs of visual odometry (60 % overlap)"
    )
    autonav: bool = Field(default=False, description="whether a navigator avoids the hazards in its map")
    maps_first: Annotated[bool, Field(description="whether the navigator maps before the first step")] = False
    map_by: Annotated[Literal["body", "mast"], Field(description="cameras of the navigator's map")] = "mast"
    wedges: Annotated[int, Field(ge=1, le=4, description="number of mast azimuths that are mapped at each step")] = 2
    target_is_no_obstacle: bool = Field(default=True, description="whether the navigator ignores the target's rock")

    @model_validator(mode="after")
    def _check_step(self) -> LegParameters:
        if self.motion == "straight" and self.step_m is None:
            raise ValueError("a straight leg needs step_m")
        if self.motion in ("approach", "back-off") and self.step_m is not None and self.step_m <= 0.0:
            raise ValueError(f"step_m is {self.step_m:g}; allowed for motion '{self.motion}': above 0")
        if self.autonav and self.motion != "approach":
            raise ValueError(f"autonav needs a leg of motion 'approach', not '{self.motion}'")
        return self

    @property
    def uses_map(self) -> bool:
        """Whether the navigator maps the terrain in this leg."""
        return self.autonav or self.maps_first


SUN_MOTION = ErrorSource("sun", "motion of the sun")


class MovingSunParameters(Parameters):
    """Position of the sun at the start, and motion of the sun."""

    azimuth_deg: Annotated[Azimuth, Field(description="azimuth of the sun, clockwise from north")] = 225.0
    elevation_deg: Annotated[float, Field(gt=3.0, le=90.0, description="elevation of the sun above the horizon")] = 45.0
    hour_angle_deg_min: Annotated[
        float, SUN_MOTION, bounded_field(-1.0, 1.0, "rotation rate of the sun, deg/min; Table IV: 16 deg in 66 min")
    ] = 16.0 / 66.0
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0, description="latitude of the site, north positive")] = -2.0
    update_interval_s: Annotated[Positive, Field(description="interval between updates of the sun's position, s")] = (
        120.0
    )

    def direction(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Compute the unit vector to the sun, world axes; the sun rotates westwards about the pole."""
        start_direction = direction(np.radians(self.azimuth_deg), np.radians(self.elevation_deg))
        pole = direction(0.0, np.radians(self.latitude_deg))
        angle = -np.radians(self.hour_angle_deg_min * time_s / 60.0)
        cosine, sine = np.cos(angle), np.sin(angle)
        # Rodrigues' rotation formula
        direction_at_time = (
            cosine * start_direction
            + sine * np.cross(pole, start_direction)
            + (1.0 - cosine) * (pole @ start_direction) * pole
        )
        return np.asarray(direction_at_time / np.linalg.norm(direction_at_time))

    def sun_in_interval(self, index: int, angular_radius_rad: float) -> Sun:
        """Return the sun of all images in an interval of `update_interval_s`: the sun at the centre of the interval."""
        return Sun(self.direction((index + 0.5) * self.update_interval_s), angular_radius_rad)


class TimingParameters(Parameters):
    """Durations of a run's activities (means of Table IV)."""

    track_s: Annotated[NonNegative, Field(description="a tracking update, s")] = 45.0
    visual_odometry_s: Annotated[NonNegative, Field(description="a visual odometry update, s")] = 105.0
    autonav_s: Annotated[NonNegative, Field(description="a navigation update, s")] = 300.0
    drive_s: Annotated[NonNegative, Field(description="a step's motion, s (19 min for 15 steps in section 7.2)")] = 30.0


class ExposureParameters(Parameters):
    """Exposure of the images (section 4.5)."""

    metering: Literal["subframe", "full-frame", "fixed"] = Field(
        default="subframe", description="image region of auto-exposure; fixed: no auto-exposure"
    )
    auto: AutoExposureParameters = AutoExposureParameters()


class CustomPair(Parameters):
    """A custom stereo pair on the mast's head; the positions in the camera files are ignored."""

    left: Annotated[CustomCameraChoice, Field(description="camera file: a path, or a table with file")]
    right: Annotated[CustomCameraChoice | None, Field(description="right camera file; default: same as left")] = None
    baseline_m: Annotated[float, Field(gt=0.0, le=5.0, description="distance between the cameras, m")]
    toe_in_deg: Annotated[float, Field(ge=-30.0, le=30.0, description="inward rotation of each camera")] = 0.0

    @model_validator(mode="after")
    def _check_sizes(self) -> CustomPair:
        if self.right is not None and self.right.size != self.left.size:
            left, right = (f"{columns} x {rows}" for columns, rows in (self.left.size, self.right.size))
            raise ValueError(f"the left camera has {left} pixels, the right one {right}; allowed: equal sizes")
        return self

    def cameras(self) -> tuple[CameraModel, CameraModel]:
        """Create the left and the right camera in the head's frame."""
        right = self.left if self.right is None else self.right
        return mount_on_head(self.left.camera(), right.camera(), self.baseline_m, self.toe_in_deg)


class MastCameraParameters(Parameters):
    """The stereo pair on the mast.

    `defocus_px`, `stray_light`, `dust_discs` and `dust_depth` replace the optics of the detector, if they are given.
    """

    preset: str = Field(
        default="mer-navcam",
        description="pair of stereo cameras with its mast and rover; a key of `marsyard.sim.sensor.mast.MASTS`",
    )
    custom: Annotated[CustomPair | None, Field(description="a custom pair on the preset's mast")] = None
    detector: DetectorChoice | None = Field(default=None, description="both detectors; default: the preset's")
    detector_noise: Annotated[
        bool, DETECTOR, Field(description="whether images have detector noise and response, with fall-off and dust")
    ] = True
    defocus_px: Annotated[
        float | None,
        OPTICS,
        bounded_field(0.0, 10.0, "defocus: diameter of the blur circle of a point; default: the detector's"),
    ] = None
    stray_light: Annotated[
        float | None,
        OPTICS,
        bounded_field(0.0, 0.5, "stray light: fraction of all light that is spread evenly; default: the detector's"),
    ] = None
    dust_discs: Annotated[
        int | None,
        OPTICS,
        Field(ge=0, le=1000, description="number of specks of dust on each camera window; default: the detector's"),
    ] = None
    dust_depth: Annotated[
        Fraction | None, Field(description="fraction of the light absorbed by a speck; default: the detector's")
    ] = None

    @field_validator("preset")
    @classmethod
    def _check_preset(cls, name: str) -> str:
        if name not in MASTS:
            raise ValueError(f"no mast has the camera preset '{name}'; allowed: {', '.join(MASTS)}")
        return name

    @field_validator("detector")
    @classmethod
    def _check_detector(cls, detector: DetectorParameters | None) -> DetectorParameters | None:
        if detector is not None and detector.rows_summed != 1:
            raise ValueError(f"rows_summed is {detector.rows_summed}; allowed for cameras on a mast: 1")
        return detector

    @property
    def name(self) -> str:
        """Name of the preset, or file of the left camera."""
        return self.preset if self.custom is None else self.custom.left.file or "custom"

    def mast(self) -> MastCalibration:
        """Return the mast and its stereo pair as designed, without errors."""
        design = stereo_mast(self.preset)
        if self.custom is None:
            return design
        left, right = self.custom.cameras()
        return replace(design, left=left, right=right)

    def detector_parameters(self) -> DetectorParameters:
        """Return the parameters of both detectors."""
        detector = preset(self.preset).detector if self.detector is None else self.detector
        errors = {name: getattr(self, name) for name in ("defocus_px", "stray_light", "dust_discs", "dust_depth")}
        changes = {name: value for name, value in errors.items() if value is not None}
        return detector.model_copy(update={"optics": detector.optics.model_copy(update=changes)})


class MobilityParameters(Parameters):
    """Criterion for a stuck rover, whose run ends: its true displacement over successive steps.

    With a slip above the default an approach from 10 m to 2 m needs more than 80 steps of 10 % instead of 16.
    """

    stuck_slip: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="slip over `stuck_steps` successive steps above which a rover is stuck"),
    ] = 0.8
    stuck_steps: Annotated[int, Field(ge=1, le=200, description="number of steps over which slip is measured")] = 5


class ScoreParameters(Parameters):
    """Criteria for tracked and falsely tracked targets, and number of updates that are stored in columns."""

    tracked_px: Positive = Field(
        default=5.0, description='maximum distance of a tracked target from the true pixel ("several pixels")'
    )
    false_track_px: Positive = Field(
        default=10.0, description='distance from the true pixel above which a report is false ("extreme" drift)'
    )
    stored_updates: int = Field(default=0, ge=0, le=100, description="number of first updates stored in columns")


class NavigationParameters(Parameters):
    """Visual odometry and terrain map of the navigator; values `oracle-...` use the truth instead of images."""

    odometry: Annotated[
        Literal["stereo", "oracle-motion"],
        Field(description="stereo: rendered pairs; oracle-motion: true motion with the errors of odometry.visual"),
    ] = "stereo"
    terrain: Annotated[
        Literal["stereo", "oracle-heights"],
        Field(description="stereo: rendered pairs; oracle-heights: true heights, without occlusion"),
    ] = "stereo"
    binning: Annotated[int, Field(ge=1, le=8, description="pixels summed along each side (MER: 256 x 256 images)")] = 4
    elevation_deg: Annotated[float, bounded_field(-60.0, 0.0, "elevation of the mast for these images")] = -30.0


class RunVariantParameters(Parameters):
    """One of several different runs of a campaign: its leg, ground and rock replace those of the campaign."""

    leg: Annotated[LegParameters, Field(description="the only leg of the run")] = LegParameters()
    incline: InclineParameters = InclineParameters()
    diameter_m: Annotated[float, Field(gt=0.01, le=5.0, description="diameter of the target's rock")] = 0.8


class RoverScenarioParameters(AlgorithmSelection, CustomScores):
    """All parameters of the rover scenario."""

    task = TRACKING
    scored = ScoredRun

    world: WorldParameters = WorldParameters()
    target: TargetParameters = TargetParameters()
    obstacles: tuple[ObstacleParameters, ...] = ()
    start: StartParameters = StartParameters()
    legs: Annotated[tuple[LegParameters, ...], Field(min_length=1, description="legs, in order")] = (LegParameters(),)
    variants: Annotated[tuple[RunVariantParameters, ...], Field(description="list of different runs")] = ()
    variant: Annotated[int, Field(ge=0, description="number of the run in `variants`, from 0")] = 0
    slip: SlipParameters = SlipParameters()
    mobility: MobilityParameters = MobilityParameters()
    navigation: NavigationParameters = NavigationParameters()
    odometry: OdometryParameters = OdometryParameters()
    pointing: PointingParameters = PointingParameters()
    stereo: StereoCalibrationParameters = StereoCalibrationParameters()
    camera: MastCameraParameters = MastCameraParameters()
    exposure: ExposureParameters = ExposureParameters()
    sun: MovingSunParameters = MovingSunParameters()
    clouds: Annotated[CloudParameters | None, CLOUDS, Field(description="clouds whose shadows drift over the run")] = (
        None
    )
    rover_shadow: Annotated[bool, SHADOW, Field(description="whether the rover and its mast cast shadows")] = True
    timing: TimingParameters = TimingParameters()
    algorithm: str = Field(default="vtt", description="vtt, pure-ncc, lucas-kanade, or a custom 'module:Class'")
    vtt: VttOptions = Field(default=VttOptions(), description="tracker options; pure-ncc ignores scale and roll")
    score: ScoreParameters = ScoreParameters()
    backend: Backend = Field(default_factory=default_backend, description="OpenGL context provider")

    @model_validator(mode="after")
    def _check_variant(self) -> RoverScenarioParameters:
        if self.variant >= max(len(self.variants), 1):
            raise ValueError(f"variant is {self.variant}; allowed: 0 to {max(len(self.variants), 1) - 1}")
        return self

    def select_variant(self) -> RoverScenarioParameters:
        """Return the parameters of the run `variant`; the same parameters without `variants`."""
        if not self.variants:
            return self
        run = self.variants[self.variant]
        changes = {
            "legs": (run.leg,),
            "world": self.world.model_copy(update={"incline": run.incline}),
            "target": self.target.model_copy(update={"diameter_m": run.diameter_m}),
            "variants": (),
            "variant": 0,
        }
        return self.model_copy(update=changes)

    @property
    def is_commanded(self) -> bool:
        """Whether the path consists of commands only, so that it does not depend on the target's reported position."""
        return all(leg.motion in ("stay", "straight", "turn") for leg in self.legs)

    @property
    def bearing_rad(self) -> float:
        """Direction from the target to the start, clockwise from north."""
        return float(np.radians(self.start.bearing_deg + self.world.incline.oblique_deg))
