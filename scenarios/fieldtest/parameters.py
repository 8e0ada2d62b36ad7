"""Parameters of field test campaigns."""

from __future__ import annotations

from typing import Annotated

from pydantic import AwareDatetime, Field, model_validator

from marsyard.scenarios.algorithm_run import AlgorithmSelection
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.exposure import CalibrationParameters
from marsyard.scenarios.parts.scores import CustomScores, ScoredFlight
from marsyard.scenarios.terrain_files import check_site
from marsyard.sim.dynamics.helicopter import HelicopterParameters
from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.render import CloudParameters
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.sensor import DetectorChoice, preset
from marsyard.sim.sensor.imu import ImuParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.satellite_navigation import POST_PROCESSED, GpsParameters
from marsyard.sim.terrain import TerrainParameters, site

Count = Annotated[int, Field(ge=0, le=100000)]

#: The camera of the field test: section III.B.
CAMERA = "mer-descent-field"


class RunParameters(Parameters):
    """A run: site, time, and number of triples of each category."""

    name: Annotated[str, Field(min_length=1, description="what the report calls the run")]
    site: Annotated[str, check_site("a flight", "descent"), Field(description="preset of terrain and light")]
    begins: Annotated[AwareDatetime, Field(description="start of the first pass, with time zone")]
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0, description="east positive")]
    short_time: Annotated[Count, Field(description="triples of pictures close in time")] = 0
    same_direction: Annotated[Count, Field(description="triples apart in altitude, flown in one direction")] = 0
    opposite_direction: Annotated[Count, Field(description="triples apart in altitude, direction switched")] = 0
    clouds: Annotated[CloudParameters | None, Field(description="clouds whose shadows drift over the site")] = None

    @property
    def triples(self) -> int:
        """Number of triples of all categories."""
        return self.short_time + self.same_direction + self.opposite_direction


class DriftParameters(Parameters):
    """Drift of the gyro bias with the temperature of the inertial unit, which the air cools on the passes.

    The paper explains the spread of the opposite-direction triples by "temperature variations in the IMU which negated
    the constant bias assumption", without their size. The drift is calibrated: some of those triples pass 5 m/s.
    """

    across_deg_h_k: Annotated[
        float, Field(description="bias of the gyro along the line of flight for a change of temperature, deg/h/K")
    ] = 1.0
    change_k: Annotated[
        float, Field(ge=-100.0, le=100.0, description="change of temperature on the passes in the end, K; 0: no drift")
    ] = -22.0
    time_constant_s: Annotated[Positive, Field(description="time constant of the change, s (assumed)")] = 300.0


class TargetParameters(Parameters):
    """The surveyed targets and the errors of their sightings (paper, III.D.2)."""

    placed: Annotated[int, Field(ge=3, le=1000, description="targets on the ground")] = 11
    used: Annotated[int, Field(ge=3, le=1000, description="targets used for attitude")] = 9
    within_m: Annotated[Positive, Field(description="half the side of the square they lie in, m (assumed)")] = 90.0
    pictures: Annotated[int, Field(ge=1, le=1000, description="pictures of a pass over them")] = 20
    centroid_px: Annotated[NonNegative, Field(description="error of a centroid per axis, px (assumed)")] = 0.15
    survey_m: Annotated[NonNegative, Field(description="error of the survey per axis, m (assumed)")] = 0.02

    @model_validator(mode="after")
    def _check_used(self) -> TargetParameters:
        if self.used > self.placed:
            raise ValueError(f"{self.used} targets are used, but {self.placed} placed")
        return self


class ElevationParameters(Parameters):
    """The elevation model subtracted from the GPS height: of the class of SRTM (paper, III.D.1)."""

    posting_m: Annotated[Positive, Field(description="distance of its posts, m")] = 30.0
    error_m: Annotated[NonNegative, Field(description="error of its posts, m")] = 6.0
    correlation_m: Annotated[Positive, Field(description="distance over which that error changes, m (assumed)")] = 150.0
    interpolation_m: Annotated[NonNegative, Field(description="error of interpolation between posts, m")] = 1.0


class PictureParameters(Parameters):
    """Times of the pictures: 20 of them in less than 2 min (paper, III.D.2)."""

    interval_s: Annotated[Positive, Field(le=60.0, description="time between pictures, s (assumed)")] = 3.0
    clock: Annotated[ClockParameters, Field(description="errors of their time tags (assumed)")] = ClockParameters(
        offset_sd_s=0.0005, jitter_sd_s=0.0005
    )


class TripleParameters(Parameters):
    """Selection of triples from a run's pictures (paper, III.D and IV)."""

    virtual_interval_s: Annotated[
        Positive, Field(le=60.0, description="time that is put between two pictures, s: that of the landings")
    ] = 3.75
    max_speed_m_s: Annotated[
        Positive, Field(description="greatest speed that the virtual interval may give, m/s: DIMES' own limit")
    ] = 30.0
    overlap_fraction: Annotated[
        Positive, Field(description="distance between what two pictures are centred on, over the altitude (assumed)")
    ] = 0.3
    min_step_m: Annotated[Positive, Field(description="least height between pictures apart, m (assumed)")] = 150.0
    max_step_m: Annotated[Positive, Field(description="most height between pictures apart, m (assumed)")] = 390.0


class FieldTestParameters(AlgorithmSelection, CustomScores):
    """A field test: its runs and their common settings. Case i is a triple of one of the runs."""

    task = VELOCITY
    scored = ScoredFlight

    algorithm: Annotated[
        str, Field(description="velocity estimator under test, see `marsyard.scenarios.estimators`")
    ] = "dimes"
    runs: Annotated[tuple[RunParameters, ...], Field(min_length=1, description="in the report's order")]
    bank_seed: Annotated[int, Field(ge=0, description="seed of the sites' terrains; each site has one")] = 1
    samples: Annotated[int, Field(ge=64, le=8192, description="samples along each side of a terrain")] = 4096
    helicopter: HelicopterParameters = HelicopterParameters()
    imu: ImuParameters = ImuParameters(rate_hz=100.0, gyro_bias_deg_h_k=0.0)
    drift: DriftParameters = DriftParameters()
    gps: GpsParameters = POST_PROCESSED
    targets: TargetParameters = TargetParameters()
    elevation: ElevationParameters = ElevationParameters()
    pictures: PictureParameters = PictureParameters()
    triples: TripleParameters = TripleParameters()
    calibration: Annotated[
        CalibrationParameters, Field(description="errors of the calibrated camera, the same in all cases")
    ] = CalibrationParameters()
    detector: DetectorChoice = Field(default_factory=lambda: preset(CAMERA).detector)
    backend: Backend = Field(default_factory=default_backend, description="library that provides OpenGL's context")

    @model_validator(mode="after")
    def _check_run_names(self) -> FieldTestParameters:
        names = [run.name for run in self.runs]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"runs share a name: {', '.join(repeated)}")
        return self

    @property
    def site_names(self) -> tuple[str, ...]:
        """Sites of the runs, each once; a site's number is that of its terrain."""
        return tuple(dict.fromkeys(run.site for run in self.runs))

    def terrain(self, site_name: str) -> TerrainParameters:
        """Parameters of a site's terrain."""
        return site(site_name).terrain("descent").model_copy(update={"samples": self.samples})
