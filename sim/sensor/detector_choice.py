"""Detector of a campaign: its values, or changes to those of a camera preset or of a datasheet.

Datasheets are TOML files with values of the manufacturer (those of EMVA 1288: saturation capacity, temporal dark noise,
quantum efficiency, dark current, photo response non-uniformity) and of the lens in front of the detector.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from marsyard.sim.files import open_regular
from marsyard.sim.parameters import NonNegative, Parameters, Positive, merge_parameters
from marsyard.sim.sensor.detector import DetectorParameters
from marsyard.sim.sensor.optics import OpticsParameters
from marsyard.sim.sensor.presets import preset
from marsyard.sim.sensor.radiometry import LENS_TRANSMISSION, LightPath, bright_exposure_s

_MAX_BYTES = 1 << 20  #: Maximum size of a datasheet.


class QuantumEfficiency(Parameters):
    """Electrons per photon by wavelength, interpolated linearly, zero outside."""

    wavelength_nm: Annotated[tuple[float, ...], Field(min_length=2)]
    efficiency: Annotated[tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check_curve(self) -> QuantumEfficiency:
        if len(self.wavelength_nm) != len(self.efficiency):
            counts = f"{len(self.wavelength_nm)} wavelengths and {len(self.efficiency)} efficiencies"
            raise ValueError(f"{counts}; both lists must have the same length")
        if np.any(np.diff(self.wavelength_nm) <= 0.0):
            raise ValueError("wavelength_nm must increase")
        return self


class Lens(Parameters):
    """The lens in front of the detector."""

    f_number: Annotated[float, Field(gt=0.0, le=100.0)]
    band_nm: Annotated[tuple[Positive, Positive], Field(description="first and last wavelength of the passband")]
    transmission: Annotated[float, Field(gt=0.0, le=1.0, description="lens and filters")] = LENS_TRANSMISSION

    @model_validator(mode="after")
    def _check_band(self) -> Lens:
        if not 200.0 <= self.band_nm[0] < self.band_nm[1] <= 2500.0:
            raise ValueError(f"band_nm is {list(self.band_nm)}; allowed: two increasing wavelengths, 200 to 2500 nm")
        return self


class Datasheet(Parameters):
    """Values of a detector's datasheet and of its lens; they define `DetectorParameters`."""

    name: str = ""
    pixel_pitch_um: Annotated[float, Field(gt=0.1, le=100.0)]
    full_well_e: Annotated[Positive, Field(description="saturation capacity, electrons")]
    read_noise_e: Annotated[NonNegative, Field(description="temporal dark noise, electrons")]
    bits: Annotated[int, Field(ge=8, le=16)]
    gain_e_dn: Annotated[Positive | None, Field(description="electrons per count; default: full well / 2^bits")] = None
    black_level_dn: NonNegative = 0.0
    quantum_efficiency: Annotated[float, Field(gt=0.0, le=1.0)] | QuantumEfficiency
    dark_current_e_s: Annotated[NonNegative, Field(description="per pixel at dark_temperature_c, electrons/s")]
    dark_temperature_c: Annotated[float, Field(ge=-150.0, le=100.0)]
    dark_doubling_c: Annotated[float, Field(gt=0.0, le=50.0)] = 6.0
    temperature_c: Annotated[float | None, Field(ge=-150.0, le=80.0, description="default: dark_temperature_c")] = None
    prnu: Annotated[float, Field(ge=0.0, le=0.1, description="RMS of the relative pixel response")] = 0.01
    shutter: Annotated[Literal["global", "frame-transfer"], Field(description="rolling is not supported")] = "global"
    transfer_row_s: Annotated[NonNegative, Field(description="frame transfer: shift time per row")] = 0.0
    rows: Annotated[int, Field(ge=16, le=16384, description="rows of a frame")]
    readout_s: Annotated[NonNegative, Field(description="readout time of a frame, s")]
    exposure_s: Annotated[float | None, Field(gt=0.0, le=10.0, description="default: 60 % of full well at I/F 0.3")] = (
        None
    )
    sun_au: Annotated[float, Field(gt=0.1, le=100.0, description="distance from the sun; sets exposure_s")] = 1.5
    lens: Lens

    @model_validator(mode="after")
    def _check_shutter(self) -> Datasheet:
        if (self.shutter == "frame-transfer") != (self.transfer_row_s > 0.0):
            raise ValueError("transfer_row_s must be above 0 for the shutter 'frame-transfer', and 0 otherwise")
        return self

    def light(self) -> LightPath:
        """Create the light path from the sun to electrons."""
        q, lens = self.quantum_efficiency, self.lens
        curve = (lens.band_nm, (q, q)) if isinstance(q, float) else (q.wavelength_nm, q.efficiency)
        return LightPath(
            f_number=lens.f_number,
            pixel_pitch_um=self.pixel_pitch_um,
            band_nm=lens.band_nm,
            transmission=lens.transmission,
            quantum_efficiency=curve,
        )

    def parameters(self) -> DetectorParameters:
        """Create the parameters of the simulated detector, which reads out all pixels."""
        light = self.light()
        responsivity = light.responsivity_e_s(self.sun_au)
        common_fields = {"sun_au", "transfer_row_s", "full_well_e", "read_noise_e", "bits", "dark_doubling_c"}
        return DetectorParameters(
            **self.model_dump(include=common_fields),
            exposure_s=self.exposure_s or bright_exposure_s(self.full_well_e, responsivity),
            responsivity_e_s=responsivity,
            rows_summed=1,
            clear_row_s=0.0,
            readout_row_s=self.readout_s / self.rows,
            gain_e_dn=self.full_well_e / 2**self.bits if self.gain_e_dn is None else self.gain_e_dn,
            offset_dn=self.black_level_dn,
            temperature_c=self.dark_temperature_c if self.temperature_c is None else self.temperature_c,
            dark_e_s=self.dark_current_e_s * 2.0 ** (-self.dark_temperature_c / self.dark_doubling_c),
            response_spread=self.prnu,
            optics=OpticsParameters(diffraction_px=light.diffraction_px()),
        )


