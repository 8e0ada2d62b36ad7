"""Everything that a descent campaign may set or disperse."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, Tag, field_validator, model_validator

from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.chosen import ChosenAlgorithms
from marsyard.scenarios.descent.faults import Faults, faulty_times
from marsyard.scenarios.descent.recorded import FlightFile
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.parts.instruments import OwnAltimeter, OwnAttitudeSource
from marsyard.scenarios.parts.motions import OwnMotion
from marsyard.scenarios.parts.named import usual_or
from marsyard.scenarios.parts.scores import OwnScores, ScoredDescent
from marsyard.scenarios.terrain_files import check_terrain
from marsyard.sim.dynamics import SwingParameters
from marsyard.sim.parameters import Parameters
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.sensor import (
    ApproachParameters,
    ClockParameters,
    DetectorChoice,
    DetectorParameters,
    ImuParameters,
    OwnCamera,
    OwnCameraChoice,
    RadarParameters,
)
from marsyard.sim.terrain import Site, TerrainParameters, site, sites

#: Pictures of a descent as flown, which estimators without a stream take.
PICTURES = 3


class Place(Parameters):
    """Where over which terrain the descent happens."""

    bank: Annotated[int, Field(ge=1, le=100000, description="terrains in the bank")] = 4
    bank_seed: Annotated[int, Field(ge=0, description="seed of the bank's terrains")] = 1
    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank")] = 0
    east_m: Annotated[float, Field(description="where the first picture is taken, on the periodic terrain")] = 0.0
    north_m: Annotated[float, Field(description="where the first picture is taken, on the periodic terrain")] = 0.0

    @model_validator(mode="after")
    def _terrain_is_in_bank(self) -> Place:
        if self.terrain >= self.bank:
            raise ValueError(f"terrain {self.terrain} is not in the bank; allowed: 0 to {self.bank - 1}")
        return self


class SunParameters(Parameters):
    """Where the sun stands."""

    azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="clockwise from north")] = 270.0
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0, description="above the horizon")] = 40.0


class LanderParameters(Parameters):
    """What of the lander shows in its own pictures.

    Its shadow is that of one disc at the camera's place. The canopy's is the largest by far: 15.09 m nominal, inflated
    to 0.72 of that across (Witkowski & Bruno 2003, the MER parachute), it hides the sun wholly; backshell and lander,
    2.65 m across, hide a twentieth of it from 2 km and lie within the canopy's shadow when the sun is high. That the
    canopy hangs some 40 m above, which moves its shadow by 1 deg of the view, is left out: the zero-phase spot that
    DIMES masks is 4 deg in radius.
    """

    caster_diameter_m: Annotated[
        float, Field(ge=0.0, le=100.0, description="diameter of the disc that casts the lander's shadow, m")
    ] = 10.9


class LandingParameters(Parameters):
    """From the answer to the ground: see `marsyard.scenarios.descent.landing`. All but the burn are assumed."""

    computation_s: Annotated[
        float, Field(ge=0.0, le=1000.0, description="from the third picture to the answer on the flight computer, s")
    ] = 14.0
    processor_factor: Annotated[
        float,
        Field(gt=0.0, le=1e6, description="time on the flight computer over that measured on this host (assumed)"),
    ] = 600.0
    least_steered_m_s: Annotated[
        float, Field(ge=0.0, le=100.0, description="speed up to which the thrusters do not steer, m/s")
    ] = 5.0
    most_steered_m_s: Annotated[
        float, Field(ge=0.0, le=100.0, description="most that steering takes out: the burn's 80 m/s tilted by 15 deg")
    ] = 20.0
    steering_error: Annotated[
        float, Field(ge=0.0, le=1.0, description="RMS error of the steering per axis over what it takes out")
    ] = 0.1
    burn_error_m_s: Annotated[
        float, Field(ge=0.0, le=50.0, description="RMS of what the burn adds per axis, steered or not, m/s")
    ] = 1.0


class CameraParameters(Parameters):
    """The descent camera: 14.67 mm, 12 um pixels, 45 deg; distortion that of an Opportunity navcam (its PDS label).

    With `model` it is a user's own, and what is stated here of focal length, pixels and distortion is not used.
    """

    model: Annotated[
        OwnCameraChoice | None, Field(description="an own camera: the path of its file, or a table with file")
    ] = None

    focal_length_mm: Annotated[float, Field(gt=1.0, le=1000.0)] = 14.67
    pixel_pitch_um: Annotated[float, Field(gt=0.5, le=100.0)] = 12.0
    columns: Annotated[int, Field(ge=64, le=4096)] = 1024
    rows: Annotated[int, Field(ge=64, le=4096)] = 1024
    radial_0: Annotated[float, Field(ge=-0.1, le=0.1, description="first term of CAHVOR's R")] = 0.00096
    radial_1: Annotated[float, Field(ge=-0.5, le=0.5, description="second term of CAHVOR's R")] = -0.002183
    radial_2: Annotated[float, Field(ge=-0.5, le=0.5, description="third term of CAHVOR's R")] = 0.018547
    alignment_error_deg: Annotated[
        float, Field(ge=0.0, le=10.0, description="RMS per axis of the mounting's error, not known to the lander")
    ] = 0.02
    focal_error: Annotated[
        float, Field(ge=0.0, le=0.05, description="RMS relative error of the calibrated focal length")
    ] = 0.0002
    centre_error_px: Annotated[
        float,
        Field(ge=0.0, le=50.0, description="RMS error of the calibrated image centre per axis, full-frame pixels"),
    ] = 0.5
    distortion_error_px: Annotated[
        float, Field(ge=0.0, le=50.0, description="RMS error of the calibrated distortion in the picture's corners, px")
    ] = 0.3


class RenderParameters(Parameters):
    """How pictures are drawn."""

    backend: Annotated[Backend, Field(description="library that provides OpenGL's context")] = Field(
        default_factory=default_backend
    )


Flight = Annotated[
    Annotated[FlightFile, Tag("FlightFile")] | Annotated[OwnMotion, Tag("OwnMotion")], usual_or(FlightFile, OwnMotion)
]
Altimeter = Annotated[
    Annotated[RadarParameters, Tag("RadarParameters")] | Annotated[OwnAltimeter, Tag("OwnAltimeter")],
    usual_or(RadarParameters, OwnAltimeter),
]


class DescentScenarioParameters(ChosenAlgorithms, OwnScores):
    """Everything that a descent campaign may set or disperse.

    With a `site`, the keys that the table `terrain` sets are changes of the site's own terrain, and light, gravity,
    texture and rocks are the site's. A site belongs to a campaign, not to a case: it is put into `terrain` when the
    campaign is read, and cannot be dispersed.
    """

    task = VELOCITY
    scored = ScoredDescent

    site: Annotated[str | None, Field(description="preset of terrain, light and gravity; none: a plain terrain")] = None
    terrain_site: Annotated[
        str | None, Field(description="whose terrain is below; filled in with `site`, and not to be set otherwise")
    ] = None
    place: Place = Place()
    terrain: TerrainParameters = TerrainParameters()
    meshes: Annotated[tuple[MeshParameters, ...], Field(description="own bodies on the ground")] = ()
    sun: SunParameters = SunParameters()
    descent: SwingParameters = SwingParameters()
    pictures: Annotated[
        int, Field(ge=2, le=100, description="pictures that are taken, descent.interval_s apart; all go to a stream")
    ] = PICTURES
    triple: Annotated[
        tuple[int, int, int] | None,
        Field(
            description="numbers, from 1, of the three that estimators of three pictures get; not stated: those as far "
            "apart as they can be evenly, the last among them"
        ),
    ] = None
    flight: Annotated[
        Flight | None, Field(description="a recorded flight or an own motion, in place of the descent's dynamics")
    ] = None
    lander: LanderParameters = LanderParameters()
    camera: CameraParameters = CameraParameters()
    faults: Faults = Faults()
    algorithm: Annotated[
        str, Field(description="estimator under test: dimes, phase-correlation, homography, or your own")
    ] = "dimes"
    dimes: Annotated[DimesOptions, Field(description="options of DIMES")] = DimesOptions()
    detector: DetectorChoice = DetectorParameters()
    imu: ImuParameters = ImuParameters()
    approach: ApproachParameters = ApproachParameters()
    altimeter: Altimeter = RadarParameters()
    attitude_source: Annotated[
        OwnAttitudeSource | None, Field(description="an own instrument in place of navigation's attitudes at pictures")
    ] = None
    clock: Annotated[ClockParameters, Field(description="of the pictures' time tags")] = ClockParameters(
        offset_sd_s=0.001, jitter_sd_s=0.0005
    )
    landing: LandingParameters = LandingParameters()
    render: RenderParameters = Field(default_factory=RenderParameters)

    @field_validator("site")
    @classmethod
    def _site_has_a_terrain(cls, name: str | None) -> str | None:
        if name is not None and name not in descent_sites():
            raise ValueError(f"no site for a descent is called '{name}'; allowed: {', '.join(descent_sites())}")
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
        if not isinstance(stated, Mapping) or stated.get("site") not in descent_sites():
            return stated
        changes = stated.get("terrain", {})
        if not isinstance(changes, Mapping):
            return stated
        of_site = site(stated["site"]).terrain("descent").model_dump()
        return {"terrain_site": stated["site"], **stated, "terrain": _merged(of_site, changes)}

    @model_validator(mode="after")
    def _terrain_is_the_sites(self) -> DescentScenarioParameters:
        """A terrain that was completed for one site must not be lit as another's."""
        if self.terrain_site != self.site:
            raise ValueError(f"site is {self.site}, but the terrain is of {self.terrain_site}; a site is not dispersed")
        return self

    @model_validator(mode="after")
    def _pictures_can_be_binned(self) -> DescentScenarioParameters:
        """By the detector's rows, and for the room that DIMES has, which every case tells."""
        camera: CameraParameters | OwnCamera = self.camera if self.camera.model is None else self.camera.model
        columns, rows = camera.columns, camera.rows
        if rows % self.detector.rows_summed:
            raise ValueError(
                f"detector.rows_summed {self.detector.rows_summed} does not divide the camera's {rows} rows"
            )
        check_binning(self.dimes.binned_size, (columns, rows // self.detector.rows_summed))
        return self

    @model_validator(mode="after")
    def _three_are_among_the_pictures(self) -> DescentScenarioParameters:
        if self.triple is not None and not 1 <= self.triple[0] < self.triple[1] < self.triple[2] <= self.pictures:
            raise ValueError(f"triple is {list(self.triple)}; allowed: three in ascending order, 1 to {self.pictures}")
        if self.pictures < PICTURES:
            of_three = [spec for spec in self.algorithms if VELOCITY.takes_stream(spec) is False]
            if of_three:
                raise ValueError(
                    f"pictures is {self.pictures}, but '{of_three[0]}' takes {PICTURES}; allowed: {PICTURES} to 100"
                )
        struck = max(self.faults.repeated_picture, self.faults.black_picture)
        if struck > self.pictures:
            raise ValueError(f"a fault strikes picture {struck}, but pictures is {self.pictures}")
        return self

    @model_validator(mode="after")
    def _flight_is_over_the_ground(self) -> DescentScenarioParameters:
        if isinstance(self.flight, FlightFile):
            self.flight.check(faulty_times(self.faults, self.picture_times_s))
        return self

    @property
    def picture_times_s(self) -> list[float]:
        """When pictures should be taken, s after the first."""
        return [number * self.descent.interval_s for number in range(self.pictures)]

    @property
    def triple_places(self) -> tuple[int, int, int] | None:
        """Places, from 0, of the three pictures that estimators of three get; None where fewer are taken."""
        if self.triple is not None:
            first, second, third = (number - 1 for number in self.triple)
            return first, second, third
        if self.pictures < PICTURES:
            return None
        last, apart = self.pictures - 1, (self.pictures - 1) // 2
        return last - 2 * apart, last - apart, last

    @property
    def preset(self) -> Site | None:
        """The site; None for a plain terrain."""
        return None if self.site is None else site(self.site)


def check_binning(binned: tuple[int, int], delivered: tuple[int, int]) -> None:
    """Raises ValueError where DIMES cannot bin a delivered picture (columns, rows) to a size."""
    if delivered[0] % binned[0] or delivered[1] % binned[1]:
        raise ValueError(
            f"dimes.binned_size {list(binned)} does not divide the delivered picture of {delivered[0]} x "
            f"{delivered[1]} pixels; allowed: sizes that do, such as {list(binned_size_for(*delivered))}"
        )


def binned_size_for(columns: int, rows: int) -> tuple[int, int]:
    """The size to which DIMES may bin a delivered picture: square blocks that leave about 256 columns, or no fewer."""
    factors = [f for f in range(1, max(columns // 256, 1) + 1) if columns % f == 0 and rows % f == 0]
    return columns // factors[-1], rows // factors[-1]


def descent_sites() -> list[str]:
    """Names of the sites that have a terrain for descents."""
    return [name for name, one in sites().items() if one.descent is not None]


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables with some of their values changed."""
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return merged
