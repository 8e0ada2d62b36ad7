"""Parameters of a synthetic terrain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, get_args

from pydantic import BaseModel, Field, ValidationError, field_validator

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field, merge_parameters
from marsyard.sim.terrain.landforms import Drifts, Dunes, Fans, Gullies, Lava, Outcrop, Playa, Ramp, Strata, Swell
from marsyard.sim.terrain.landforms.units import SurfaceUnits
from marsyard.sim.terrain.rasters import RealTerrain
from marsyard.sim.terrain.rocks.field import RockParameters


class TerrainParameters(Parameters):
    """A synthetic terrain: fractal ground, craters and optional landforms. Lengths in metres."""

    samples: Annotated[int, Field(ge=64, le=8192, description="samples along each side, a power of two")] = 4096
    spacing_m: Annotated[float, Field(gt=0.0, le=100.0, description="distance between samples, m")] = 1.5
    hurst: Annotated[float, Field(gt=0.0, lt=1.0, description="Hurst exponent of the fractal ground's heights")] = 0.8
    rms_slope_deg: Annotated[
        float, bounded_field(0.0, 30.0, "RMS slope of the fractal ground over its baseline, without landforms, deg")
    ] = 2.0
    slope_baseline_m: Annotated[Positive, Field(description="baseline of the RMS slope, m")] = 30.0
    outer_scale_m: Annotated[Positive, Field(description="wavelength above which relief stops growing, m")] = 3000.0
    craters_per_km2: Annotated[float, bounded_field(0.0, 2.0e6, "craters above the smallest diameter per km2")] = 60.0
    crater_exponent: Annotated[Positive, Field(description="exponent of the cumulative size-frequency power law")] = 2.0
    crater_knee_m: Annotated[Positive, Field(description="diameter above which crater_steep_exponent applies, m")] = 1e4
    crater_steep_exponent: Annotated[Positive, Field(description="exponent of the power law above crater_knee_m")] = 3.2
    crater_floor_contrast: Annotated[
        Fraction, Field(description="SD of the log albedo of crater floors without sand relative to the ground")
    ] = 0.0
    crater_sand_fraction: Annotated[Fraction, Field(description="fraction of the craters with sand in them")] = 0.0
    crater_sand_log_albedo: Annotated[
        float, bounded_field(-2.0, 1.0, "mean logarithm of the albedo of this sand divided by the ground's")
    ] = -0.4
    craters_wear_albedo: Annotated[
        bool,
        Field(description="whether sand and ejecta fade as craters wear, and half of the craters below 30 m cluster"),
    ] = False
    crater_diameter_min_m: Annotated[Positive, Field(description="smallest crater diameter, m")] = 12.0
    crater_diameter_max_m: Annotated[Positive, Field(description="largest crater diameter, m")] = 600.0
    crater_ejecta_contrast: Annotated[
        Fraction, Field(description="mean size of the log albedo of ejecta relative to the ground; most are brighter")
    ] = 0.03
    albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="mean albedo")] = 0.2
    albedo_contrast: Annotated[
        Fraction, Field(description="SD of the logarithm of the fractal albedo, over all scales")
    ] = 0.12
    contrast_spread: Annotated[
        NonNegative, Field(description="SD of the logarithm of albedo_contrast between terrains")
    ] = 0.0
    albedo_hurst: Annotated[
        float,
        Field(ge=-0.5, lt=1.0, description="Hurst exponent of the fractal albedo; 0: equal variance in all octaves"),
    ] = 0.0
    albedo_follows_relief: Annotated[
        bool, Field(description="whether sand darkens the hollows of the fractal relief, and leaves its crests bright")
    ] = False
    relief_log_albedo: Annotated[
        float,
        bounded_field(-1.0, 1.0, "log albedo of fine relief above sand-filled hollows, per mean height; 0: unfilled"),
    ] = 0.0
    units: Annotated[SurfaceUnits | None, Field(description="surface units; None: uniform ground")] = None
    fine_below_m: Annotated[
        Positive, Field(description="wavelength below which surface units scale relief and albedo contrast, m")
    ] = 60.0
    playa: Annotated[Playa | None, Field(description="desiccation polygons")] = None
    fans: Annotated[Fans | None, Field(description="alluvial fans around a playa")] = None
    lava: Annotated[Lava | None, Field(description="pahoehoe flows and a'a")] = None
    dunes: Annotated[Dunes | None, Field(description="transverse dunes")] = None
    ripples: Annotated[Dunes | None, Field(description="ripples, as small dunes")] = None
    swell: Annotated[Swell | None, Field(description="relief of a few waves about as long as the terrain")] = None
    ramp: Annotated[Ramp | None, Field(description="a slope of constant angle")] = None
    strata: Annotated[Strata | None, Field(description="layers with scarps")] = None
    outcrop: Annotated[Outcrop | None, Field(description="patches of bedrock")] = None
    gullies: Annotated[Gullies | None, Field(description="steep-walled gullies")] = None
    drifts: Annotated[Drifts | None, Field(description="sand in the lee of relief and in craters")] = None
    source: Annotated[RealTerrain | None, Field(description="real terrain; the synthetic terrain surrounds it")] = None
    rocks: Annotated[RockParameters | None, Field(description="rocks on the ground")] = None

    @field_validator("samples")
    @classmethod
    def _check_power_of_two(cls, samples: int) -> int:
        if samples & (samples - 1):
            raise ValueError(f"{samples} is not a power of two")
        return samples

    def with_changes(self, changes: Mapping[str, Any]) -> TerrainParameters:
        """Return a copy with changes, validated.

        Changes are nested as in a file: ``{"samples": 2048, "rocks": {"abundance": 0.1}}`` keeps all other values of
        the rocks. None removes a landform, the rocks or a source. A new landform has its default values. Raises
        ValueError; the message contains the first invalid parameter.
        """
        _check_names(TerrainParameters, changes, "")
        try:
            return TerrainParameters.model_validate(merge_parameters(self.model_dump(), changes))
        except ValidationError as error:
            first = error.errors()[0]
            location = ".".join(str(part) for part in first["loc"])
            raise ValueError(f"terrain.{location}: {first['msg']}; given: {first['input']!r}") from None


def _check_names(model: type[BaseModel], changes: Mapping[str, Any], prefix: str) -> None:
    """Raise ValueError for the first unknown name; the message contains the allowed names."""
    for name, value in changes.items():
        if name not in model.model_fields:
            allowed = ", ".join(model.model_fields)
            raise ValueError(f"terrain{prefix} has no parameter '{name}'; allowed: {allowed}")
        if isinstance(value, Mapping):
            for alternative in get_args(model.model_fields[name].annotation):
                if isinstance(alternative, type) and issubclass(alternative, BaseModel):
                    _check_names(alternative, value, f"{prefix}.{name}")
