"""Parameters of descent campaigns."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, Tag, field_validator, model_validator

from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.scenarios.descent.faults import INSTRUMENT_FAULTS, DescentFaults, add_time_fault
from marsyard.scenarios.descent.recorded import FlightFile
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.parts.instruments import CustomAltimeter, CustomAttitudeSource
from marsyard.scenarios.parts.motions import CustomMotion
from marsyard.scenarios.parts.named import default_or_custom
from marsyard.scenarios.parts.scores import CustomScores, ScoredDescent
from marsyard.scenarios.site_parameters import (
    DustOpacity,
    Location,
    RenderParameters,
    SunParameters,
    complete_terrain,
    preset_terrain,
    site_validator,
)
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.scenarios.velocity import VELOCITY, check_image_size
from marsyard.sim.dynamics.pendulum import SwingParameters
from marsyard.sim.error_sources import CALIBRATION, SHADOW
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.sensor import (
    ApproachParameters,
    ClockParameters,
    CustomCamera,
    CustomCameraChoice,
    DetectorChoice,
    ImuParameters,
    RadarParameters,
    preset,
)
from marsyard.sim.sensor.imu import IMUS, ImuClass
from marsyard.sim.sensor.instrument import MAX_TAG_DEVIATIONS
from marsyard.sim.terrain import PhotometryChanges, Site, TerrainParameters, site

#: Number of images of an MER descent. Estimators that do not process a stream receive this number of images.
TRIPLE_SIZE = 3
#: Duration of a simulated descent before the first image, s.
SIMULATED_LEAD_S = 5.0
#: Margin of the inertial unit's data: after the start of the motion and after the thrusters' firing, s.
IMU_MARGIN_S = 0.1


class DescentLanderParameters(Parameters):
    """The lander's shadow in its own images, modelled as the shadow of a disc at the camera's position.

    The parachute's canopy dominates. Its diameter is 15.09 m (nominal) times 0.72 (inflated; Witkowski & Bruno 2003,
    MER parachute); from 2 km it covers 80 % of the sun. Backshell and lander, 2.65 m in diameter, cover 1/20
    of the sun; for a high sun their shadow is inside the shadow of the canopy. The canopy is about 40 m above the
    camera, which moves its shadow by 1 deg in the view. This is not modelled: DIMES masks a zero-phase spot of 4 deg.
    """

    caster_diameter_m: Annotated[
        float, SHADOW, bounded_field(0.0, 100.0, "diameter of the disc that casts the shadow")
    ] = 10.9


class TouchdownParameters(Parameters):
    """Parameters of the touchdown (`descent.touchdown.compute_touchdown`); all values except the burn's are assumed."""

    computation_s: Annotated[float, bounded_field(0.0, 1000.0, "computation time on the flight computer")] = 14.0
    steering_deadband_m_s: Annotated[float, bounded_field(0.0, 100.0, "maximum horizontal speed without steering")] = (
        5.0
    )
    max_steering_m_s: Annotated[float, bounded_field(0.0, 100.0, "limit of steering: burn of 80 m/s, 15 deg tilt")] = (
        20.0
    )
    steering_error: Annotated[float, bounded_field(0.0, 1.0, "RMS relative error of the steering per axis")] = 0.1
    burn_error_m_s: Annotated[float, bounded_field(0.0, 50.0, "RMS velocity error of the burn per axis")] = 1.0


class DescentCameraParameters(CalibrationParameters):
    """The descent camera and the errors of its calibration: focal length 14.67 mm, pixels 12 um, field of view 45 deg.

    The distortion is that of an Opportunity navcam (its PDS label).

    A custom camera `model` replaces focal length, pixels and distortion.
    """

    model: Annotated[CustomCameraChoice | None, Field(description="custom camera: file path, or table")] = None
    focal_length_mm: Annotated[float, Field(gt=1.0, le=1000.0)] = 14.67
    pixel_pitch_um: Annotated[float, Field(gt=0.5, le=100.0)] = 12.0
    columns: Annotated[int, Field(ge=64, le=4096)] = 1024
    rows: Annotated[int, Field(ge=64, le=4096)] = 1024
    radial_0: Annotated[float, bounded_field(-0.1, 0.1, "radial distortion R0 (CAHVOR)")] = 0.00096
    radial_1: Annotated[float, bounded_field(-0.5, 0.5, "radial distortion R1 (CAHVOR)")] = -0.002183
    radial_2: Annotated[float, bounded_field(-0.5, 0.5, "radial distortion R2 (CAHVOR)")] = 0.018547
    alignment_error_deg: Annotated[
        float, CALIBRATION, bounded_field(0.0, 10.0, "RMS error of the mounting per axis")
    ] = 0.02


