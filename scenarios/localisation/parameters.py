"""Parameters of the localisation scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator, model_validator

from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.case_faults import Haze, SizedFaults
from marsyard.scenarios.localisation import instruments
from marsyard.scenarios.localisation.camera import LanderCameraParameters
from marsyard.scenarios.localisation.detector import LANDER_DETECTOR
from marsyard.scenarios.localisation.flight import ProfileParameters
from marsyard.scenarios.localisation.image_schedule import ImageSchedule
from marsyard.scenarios.localisation.imported_terrain import check_imported_terrain
from marsyard.scenarios.localisation.initial_errors import InitialErrors
from marsyard.scenarios.localisation.map_parameters import MapParameters
from marsyard.scenarios.localisation.sites import localisation_site
from marsyard.scenarios.localisation.task import LOCALISATION
from marsyard.scenarios.site_parameters import DustOpacity, Location, RenderParameters, SunParameters, complete_terrain
from marsyard.scenarios.terrain_files import CheckedTerrain
from marsyard.sim.parameters import NonNegative, bounded_field
from marsyard.sim.sensor import ClockParameters, DetectorParameters, ImuParameters, RadarParameters
from marsyard.sim.sensor.imu import IMUS, ImuClass
from marsyard.sim.terrain import PhotometryChanges, Site, TerrainParameters


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
        instruments.check_clock("clock", self.clock)
        instruments.check_clock("altimeter.clock", self.altimeter.clock)
        if self.faults.wrong_map and self.location.bank < 2:
            raise ValueError("faults.wrong_map needs another terrain; allowed: a location.bank of at least 2")
        return self

    @property
    def preset(self) -> Site:
        """The site, with the optical depth of the case."""
        return localisation_site(self.site).with_dust(self.dust_opacity).with_photometry(self.photometry)

    @property
    def imu(self) -> ImuParameters:
        """Parameters of the inertial unit."""
        return IMUS[self.imu_class]
