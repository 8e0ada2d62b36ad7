"""Detector datasheets: TOML files with the manufacturer's values and the lens before the detector.

    name = "Sony IMX265, 16 mm f/4"
    pixel_pitch_um = 3.45
    full_well_e = 10500
    read_noise_e = 2.4
    bits = 12
    quantum_efficiency = 0.65           # mean over the band; or a table of wavelength_nm and efficiency
    dark_current_e_s = 1.0              # of a pixel at dark_temperature_c
    dark_temperature_c = 20.0
    prnu = 0.005
    rows = 1536
    readout_s = 0.05                    # of a whole frame

    [lens]
    f_number = 4.0
    band_nm = [420.0, 680.0]

The values are those of EMVA 1288: saturation capacity, temporal dark noise, quantum efficiency, dark current, photo
response non-uniformity.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from marsyard.sim.files import open_regular
from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.sensor.detector import DetectorParameters
from marsyard.sim.sensor.optics import LENS_TRANSMISSION, LightPath, OpticsParameters, bright_exposure_s

#: Maximum size of a datasheet.
_MAX_BYTES = 1 << 20


class QuantumEfficiency(Parameters):
    """Electrons per photon by wavelength, linear between the points and zero outside."""

    wavelength_nm: Annotated[tuple[float, ...], Field(min_length=2)]
    efficiency: Annotated[tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check_curve(self) -> QuantumEfficiency:
        if len(self.wavelength_nm) != len(self.efficiency):
            raise ValueError(
                f"{len(self.wavelength_nm)} wavelengths and {len(self.efficiency)} efficiencies; as many of each"
            )
        if any(later <= sooner for sooner, later in zip(self.wavelength_nm, self.wavelength_nm[1:], strict=False)):
            raise ValueError("wavelength_nm must increase")
        return self


class Lens(Parameters):
    """The lens before the detector."""

    f_number: Annotated[float, Field(gt=0.0, le=100.0)]
    band_nm: Annotated[tuple[Positive, Positive], Field(description="first and last wavelength of the passband")]
    transmission: Annotated[float, Field(gt=0.0, le=1.0, description="of the lens and its filters")] = LENS_TRANSMISSION

    @model_validator(mode="after")
    def _check_band(self) -> Lens:
        if not 200.0 <= self.band_nm[0] < self.band_nm[1] <= 2500.0:
            raise ValueError(f"band_nm is {list(self.band_nm)}; allowed: two increasing wavelengths, 200 to 2500 nm")
        return self


class Datasheet(Parameters):
    """The values of a detector's datasheet."""

    name: str = ""
    pixel_pitch_um: Annotated[float, Field(gt=0.1, le=100.0)]
    full_well_e: Annotated[Positive, Field(description="saturation capacity, electrons")]
    read_noise_e: Annotated[NonNegative, Field(description="temporal dark noise, electrons")]
    bits: Annotated[int, Field(ge=8, le=16)]
    gain_e_dn: Annotated[
        Positive | None, Field(description="electrons per count; default: the full well fills the counts")
    ] = None
    black_level_dn: NonNegative = 0.0
    quantum_efficiency: Annotated[float, Field(gt=0.0, le=1.0)] | QuantumEfficiency
    dark_current_e_s: Annotated[NonNegative, Field(description="of a pixel at dark_temperature_c, electrons per s")]
    dark_temperature_c: Annotated[float, Field(ge=-150.0, le=100.0)]
    dark_doubling_c: Annotated[float, Field(gt=0.0, le=50.0)] = 6.0
    temperature_c: Annotated[
        float | None, Field(ge=-150.0, le=80.0, description="in operation; default: dark_temperature_c")
    ] = None
    prnu: Annotated[float, Field(ge=0.0, le=0.1, description="RMS of the pixels' relative response")] = 0.01
    shutter: Annotated[Literal["global", "frame-transfer"], Field(description="no rolling shutter")] = "global"
    transfer_row_s: Annotated[NonNegative, Field(description="frame transfer: time under each row")] = 0.0
    rows: Annotated[int, Field(ge=16, le=16384, description="rows of a frame")]
    readout_s: Annotated[NonNegative, Field(description="to read out a frame, s")]
    exposure_s: Annotated[
        float | None, Field(gt=0.0, le=10.0, description="default: 60 % of the full well at radiance factor 0.3")
    ] = None
    sun_au: Annotated[float, Field(gt=0.1, le=100.0, description="distance of the sun in use; sets exposure_s")] = 1.5
    lens: Lens

    @model_validator(mode="after")
    def _check_shutter(self) -> Datasheet:
        if (self.shutter == "frame-transfer") != (self.transfer_row_s > 0.0):
            raise ValueError("transfer_row_s belongs to the shutter 'frame-transfer', which needs it above 0")
        return self

    def light(self) -> LightPath:
        """Create the light path from the sun to electrons."""
        efficiency, band = self.quantum_efficiency, self.lens.band_nm
        curve = (
            (band, (efficiency, efficiency))
            if isinstance(efficiency, float)
            else (efficiency.wavelength_nm, efficiency.efficiency)
        )
        f_number, transmission = self.lens.f_number, self.lens.transmission
        return LightPath(f_number, self.pixel_pitch_um, band, transmission=transmission, quantum_efficiency=curve)

    def parameters(self) -> DetectorParameters:
        """Create the parameters of the simulated detector, which reads every pixel."""
        light = self.light()
        responsivity = light.responsivity_e_s(self.sun_au)
        return DetectorParameters(
            exposure_s=self.exposure_s or bright_exposure_s(self.full_well_e, responsivity),
            responsivity_e_s=responsivity,
            sun_au=self.sun_au,
            rows_summed=1,
            transfer_row_s=self.transfer_row_s,
            clear_row_s=0.0,
            readout_row_s=self.readout_s / self.rows,
            full_well_e=self.full_well_e,
            gain_e_dn=self.full_well_e / 2**self.bits if self.gain_e_dn is None else self.gain_e_dn,
            read_noise_e=self.read_noise_e,
            offset_dn=self.black_level_dn,
            bits=self.bits,
            temperature_c=self.dark_temperature_c if self.temperature_c is None else self.temperature_c,
            dark_e_s=self.dark_current_e_s * 2.0 ** (-self.dark_temperature_c / self.dark_doubling_c),
            dark_doubling_c=self.dark_doubling_c,
            response_spread=self.prnu,
            optics=OpticsParameters(diffraction_px=light.diffraction_px()),
        )


def read_datasheet(path: str | Path) -> Datasheet:
    """Read a datasheet from a TOML file.

    Raises ValueError if it cannot be read, is not TOML, or a value is missing or wrong; it names file and field.
    """
    try:
        with open_regular(path) as file:
            contents = file.read(_MAX_BYTES + 1)
    except OSError as fault:
        raise ValueError(f"{path}: cannot be read ({fault.strerror})") from fault
    if len(contents) > _MAX_BYTES:
        raise ValueError(f"{path}: larger than {_MAX_BYTES >> 20} MiB; a datasheet in TOML is needed")
    try:
        stated: dict[str, Any] = tomllib.loads(contents.decode("utf-8"))
    except ValueError as fault:
        raise ValueError(f"{path}: not valid TOML ({fault})") from fault
    try:
        return Datasheet.model_validate(stated)
    except ValidationError as fault:
        first = fault.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "datasheet"
        raise ValueError(f"{path}: {where}: {first['msg'].removeprefix('Value error, ')}") from fault