def read_datasheet(path: str | Path) -> Datasheet:
    """Read a datasheet from a TOML file; raises ValueError with file and field if it cannot be read or is not valid."""
    try:
        with open_regular(path) as file:
            contents = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    if len(contents) > _MAX_BYTES:
        raise ValueError(f"{path}: larger than {_MAX_BYTES >> 20} MiB; expected a datasheet in TOML")
    try:
        values: dict[str, Any] = tomllib.loads(contents.decode("utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not valid TOML ({error})") from error
    try:
        return Datasheet.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "datasheet"
        raise ValueError(f"{path}: {key}: {first['msg'].removeprefix('Value error, ')}") from error


def _resolve_detector(values: object) -> object:
    """Merge values with those of the selected preset or datasheet, if there is one."""
    if isinstance(values, str):
        values = {"file": values} if values.endswith(".toml") else {"preset": values}
    if not isinstance(values, Mapping) or all(values.get(key) is None for key in ("preset", "file")):
        return values
    if set(DetectorParameters.model_fields) <= set(values):  # already resolved: values stored with a campaign
        return values
    if {"preset", "file"} <= set(values):
        raise ValueError("a detector is defined by a preset or by a datasheet file, not both")
    changes = {key: value for key, value in values.items() if key not in ("preset", "file")}
    if "file" in values:
        file = str(values["file"])
        return merge_parameters({**read_datasheet(file).parameters().model_dump(), "file": file}, changes)
    return merge_parameters(preset(str(values["preset"])).detector.model_dump(), changes)


#: Detector parameters of a campaign, defined by values or by changes to a preset or datasheet:
#: ``[parameters.detector]`` with ``preset = "mer-descent-field"`` and, for example, ``temperature_c = 23.0``; or
#: ``file = "sensor.toml"``.
DetectorChoice = Annotated[DetectorParameters, BeforeValidator(_resolve_detector)]
