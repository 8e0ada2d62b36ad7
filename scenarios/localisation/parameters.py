"""Parameters of the localisation scenario, of its map, and of the times of its images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.case_faults import Haze, SizedFaults
from marsyard.scenarios.localisation import instruments
from marsyard.scenarios.localisation.camera import LANDER_DETECTOR, LanderCameraParameters
from marsyard.scenarios.localisation.flight import ProfileParameters
from marsyard.scenarios.localisation.initial_state import InitialErrors
from marsyard.scenarios.localisation.instruments import INERTIAL_MARGIN_S
from marsyard.scenarios.localisation.sites import check_imported_terrain, localisation_site
from marsyard.scenarios.localisation.task import LOCALISATION
from marsyard.scenarios.site_parameters import DustOpacity, Location, RenderParameters, SunParameters, complete_terrain
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.sensor import ClockParameters, DetectorParameters, ImuParameters, RadarParameters
from marsyard.sim.sensor.imu import IMUS, ImuClass
from marsyard.sim.terrain import PhotometryChanges, Site, TerrainParameters

REGISTRATION = ErrorSource("map-registration", "map: position as a whole")
DISTORTION = ErrorSource("map-distortion", "map: distortion")
ELEVATION = ErrorSource("map-elevation", "map: elevation")


class MapParameters(Parameters):
    """A map from images of the Context Camera (CTX) on an orbiter; the defaults follow the map of Mars 2020.

    The Lander Vision System used orthorectified CTX images of 6 m a pixel and elevations from CTX stereo images
    (Fergason et al. 2020, doi:10.5066/P906QQT8). CTX: 20 microradians a pixel, 6 m from 300 km (Malin et al. 2007).
    """

    pixel_m: Annotated[Positive, Field(description="size of a map pixel, m")] = 6.0
    side_px: Annotated[int, Field(ge=16, le=4096, description="rows, and columns, of the map")] = 2048
    sun_azimuth_deg: Annotated[
        float, bounded_field(0.0, 360.0, "azimuth of the sun in the orbital images, clockwise from north (15 h)")
    ] = 275.0
    sun_elevation_deg: Annotated[
        float, bounded_field(5.0, 90.0, "elevation of the sun in the orbital images (15 h local time)")
    ] = 40.0
    optical_depth: Annotated[
        float | None, Field(ge=0.0, le=10.0, description="optical depth in the orbital images; None: as at the landing")
    ] = None
    orbit_height_m: Annotated[
        float, bounded_field(1e5, 1e6, "height of the orbiter above the ground, above the map's centre, m")
    ] = 3.0e5
    signal_to_noise: Annotated[
        Positive, Field(description="mean signal divided by the SD of noise per map pixel; assumed")
    ] = 100.0
    aperture_px: Annotated[
        float, bounded_field(0.1, 1.0, "width of the ground that a detector element averages, map pixels; assumed")
    ] = 0.8
    nyquist_mtf: Annotated[
        float,
        bounded_field(
            0.01, 1.0, "MTF of optics, motion and processing, without aperture, at one cycle per two pixels; assumed"
        ),
    ] = 0.33
    bits: Annotated[int | None, Field(ge=6, le=16, description="bits of a pixel; None: not quantised")] = 8
    registration_sd_m: Annotated[
        NonNegative,
        REGISTRATION,
        Field(description="SD of the shift of the whole map, per axis, m; assumed: up to 150 m is 3 SD"),
    ] = 50.0
    distortion_sd_m: Annotated[
        NonNegative, DISTORTION, Field(description="SD of the distortion, per axis, m; assumed: one pixel")
    ] = 6.0
    distortion_length_m: Annotated[Positive, Field(description="correlation length of the distortion, m; assumed")] = (
        1500.0
    )
    elevation_sd_m: Annotated[NonNegative, ELEVATION, Field(description="SD of the elevation error, m; assumed")] = 5.0
    elevation_length_m: Annotated[
        Positive, Field(description="correlation length of the elevation error, m; assumed")
    ] = 300.0
    elevation_post_m: Annotated[
        NonNegative, Field(description="distance of the elevation model's posts, m; assumed; 0: exact in each pixel")
    ] = 20.0


class ImageSchedule(Parameters):
    """Times of the images: those of the coarse stage first (0.3 Hz, Mars 2020), then those of the fine stage.

    Mars 2020 took up to one image per second in the fine stage; the default of 0.5 Hz is assumed.
    """

    first_s: Annotated[float, bounded_field(INERTIAL_MARGIN_S, 60.0, "first image, after the start")] = 0.5
    coarse_images: Annotated[int, Field(ge=0, le=100, description="images of the coarse stage")] = 3
    coarse_interval_s: Annotated[float, bounded_field(0.1, 60.0, "time after each image of the coarse stage")] = 3.3
    interval_s: Annotated[float, bounded_field(0.1, 60.0, "time between images of the fine stage")] = 2.0

    def times(self, start_s: float, end_s: float) -> Float64[np.ndarray, "images"]:
        """Compute the nominal times of the images from start to end (included)."""
        first, coarse = start_s + self.first_s, self.coarse_interval_s * np.arange(self.coarse_images + 1)
        count = max(int((end_s - first - coarse[-1]) / self.interval_s) + 1, 0)
        times = np.concatenate([first + coarse[:-1], first + coarse[-1] + self.interval_s * np.arange(count)])
        return np.asarray(times[times <= end_s])


#: Faults of instruments, which `exact_instruments` removes.
_INSTRUMENT_FAULTS = ("altitude_error", "attitude_error_deg")


class LocalisationFaults(SizedFaults):
    """Faults of a descent with localisation."""

    heat_shield_deg: Annotated[
        NonNegative, Field(le=60.0, description="angular diameter of the falling heat shield in the first image")
    ] = 0.0
    haze: Haze = 0.0
    lost_images: Annotated[NonNegative, Field(le=1.0, description="fraction of images that is not delivered")] = 0.0
    black_image: Annotated[int, bounded_field(0, 100, "image that is delivered black, from 1; 0: none")] = 0
    altitude_error: Annotated[NonNegative, Field(le=0.9, description="relative excess of all altitudes")] = 0.0
    attitude_error_deg: Annotated[
        NonNegative, Field(le=30.0, description="additional tilt error of the initial attitude")
    ] = 0.0
    wrong_map: Annotated[int, bounded_field(0, 1, "1: the map shows another terrain of the same site")] = 0


class LocalisationScenarioParameters(AlgorithmSelection):
    """Parameters of a localisation campaign.

    `location` is the terrain and the centre of the map; the descent begins at `start_east_m`, `start_north_m` from it.
    Keys of the table `terrain` override the terrain of the site. With `terrain.source`, the middle of the terrain is a
    DTM and an orthoimage from files.
    """

    task = LOCALISATION

    site: Annotated[str, Field(description="preset of terrain, light and gravity")] = "crater-floor"
    terrain_site: Annotated[str, Field(description="site of the terrain; set automatically from `site`")] = (
        "crater-floor"
    )
    location: Location = Location()
    terrain: CheckedTerrain
    start_east_m: Annotated[float, bounded_field(-3000.0, 3000.0, "start, east of the map's centre")] = 0.0
    start_north_m: Annotated[float, bounded_field(-3000.0, 3000.0, "start, north of the map's centre")] = 0.0
    sun: Annotated[SunParameters, Field(description="sun at the landing")] = SunParameters()
    dust_opacity: DustOpacity = None
    photometry: PhotometryChanges = PhotometryChanges()
    map: MapParameters = MapParameters()
    flight: ProfileParameters = ProfileParameters()
    images: ImageSchedule = ImageSchedule()
    camera: LanderCameraParameters = LanderCameraParameters()
    detector: DetectorParameters = LANDER_DETECTOR
    imu_class: Annotated[ImuClass, Field(description="class of the inertial unit")] = "ln-200"
    initial: InitialErrors = InitialErrors()
    altimeter: RadarParameters = instruments.RADAR
    clock: Annotated[ClockParameters, Field(description="clock of the images' time tags")] = instruments.IMAGE_CLOCK
    exact_instruments: Annotated[
        bool, Field(description="estimators receive exact attitudes, altitudes, times, inertial data and camera")
    ] = False
    faults: LocalisationFaults = LocalisationFaults()
    algorithm: Annotated[str, Field(description="lvs, sift, inertial, or custom")] = "lvs"
    lvs: Annotated[LvsOptions, Field(description="options of the published algorithm")] = LvsOptions()
    render: RenderParameters = Field(default_factory=RenderParameters)

    @model_validator(mode="before")
    @classmethod
    def _complete_terrain(cls, parameters: Any) -> Any:
        def find(name: str, _: Mapping[str, Any]) -> TerrainParameters:
            try:
                return localisation_site(name).terrain("descent")
            except ValueError:
                return TerrainParameters()  # the check of `site` reports the error

        return complete_terrain(parameters, cls.model_fields["site"].default, find)

    @field_validator("site")
    @classmethod
    def _check_site(cls, name: str) -> str:
        localisation_site(name)
        return name

    @model_validator(mode="after")
    def _check_consistency(self) -> LocalisationScenarioParameters:
        if self.terrain_site != self.site:
            raise ValueError(f"site is {self.site}, but terrain is of {self.terrain_site}; `site` cannot be dispersed")
        period_m = self.terrain.samples * self.terrain.spacing_m
        side_m = self.map.side_px * self.map.pixel_m
        if side_m > period_m:
            raise ValueError(
                f"the map of {side_m:.6g} m is larger than the terrain, which repeats after {period_m:.6g} m"
            )
        half_field = 0.5 * np.radians(self.camera.field_deg)
        check_imported_terrain(self.terrain, 2.0 * self.flight.altitude_end_m * float(np.tan(half_field)))
        if self.faults.wrong_map and self.terrain.source is not None:
            raise ValueError(
                "faults.wrong_map needs another terrain; all terrains with terrain.source contain the same DTM"
            )
        ineffective = [name for name in _INSTRUMENT_FAULTS if self.exact_instruments and getattr(self.faults, name)]
        if ineffective:
            raise ValueError(f"faults.{ineffective[0]} has no effect with exact_instruments; allowed: 0")
        instruments.check_clock("clock", self.clock)
        instruments.check_clock("altimeter.clock", self.altimeter.clock)
        if self.faults.wrong_map and self.location.bank < 2:
            raise ValueError("faults.wrong_map needs another terrain; allowed: a location.bank of at least 2")
        return self

    @property
    def site_preset(self) -> Site:
        """The site, with the optical depth of the case."""
        return localisation_site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)

    @property
    def imu(self) -> ImuParameters:
        """Parameters of the inertial unit."""
        return IMUS[self.imu_class]