class InertialParameters(Parameters):
    """Inertial increments for velocity estimators, measured by a unit at the camera with axes parallel to the body's.

    The unit belongs to the vision system. Its errors are independent of those of the navigation's unit (`imu`).
    """

    rate_hz: Annotated[float, bounded_field(0.0, 400.0, "increments per second, at least 50; 0: no increments")] = 0.0
    imu_class: Annotated[ImuClass, Field(description="class of the inertial unit")] = "ln-200"

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, rate_hz: float) -> float:
        # at 50 Hz the relative error of the simulated increments is 3e-7 for an oscillation of 1 Hz (`true_increments`)
        if 0.0 < rate_hz < 50.0:
            raise ValueError(f"rate_hz is {rate_hz:g}; allowed: 0 (no increments), or 50 to 400")
        return rate_hz

    @property
    def unit(self) -> ImuParameters | None:
        """Parameters of the inertial unit; None without increments."""
        return IMUS[self.imu_class].model_copy(update={"rate_hz": self.rate_hz}) if self.rate_hz else None


Flight = Annotated[
    Annotated[FlightFile, Tag("FlightFile")] | Annotated[CustomMotion, Tag("CustomMotion")],
    default_or_custom(FlightFile, CustomMotion),
]
Altimeter = Annotated[
    Annotated[RadarParameters, Tag("RadarParameters")] | Annotated[CustomAltimeter, Tag("CustomAltimeter")],
    default_or_custom(RadarParameters, CustomAltimeter),
]


