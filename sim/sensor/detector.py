"""A frame-transfer CCD: radiance to counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt16
from pydantic import BaseModel, ConfigDict, Field

from sim.camera import CameraModel
from sim.measurements import DetectorCalibration

NonNegative = Annotated[float, Field(ge=0.0)]


class DetectorParameters(BaseModel):
    """A frame-transfer CCD without shutter. The defaults are those of the MER descent camera where they are known.

    Full well, gain and read noise: Maki et al. 2003. Responsivity is a calibration: it gives the paper's
    signal-to-noise ratio of 102 (11,000 electrons in a delivered, row-summed pixel) on the darkest terrain, of albedo
    0.1 at a radiance factor of 0.07. How fast the detector is cleared is assumed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    exposure_s: Annotated[float, Field(gt=0.0, le=10.0, description="exposure time, s")] = 0.004
    responsivity_e_s: Annotated[
        float, Field(gt=0.0, description="electrons per second in a pixel on axis at radiance factor 1")
    ] = 9.8e6
    rows_summed: Annotated[int, Field(ge=1, le=16, description="rows summed on the chip")] = 4
    transfer_row_s: Annotated[NonNegative, Field(description="time under each row during the transfer, s")] = 5.0e-6
    clear_row_s: Annotated[NonNegative, Field(description="time under each row during the clearing, s")] = 1.0e-6
    full_well_e: Annotated[float, Field(gt=0.0, description="full well, electrons")] = 170000.0
    gain_e_dn: Annotated[float, Field(gt=0.0, description="electrons per count")] = 41.5
    read_noise_e: Annotated[NonNegative, Field(description="read noise, electrons")] = 25.0
    offset_dn: Annotated[NonNegative, Field(description="counts without light")] = 20.0
    bits: Annotated[int, Field(ge=8, le=16, description="bits of a count")] = 12
    response_spread: Annotated[float, Field(ge=0.0, le=0.1, description="RMS of the pixels' relative response")] = 0.01
    calibration_error: Annotated[
        float, Field(ge=0.0, le=0.1, description="RMS error of the calibrated relative response")
    ] = 0.002


@dataclass(frozen=True)
class Detector:
    """One detector behind one camera: its response is fixed, its noise is drawn anew for every picture.

    Attributes
    ----------
    parameters
        The detector's parameters.
    response
        Relative response of each physical pixel with the lens's fall-off, shape (rows, columns).
    calibration
        What the ground knows of it.
    """

    parameters: DetectorParameters
    response: Float32[np.ndarray, "rows columns"]
    calibration: DetectorCalibration

    @classmethod
    def drawn(
        cls, fall_off: Float32[np.ndarray, "rows columns"], parameters: DetectorParameters, rng: np.random.Generator
    ) -> Detector:
        """A detector of as many physical pixels behind a lens of this fall-off, its pixels' response drawn."""
        rows, columns = fall_off.shape
        if rows % parameters.rows_summed:
            raise ValueError(f"{rows} rows cannot be summed by {parameters.rows_summed}")
        response = fall_off * (
            1.0 + parameters.response_spread * rng.standard_normal((rows, columns), dtype=np.float32)
        )
        delivered = _sum_rows(response, parameters.rows_summed) / parameters.rows_summed
        known = delivered * (1.0 + parameters.calibration_error * rng.standard_normal(delivered.shape))
        calibration = DetectorCalibration(
            flat_field=known.astype(np.float64),
            exposure_s=parameters.exposure_s,
            transfer_row_s=parameters.transfer_row_s,
            clear_row_s=parameters.clear_row_s,
            rows_summed=parameters.rows_summed,
            offset_dn=parameters.offset_dn,
            full_scale_dn=2**parameters.bits - 1,
        )
        return cls(parameters, response.astype(np.float32), calibration)

    def expose(
        self, radiance: Float32[np.ndarray, "rows columns"], rng: np.random.Generator
    ) -> UInt16[np.ndarray, "delivered_rows columns"]:
        """Counts of one exposure to a still scene of this radiance factor."""
        p = self.parameters
        mean = _sum_rows(self.charge(radiance), p.rows_summed)
        electrons = rng.poisson(mean).astype(np.float32)
        electrons += np.float32(p.read_noise_e) * rng.standard_normal(electrons.shape, dtype=np.float32)
        np.minimum(electrons, np.float32(p.full_well_e), out=electrons)
        counts = np.rint(electrons / np.float32(p.gain_e_dn) + np.float32(p.offset_dn))
        delivered: UInt16[np.ndarray, "delivered_rows columns"] = np.clip(counts, 0, 2**p.bits - 1).astype(np.uint16)
        return delivered

    def charge(self, radiance: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
        """Mean charge in electrons of each physical pixel at the end of the transfer.

        Besides its exposure, a packet collects light from the rows it passes under: before the exposure, while the
        detector is cleared, the rows after its own; after it, on the way to the storage area, the rows before its own.
        """
        p = self.parameters
        rate = radiance * self.response * np.float32(p.responsivity_e_s)
        passed = np.cumsum(rate, axis=0)
        total = passed[-1:]
        charge: Float32[np.ndarray, "rows columns"] = np.float32(p.exposure_s) * rate
        charge += np.float32(p.transfer_row_s) * (passed - rate)
        charge += np.float32(p.clear_row_s) * (total - passed)
        return charge


def natural_fall_off(camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
    """Brightness of each pixel behind an unvignetted lens: the fourth power of the cosine of its field angle."""
    columns, rows = camera.size
    u, v = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    _origins, directions = camera.rays(np.stack([u, v], axis=-1))
    cosine: Float64[np.ndarray, "rows columns"] = directions @ camera.a
    fall_off: Float32[np.ndarray, "rows columns"] = (np.clip(cosine, 0.0, 1.0) ** 4).astype(np.float32)
    return fall_off


def _sum_rows(picture: Float[np.ndarray, "rows columns"], count: int) -> Float[np.ndarray, "summed columns"]:
    rows, columns = picture.shape
    summed: Float[np.ndarray, "summed columns"] = picture.reshape(rows // count, count, columns).sum(axis=1)
    return summed
