"""Parameters of an image detector."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor.defects import BurstParameters, DefectParameters
from marsyard.sim.sensor.optics import OpticsParameters


class DetectorParameters(Parameters):
    """An image detector without shutter. The defaults are those of the MER descent camera as flown.

    Full well, gain, read noise and readout rate: Maki et al. 2003. Responsivity and dark current are calibrations (see
    `marsyard.sim.sensor.radiometry`). How fast the detector is cleared is assumed.
    """

    exposure_s: Annotated[float, Field(gt=0.0, le=10.0, description="exposure time, s")] = 0.004
    responsivity_e_s: Annotated[
        float, Field(gt=0.0, description="electrons per second in a pixel on axis at radiance factor 1")
    ] = 1.019e7
    sun_au: Annotated[
        float, Field(gt=0.1, le=100.0, description="distance from the sun for which that responsivity is stated, AU")
    ] = 1.5
    rows_summed: Annotated[int, Field(ge=1, le=16, description="rows summed on the chip")] = 4
    transfer_row_s: Annotated[NonNegative, Field(description="time under each row during the transfer, s")] = 5.0e-6
    clear_row_s: Annotated[NonNegative, Field(description="time under each row during the clearing, s")] = 1.0e-6
    readout_row_s: Annotated[NonNegative, Field(description="time to read out a delivered row, s")] = 5.3e-3
    full_well_e: Annotated[float, Field(gt=0.0, description="full well, electrons")] = 170000.0
    gain_e_dn: Annotated[float, Field(gt=0.0, description="electrons per count")] = 41.5
    read_noise_e: Annotated[NonNegative, Field(description="read noise, electrons")] = 25.0
    offset_dn: Annotated[NonNegative, Field(description="counts without light")] = 20.0
    bits: Annotated[int, Field(ge=8, le=16, description="bits of a count")] = 12
    temperature_c: Annotated[float, Field(ge=-150.0, le=80.0, description="temperature of the detector, deg C")] = -34.0
    dark_e_s: Annotated[NonNegative, Field(description="dark current of a pixel at 0 deg C, electrons per second")] = (
        159.0
    )
    dark_doubling_c: Annotated[
        float, Field(gt=0.0, le=50.0, description="rise of temperature that doubles the dark current, deg C")
    ] = 6.0
    response_spread: Annotated[float, Field(ge=0.0, le=0.1, description="RMS of the pixels' relative response")] = 0.01
    calibration_error: Annotated[
        float, Field(ge=0.0, le=0.1, description="RMS error of the calibrated relative response")
    ] = 0.002
    companded: Annotated[bool, Field(description="send counts as 8-bit square roots and expand them again")] = False
    optics: OpticsParameters = OpticsParameters()
    defects: DefectParameters = DefectParameters()
    bursts: BurstParameters = BurstParameters()
    file: Annotated[str | None, Field(description="datasheet that the values were read from")] = None

    def input_files(self) -> tuple[str, ...]:
        """The datasheet that the values were read from."""
        return () if self.file is None else (self.file,)

    @property
    def sunlight(self) -> float:
        """Sunlight, over that at 1 AU, for which the responsivity is stated."""
        return 1.0 / self.sun_au**2

    @property
    def full_scale_dn(self) -> int:
        """The largest count."""
        return int(2**self.bits - 1)

    @property
    def dark_growth(self) -> float:
        """Dark current over that at 0 deg C."""
        return float(2.0 ** (self.temperature_c / self.dark_doubling_c))