class DescentScenarioParameters(AlgorithmSelection, CustomScores):
    """Parameters of a descent campaign.

    `site` defines light, gravity, texture and rocks; keys of the table `terrain` override the site's terrain. All cases
    have the same site: it is merged into `terrain` when the campaign is read, and cannot be dispersed.
    """

    # task of the algorithms, and class of the cases that custom scores receive
    task = VELOCITY
    scored = ScoredDescent

    site: Annotated[
        str | None,
        site_validator("a descent", "descent"),
        Field(description="preset of terrain, light and gravity; none: generic terrain"),
    ] = None
    terrain_site: Annotated[str | None, Field(description="site of the terrain; set automatically from `site`")] = None
    location: Location = Location()
    terrain: CheckedTerrain = TerrainParameters()
    meshes: Annotated[tuple[MeshParameters, ...], Field(description="custom objects on the ground")] = ()
    sun: SunParameters = SunParameters()
    dust_opacity: DustOpacity = None
    photometry: PhotometryChanges = PhotometryChanges()
    descent: SwingParameters = SwingParameters()
    images: Annotated[int, bounded_field(2, 100, "number of images; only stream estimators use more than three")] = (
        TRIPLE_SIZE
    )
    #: Default: the last image and two earlier ones, at the longest possible equal intervals.
    triple: Annotated[tuple[int, int, int] | None, Field(description="image numbers of the triple, from 1")] = None
    flight: Annotated[Flight | None, Field(description="recorded flight or custom motion")] = None
    lander: DescentLanderParameters = DescentLanderParameters()
    camera: DescentCameraParameters = DescentCameraParameters()
    faults: DescentFaults = DescentFaults()
    algorithm: Annotated[str, Field(description="dimes, phase-correlation, homography, or custom")] = "dimes"
    dimes: Annotated[DimesOptions, Field(description="options of DIMES")] = DimesOptions()
    detector: DetectorChoice = Field(default_factory=lambda: preset("mer-descent-flown").detector)
    imu: ImuParameters = ImuParameters()
    inertial: InertialParameters = InertialParameters()
    approach: ApproachParameters = ApproachParameters()
    altimeter: Altimeter = RadarParameters()
    attitude_source: Annotated[CustomAttitudeSource | None, Field(description="custom source of attitudes")] = None
    clock: Annotated[ClockParameters, Field(description="clock of the images' time tags")] = ClockParameters(
        offset_sd_s=0.001, jitter_sd_s=0.0005
    )
    exact_instruments: Annotated[
        bool,
        Field(
            description="true attitudes, altitudes, times, camera, and propagation to the firing without errors; shows "
            "the error from the images"
        ),
    ] = False
    landing: TouchdownParameters = TouchdownParameters()
    render: RenderParameters = Field(default_factory=RenderParameters)

    @model_validator(mode="before")
    @classmethod
    def _complete_terrain(cls, parameters: Any) -> Any:
        return complete_terrain(parameters, None, lambda name, _: preset_terrain(name, "descent"))

    @model_validator(mode="after")
    def _check_consistency(self) -> DescentScenarioParameters:
        """Check terrain, binning, selected images, faults, clocks and flight.

        Terrain and light must come from the same site.
        """
        if self.dust_opacity is not None and self.site is None:
            raise ValueError("dust_opacity needs a site; the air of a generic terrain is clear")
        if self.terrain_site != self.site:
            raise ValueError(f"site is {self.site}, but terrain is of {self.terrain_site}; `site` cannot be dispersed")
        camera: DescentCameraParameters | CustomCamera = self.camera if self.camera.model is None else self.camera.model
        columns, rows = camera.columns, camera.rows
        if rows % self.detector.rows_summed:
            raise ValueError(f"detector.rows_summed {self.detector.rows_summed} does not divide the {rows} camera rows")
        check_image_size(self, (columns, rows // self.detector.rows_summed))
        if self.triple is not None and not 1 <= self.triple[0] < self.triple[1] < self.triple[2] <= self.images:
            raise ValueError(f"triple is {list(self.triple)}; allowed: three in ascending order, 1 to {self.images}")
        if self.images < TRIPLE_SIZE:
            specs = [spec for spec in self.algorithms if VELOCITY.accepts_stream(spec) is False]
            if specs:
                raise ValueError(
                    f"images is {self.images}, but '{specs[0]}' needs {TRIPLE_SIZE}; allowed: {TRIPLE_SIZE} to 100"
                )
        ineffective = [name for name in INSTRUMENT_FAULTS if self.exact_instruments and getattr(self.faults, name)]
        if ineffective:
            raise ValueError(f"faults.{ineffective[0]} has no effect with exact_instruments; allowed: 0")
        lead_s = SIMULATED_LEAD_S if self.flight is None else self.flight.lead_s
        navigation_s = lead_s - IMU_MARGIN_S
        error_s = self.clock.max_error_s + self.imu.clock.max_error_s
        if error_s > navigation_s and not self.exact_instruments:
            raise ValueError(
                f"clock and imu.clock: |offset_s| plus {MAX_TAG_DEVIATIONS:g} standard deviations (offset_sd_s, "
                f"jitter_sd_s) are {error_s:.3g} s in all; allowed: at most {navigation_s:.3g} s, the navigation "
                "before the first image"
            )
        faulty_image = max(self.faults.repeated_image, self.faults.black_image)
        if faulty_image > self.images:
            raise ValueError(f"a fault affects image {faulty_image}, but the descent has only {self.images} images")
        if isinstance(self.flight, FlightFile):
            self.flight.check(add_time_fault(self.faults, self.image_times_s))
        return self

    @property
    def image_times_s(self) -> list[float]:
        """Nominal image times relative to the first image."""
        return [number * self.descent.interval_s for number in range(self.images)]

    @property
    def triple_indices(self) -> tuple[int, int, int] | None:
        """Indices of the images for estimators that process a triple; None if there are fewer than three images."""
        if self.triple is not None:
            return self.triple[0] - 1, self.triple[1] - 1, self.triple[2] - 1
        if self.images < TRIPLE_SIZE:
            return None
        last, spacing = self.images - 1, (self.images - 1) // 2
        return last - 2 * spacing, last - spacing, last

    @property
    def site_preset(self) -> Site | None:
        """The site; None for a generic terrain."""
        return (
            None if self.site is None else site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)
        )
