"""Parameters of field test campaigns: runs, helicopter, instruments, targets, and selection of triples."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, model_validator

from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.scenarios.parts.scores import CustomScores, ScoredFlight
from marsyard.scenarios.site_parameters import site_validator
from marsyard.scenarios.velocity import VELOCITY
from marsyard.sim.dynamics.helicopter import HelicopterParameters
from marsyard.sim.error_sources import ATTITUDE, ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.render import CloudParameters
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.sensor import DetectorChoice, preset
from marsyard.sim.sensor.detector import BURST_DN, BURST_PX, BurstParameters, DetectorParameters
from marsyard.sim.sensor.gps import POST_PROCESSED, GpsParameters
from marsyard.sim.sensor.imu import ImuParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.terrain import TerrainParameters, site

Count = Annotated[int, Field(ge=0, le=100000)]

#: Preset of the field test's camera (paper, III.B).
CAMERA = "mer-descent-field"


class RunParameters(Parameters):
    """A run: site, time, and number of image triples of each category."""

    name: Annotated[str, Field(min_length=1, description="name of the run in the report")]
    site: Annotated[str, site_validator("a flight", "descent"), Field(description="preset of terrain and light")]
    begins: Annotated[AwareDatetime, Field(description="start of the first pass, with time zone")]
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0, description="east positive")]
    short_time: Annotated[Count, Field(description="number of triples of images close in time")] = 0
    same_direction: Annotated[Count, Field(description="triples at three altitudes, one flight direction")] = 0
    opposite_direction: Annotated[Count, Field(description="triples at three altitudes, both directions")] = 0
    clouds: Annotated[CloudParameters | None, Field(description="clouds whose shadows drift over the site")] = None
    cable_bursts: Annotated[
        NonNegative, Field(le=1e4, description="mean interference bursts per image, from a faulty camera cable")
    ] = 0.0

    @property
    def triples(self) -> int:
        """Number of triples of all categories."""
        return self.short_time + self.same_direction + self.opposite_direction


class DriftParameters(Parameters):
    """Drift of the gyro bias with the temperature of the inertial unit, which cools during the passes.

    The paper explains the scatter of the opposite-direction triples by "temperature variations in the IMU which negated
    the constant bias assumption", without a value. The drift is chosen so that some of these triples have errors above
    5 m/s.
    """

    across_deg_h_k: Annotated[
        float,
        ATTITUDE,
        Field(description="gyro bias per temperature change, deg/h/K; axis along the line: tilts the camera across it"),
    ] = 1.0
    change_k: Annotated[
        float, Field(ge=-100.0, le=100.0, description="temperature change after a long time, K; 0: no drift")
    ] = -19.0
    time_constant_s: Annotated[Positive, Field(description="time constant of the cooling, s (assumed)")] = 300.0


class ImageTargetParameters(Parameters):
    """The surveyed targets and the errors of their sightings (paper, III.D.2)."""

    placed: Annotated[int, Field(ge=3, le=1000, description="number of targets on the ground")] = 11
    used: Annotated[int, Field(ge=3, le=1000, description="number of these targets used for the attitude")] = 9
    within_m: Annotated[Positive, Field(description="half the side length of the targets' square, m (assumed)")] = 90.0
    central: Annotated[int, Field(ge=0, le=1000, description="number of the used targets in the centre")] = 3
    central_m: Annotated[Positive, Field(description="radius of the circle of the central targets, m (assumed)")] = 10.0
    images: Annotated[int, Field(ge=1, le=1000, description="number of images of a pass over the targets")] = 20
    side_m: Annotated[Positive, Field(description="side length of a target, m")] = 1.0
    albedo: Annotated[Positive, Field(le=1.0, description="albedo of the white targets (assumed)")] = 0.8
    sightings: Annotated[
        Literal["rendered", "oracle-projection"],
        Field(description="detected in rendered images, or true pixels with errors of `centroid_px`"),
    ] = "rendered"
    centroid_px: Annotated[
        NonNegative, Field(description="standard deviation of a centroid per axis for the attitude fit, px (assumed)")
    ] = 0.15
    prior_deg: Annotated[
        Positive, Field(le=5.0, description="error of the platform's attitude per axis, deg, before the fit (assumed)")
    ] = 1.0
    survey_m: Annotated[NonNegative, Field(description="error of the survey per axis, m (assumed)")] = 0.02

    @model_validator(mode="after")
    def _check_used(self) -> ImageTargetParameters:
        if self.used > self.placed:
            raise ValueError(f"{self.used} targets are used, but only {self.placed} are placed")
        if self.central > self.used:
            raise ValueError(f"{self.central} targets are in the centre, but only {self.used} are used")
        return self


ELEVATION = ErrorSource("elevation", "elevation map")


class ElevationParameters(Parameters):
    """The elevation model subtracted from the GPS height, with the accuracy class of SRTM (paper, III.D.1)."""

    posting_m: Annotated[Positive, Field(description="spacing of the model's samples (posts), m")] = 30.0
    error_m: Annotated[NonNegative, ELEVATION, Field(description="standard deviation of a post's error, m")] = 6.0
    correlation_m: Annotated[Positive, Field(description="correlation length of post errors, m (assumed)")] = 150.0
    interpolation_m: Annotated[
        NonNegative, ELEVATION, Field(description="standard deviation of the interpolation error, m")
    ] = 1.0


class ImageParameters(Parameters):
    """Times of the images: the paper takes 20 images in less than 2 min (III.D.2).

    The detector reads out an image in 1.36 s. At 2 s, 3 % of the flights contain fewer triples of Kelso run 3 than
    the paper; at 1.5 s, none of 1,000.
    """

    interval_s: Annotated[Positive, Field(le=60.0, description="time between images, s (assumed)")] = 1.5
    clock: Annotated[ClockParameters, Field(description="time tag errors (assumed)")] = ClockParameters(
        offset_sd_s=0.0005, jitter_sd_s=0.0005
    )


class TripleParameters(Parameters):
    """Selection of triples from a run's images (paper, III.D and IV)."""

    virtual_interval_s: Annotated[
        Positive,
        Field(
            le=60.0, description="time that is assigned to the interval between two images, as in the MER landings, s"
        ),
    ] = 3.75
    velocity_bias_m_s: Annotated[
        NonNegative,
        Field(description="SD per axis of the constant error of the horizontal inertial velocity (assumed: the wind)"),
    ] = 15.0
    max_speed_m_s: Annotated[
        Positive, Field(description="maximum speed: distance divided by the virtual interval, as in DIMES")
    ] = 30.0
    overlap_fraction: Annotated[
        Positive, Field(description="maximum distance between two image centres divided by the altitude (assumed)")
    ] = 0.35
    min_step_m: Annotated[Positive, Field(description="minimum height step between images, m (assumed)")] = 150.0
    max_step_m: Annotated[Positive, Field(description="maximum height step between images, m (assumed)")] = 390.0


class FieldTestParameters(AlgorithmSelection, CustomScores):
    """A field test: its runs and their common parameters. Each case is a triple of one run."""

    task = VELOCITY
    scored = ScoredFlight

    algorithm: Annotated[str, Field(description="dimes, phase-correlation, homography, or custom")] = "dimes"
    runs: Annotated[tuple[RunParameters, ...], Field(min_length=1, description="runs in the order of the report")]
    bank_seed: Annotated[int, Field(ge=0, description="seed of the sites' terrains; each site has one")] = 1
    samples: Annotated[int, Field(ge=64, le=8192, description="samples along each side of a terrain")] = 4096
    helicopter: HelicopterParameters = HelicopterParameters()
    imu: ImuParameters = ImuParameters(rate_hz=100.0, gyro_bias_deg_h_k=0.0)
    drift: DriftParameters = DriftParameters()
    gps: GpsParameters = POST_PROCESSED
    targets: ImageTargetParameters = ImageTargetParameters()
    elevation: ElevationParameters = ElevationParameters()
    images: ImageParameters = ImageParameters()
    triples: TripleParameters = TripleParameters()
    calibration: Annotated[
        CalibrationParameters, Field(description="camera calibration errors, the same in all cases")
    ] = CalibrationParameters()
    detector: DetectorChoice = Field(default_factory=lambda: preset(CAMERA).detector)
    backend: Backend = Field(default_factory=default_backend, description="OpenGL context provider")

    @model_validator(mode="after")
    def _check_run_names(self) -> FieldTestParameters:
        names = [run.name for run in self.runs]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(f"several runs have the same name: {', '.join(duplicates)}")
        return self

    @property
    def site_names(self) -> tuple[str, ...]:
        """Names of the runs' sites without duplicates; their indices are those of the shared terrains."""
        return tuple(dict.fromkeys(run.site for run in self.runs))

    def run_detector(self, number: int) -> DetectorParameters:
        """Return the parameters of the detector in a run: with its interference bursts on the cable."""
        bursts = self.runs[number].cable_bursts
        if not bursts:
            return self.detector
        interference = BurstParameters(bursts=bursts, length_px=BURST_PX, amplitude_dn=BURST_DN)
        return self.detector.model_copy(update={"bursts": interference})

    def terrain(self, site_name: str) -> TerrainParameters:
        """Parameters of a site's terrain."""
        return site(site_name).terrain("descent").model_copy(update={"samples": self.samples})
