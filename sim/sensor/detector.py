"""Frame-transfer CCD: radiance to counts, with noise, smear, defects, bursts and 8-bit companding; auto-exposure.

Companding: a step of the square-root table grows with the square root of the count, as shot noise does. The table is

    code = round(a (sqrt(count + b) - sqrt(b))),   a = 2 sqrt(b)

so that the steps begin with one count; b is such that the full scale has code 255. Every code is used. A code is
expanded to the middle of its counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt16
from pydantic import Field, model_validator
from scipy.ndimage import uniform_filter
from scipy.optimize import brentq

from marsyard.sim.measurements import DetectorCalibration
from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive
from marsyard.sim.sensor.motion import ImageMotion, moving_exposure
from marsyard.sim.sensor.optics import OpticsParameters, apply_point_spread, dust_transmission

CODES = 256
_RelativeError = Annotated[float, Field(ge=0.0, le=0.1)]


class DefectParameters(Parameters):
    """Defective pixels; none by default."""

    hot_share: Annotated[Fraction, Field(description="fraction of hot pixels")] = 0.0
    hot_e_s: Annotated[NonNegative, Field(description="mean dark current of a hot pixel at 0 deg C, e/s")] = 20000.0
    dead_share: Annotated[Fraction, Field(description="fraction of pixels without response")] = 0.0
    listed: Annotated[bool, Field(description="whether the camera fills them from neighbours by a list")] = False


class BurstParameters(Parameters):
    """Bursts of noise on the cable during the readout; none by default."""

    bursts: Annotated[NonNegative, Field(le=1e4, description="mean number of bursts in a picture")] = 0.0
    length_px: Annotated[float, Field(gt=0.0, le=1e7, description="mean length of a burst, delivered pixels")] = 2000.0
    amplitude_dn: Annotated[NonNegative, Field(description="RMS of the noise in a burst, counts")] = 300.0


class DetectorParameters(Parameters):
    """An image detector without shutter. Defaults: the MER descent camera as flown.

    Full well, gain, read noise and readout rate: Maki et al. 2003. Responsivity and dark current are calibrated (see
    `marsyard.sim.sensor.optics`). The clearing time is assumed.
    """

    exposure_s: Annotated[float, Field(gt=0.0, le=10.0, description="exposure time, s")] = 0.004
    responsivity_e_s: Annotated[Positive, Field(description="electrons/s on axis at radiance factor 1")] = 1.019e7
    sun_au: Annotated[float, Field(gt=0.1, le=100.0, description="distance of the sun for this responsivity, AU")] = 1.5
    rows_summed: Annotated[int, Field(ge=1, le=16, description="rows summed on the chip")] = 4
    transfer_row_s: Annotated[NonNegative, Field(description="time under each row during the transfer, s")] = 5.0e-6
    clear_row_s: Annotated[NonNegative, Field(description="time under each row during the clearing, s")] = 1.0e-6
    readout_row_s: Annotated[NonNegative, Field(description="time to read out a delivered row, s")] = 5.3e-3
    full_well_e: Annotated[Positive, Field(description="full well, electrons")] = 170000.0
    gain_e_dn: Annotated[Positive, Field(description="electrons per count")] = 41.5
    read_noise_e: Annotated[NonNegative, Field(description="read noise, electrons")] = 25.0
    offset_dn: Annotated[NonNegative, Field(description="counts without light")] = 20.0
    bits: Annotated[int, Field(ge=8, le=16, description="bits of a count")] = 12
    temperature_c: Annotated[float, Field(ge=-150.0, le=80.0, description="temperature of the detector, deg C")] = -34.0
    dark_e_s: Annotated[NonNegative, Field(description="dark current of a pixel at 0 deg C, electrons/s")] = 159.0
    dark_doubling_c: Annotated[float, Field(gt=0.0, le=50.0, description="temperature rise for doubling, deg C")] = 6.0
    response_spread: Annotated[_RelativeError, Field(description="RMS of the pixels' relative response")] = 0.01
    calibration_error: Annotated[_RelativeError, Field(description="RMS error of the calibrated response")] = 0.002
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
        """Sunlight at the stated distance, relative to 1 AU."""
        return 1.0 / self.sun_au**2

    @property
    def full_scale_dn(self) -> int:
        """The largest count."""
        return int(2**self.bits - 1)

    @property
    def dark_growth(self) -> float:
        """Dark current relative to 0 deg C."""
        return float(2.0 ** (self.temperature_c / self.dark_doubling_c))


class AutoExposureParameters(Parameters):
    """Auto-exposure by a percentile of the counts, as on the MER rovers (Maki et al. 2003); the numbers are assumed."""

    percentile: Annotated[float, Field(gt=0.0, lt=100.0, description="controlled percentile of the counts")] = 98.0
    target: Annotated[float, Field(gt=0.0, lt=1.0, description="target of the percentile over full scale")] = 0.75
    tolerance: Annotated[float, Field(gt=0.0, le=0.5, description="accepted relative distance from the target")] = 0.05
    pictures: Annotated[int, Field(ge=1, le=20, description="test pictures at most")] = 5
    least_s: Annotated[float, Field(gt=0.0, le=10.0, description="shortest exposure, s")] = 1e-4
    most_s: Annotated[float, Field(gt=0.0, le=10.0, description="longest exposure, s")] = 1.0

    @model_validator(mode="after")
    def _check_limits(self) -> AutoExposureParameters:
        if self.least_s > self.most_s:
            raise ValueError(f"the shortest exposure {self.least_s} s is longer than the longest {self.most_s} s")
        return self


@dataclass(frozen=True)
class Detector:
    """A detector behind a lens with a fixed response; its noise is new in every picture.

    - response: relative response of each physical pixel, including fall-off, dust and dead pixels
    - calibration: the ground's calibration, without dust, dead pixels and dark current
    - hot_e_s: excess dark current of each physical pixel at 0 deg C, electrons per second; None without hot pixels
    - listed: delivered pixels that are filled from their neighbours; None without a list of bad pixels
    """

    parameters: DetectorParameters
    response: Float32[np.ndarray, "rows columns"]
    calibration: DetectorCalibration
    hot_e_s: Float32[np.ndarray, "rows columns"] | None = None
    listed: Bool[np.ndarray, "delivered_rows columns"] | None = None

    @classmethod
    def drawn(
        cls, fall_off: Float32[np.ndarray, "rows columns"], parameters: DetectorParameters, rng: np.random.Generator
    ) -> Detector:
        """Draw pixel responses, defects and dust of a detector behind a lens with this fall-off."""
        rows, columns = fall_off.shape
        if rows % parameters.rows_summed:
            raise ValueError(f"{rows} rows cannot be summed by {parameters.rows_summed}")
        response = fall_off * (
            1.0 + parameters.response_spread * rng.standard_normal((rows, columns), dtype=np.float32)
        )
        delivered = _sum_rows(response, parameters.rows_summed) / parameters.rows_summed
        measured = delivered * (1.0 + parameters.calibration_error * rng.standard_normal(delivered.shape))
        calibration = DetectorCalibration(
            flat_field=measured.astype(np.float64),
            exposure_s=parameters.exposure_s,
            transfer_row_s=parameters.transfer_row_s,
            clear_row_s=parameters.clear_row_s,
            rows_summed=parameters.rows_summed,
            offset_dn=parameters.offset_dn,
            full_scale_dn=parameters.full_scale_dn,
        )
        defects, optics = parameters.defects, parameters.optics
        hot = None if defects.hot_share == 0.0 else _hot_currents(fall_off.shape, defects, rng)
        dead = None
        if defects.dead_share > 0.0:
            dead = rng.random(fall_off.shape, dtype=np.float32) < defects.dead_share
            response = np.where(dead, np.float32(0.0), response)
        if optics.dust_discs > 0:
            response = response * dust_transmission(fall_off.shape, optics, rng)
        bad = [one for one in (None if hot is None else hot > 0.0, dead) if one is not None]
        listed = None
        if defects.listed and bad:
            listed = _sum_rows(np.logical_or.reduce(bad).astype(np.float32), parameters.rows_summed) > 0.0
        return cls(parameters, response.astype(np.float32), calibration, hot, listed)

    def with_exposure(self, exposure_s: float) -> Detector:
        """Return the same detector with another exposure time, also in its calibration."""
        parameters = DetectorParameters.model_validate(self.parameters.model_dump() | {"exposure_s": exposure_s})
        return replace(self, parameters=parameters, calibration=replace(self.calibration, exposure_s=exposure_s))

    def window(self, column: int, row: int, size: tuple[int, int]) -> Detector:
        """Return the part of the detector read by a subframe: upper left pixel and size (columns, rows).

        Its pixels are those of the whole detector, except for noise. The part is cleared and shifted out as if it were
        the whole detector next to the storage area: its packets gather smear under its own rows only. In the whole
        detector a packet also passes `row` rows before the part on its way out, and the rows after the part during the
        clearing. A subframe therefore lacks about ``row * transfer_row_s / exposure_s`` of the mean radiance of the
        rows before it, column by column, and the same of the rows after it with `clear_row_s`. It is exact for a
        detector without smear, such as the research rover's cameras and the XC-55. Where smear matters, expose the
        whole picture and crop it. Raises ValueError if the part is empty, leaves the detector or cuts through summed
        rows.
        """
        rows, columns = self.response.shape
        count = self.parameters.rows_summed
        if row % count or size[1] % count:
            raise ValueError(f"a subframe of {size[1]} rows from row {row} cuts through {count} summed rows")
        if min(row, column) < 0 or min(size) < 1 or column + size[0] > columns or row + size[1] > rows:
            raise ValueError(
                f"a subframe of {size[0]} x {size[1]} pixels at ({column}, {row}) leaves the detector of "
                f"{columns} x {rows}"
            )
        part = np.s_[row : row + size[1], column : column + size[0]]
        measured = self.calibration.flat_field[row // count : (row + size[1]) // count, part[1]]
        return replace(
            self,
            response=np.ascontiguousarray(self.response[part]),
            calibration=replace(self.calibration, flat_field=measured),
            hot_e_s=None if self.hot_e_s is None else self.hot_e_s[part],
            listed=None if self.listed is None else self.listed[row // count : (row + size[1]) // count, part[1]],
        )

    def expose(
        self,
        radiance: Float32[np.ndarray, "rows columns"],
        rng: np.random.Generator,
        motion: ImageMotion | None = None,
    ) -> UInt16[np.ndarray, "delivered_rows columns"]:
        """Simulate the counts of one exposure from the scene's radiance factor at mid exposure."""
        p = self.parameters
        mean = _sum_rows(self.charge(radiance, motion), p.rows_summed) + self.dark_charge()
        # the point spread's kernel has negative weights: next to a bright edge the mean may be negative
        electrons = rng.poisson(np.maximum(mean, 0.0)).astype(np.float32)
        electrons += np.float32(p.read_noise_e) * rng.standard_normal(electrons.shape, dtype=np.float32)
        np.minimum(electrons, np.float32(p.full_well_e), out=electrons)
        counts = _add_bursts(electrons / np.float32(p.gain_e_dn) + np.float32(p.offset_dn), p.bursts, rng)
        rounded = np.clip(np.rint(counts), 0, p.full_scale_dn)
        delivered: UInt16[np.ndarray, "delivered_rows columns"] = rounded.astype(np.uint16)
        if self.listed is not None:
            delivered = fill_bad_pixels(delivered, self.listed)
        return expand(compand(delivered, p.full_scale_dn), p.full_scale_dn) if p.companded else delivered

    def charge(
        self, radiance: Float32[np.ndarray, "rows columns"], motion: ImageMotion | None = None
    ) -> Float32[np.ndarray, "rows columns"]:
        """Compute the mean photo charge in electrons of each physical pixel at the end of the transfer.

        Besides its exposure, a packet collects light from the rows that it passes: during the clearing before the
        exposure the rows after its own, on the way to the storage area the rows before its own. Each row is in its
        state at the time when the packet passes it.
        """
        p = self.parameters
        scene = apply_point_spread(radiance, p.optics)
        duration = p.exposure_s + len(radiance) * (p.transfer_row_s + p.clear_row_s)
        if motion is not None and not motion.is_still(duration):
            seconds = moving_exposure(scene, self.response, motion, p.exposure_s, p.transfer_row_s, p.clear_row_s)
            seconds *= np.float32(p.responsivity_e_s)
            return seconds
        rate = scene * self.response * np.float32(p.responsivity_e_s)
        charge: Float32[np.ndarray, "rows columns"] = np.float32(p.exposure_s) * rate
        if p.transfer_row_s > 0.0 or p.clear_row_s > 0.0:
            passed = np.cumsum(rate, axis=0)
            charge += np.float32(p.transfer_row_s) * (passed - rate)
            charge += np.float32(p.clear_row_s) * (passed[-1:] - passed)
        return charge

    def dark_charge(self) -> Float32[np.ndarray, "delivered_rows _"]:
        """Compute the mean dark charge in electrons of each delivered pixel; one column if all are equal."""
        p = self.parameters
        rows = len(self.response)
        current = np.full((rows // p.rows_summed, 1), p.rows_summed * p.dark_e_s, dtype=np.float32)
        if self.hot_e_s is not None:
            current = current + _sum_rows(self.hot_e_s, p.rows_summed)
        seconds = dark_seconds(p, rows)[:, None].astype(np.float32)
        return np.asarray(np.float32(p.dark_growth) * current * seconds)


def dark_seconds(parameters: DetectorParameters, rows: int) -> Float64[np.ndarray, "delivered_rows"]:
    """Duration of each delivered row's dark current: exposure, transfer and wait for readout; row 0 is first."""
    waits = parameters.readout_row_s * np.arange(rows // parameters.rows_summed, dtype=np.float64)
    return np.asarray(waits + parameters.exposure_s + rows * parameters.transfer_row_s)


def _sum_rows(picture: Float[np.ndarray, "rows columns"], count: int) -> Float[np.ndarray, "summed columns"]:
    rows, columns = picture.shape
    return np.asarray(picture.reshape(rows // count, count, columns).sum(axis=1))


def _hot_currents(
    shape: tuple[int, int], parameters: DefectParameters, rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Excess dark current at 0 deg C, electrons per second; exponentially distributed over the hot pixels."""
    hot = rng.random(shape, dtype=np.float32) < parameters.hot_share
    current = np.zeros(shape, dtype=np.float32)
    current[hot] = parameters.hot_e_s * rng.standard_exponential(int(hot.sum()), dtype=np.float32)
    return current


def fill_bad_pixels(
    counts: UInt16[np.ndarray, "rows columns"], bad: Bool[np.ndarray, "rows columns"]
) -> UInt16[np.ndarray, "rows columns"]:
    """Replace bad pixels by the mean of the good ones among their eight neighbours, if there are any."""
    good = np.where(bad, 0.0, 1.0)
    total, fraction = (uniform_filter(values, 3, mode="constant") for values in (good * counts, good))
    # means of nine: with one good neighbour the fraction is 1/9
    fillable = bad & (fraction > 0.5 / 9.0)
    repaired = counts.copy()
    repaired[fillable] = np.rint(total[fillable] / fraction[fillable]).astype(np.uint16)
    return repaired


def _add_bursts(
    counts: Float32[np.ndarray, "rows columns"], parameters: BurstParameters, rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Add bursts of noise at random positions of the readout, along the rows."""
    if parameters.bursts == 0.0:
        return counts
    disturbed = counts.reshape(-1).copy()
    for _ in range(int(rng.poisson(parameters.bursts))):
        start = int(rng.integers(disturbed.size))
        burst = disturbed[start : start + 1 + int(rng.exponential(parameters.length_px))]
        burst += np.float32(parameters.amplitude_dn) * rng.standard_normal(burst.size, dtype=np.float32)
    return disturbed.reshape(counts.shape)


@cache
def compression_table(full_scale_dn: int) -> UInt8[np.ndarray, "counts"]:
    """Code of every count. Raises ValueError if the full scale is below 255: nothing is to be compressed."""
    if full_scale_dn < CODES - 1:
        raise ValueError(f"counts up to {full_scale_dn} need no companding; allowed: {CODES - 1} or more")
    if full_scale_dn == CODES - 1:
        return np.arange(CODES, dtype=np.uint8)
    b = brentq(lambda x: 2.0 * (np.sqrt(x * (full_scale_dn + x)) - x) - (CODES - 1), 1e-3, 1e12)
    counts = np.arange(full_scale_dn + 1)
    table: UInt8[np.ndarray, "counts"] = np.rint(2.0 * (np.sqrt(b * (counts + b)) - b)).astype(np.uint8)
    table.setflags(write=False)
    return table


@cache
def expansion_table(full_scale_dn: int) -> UInt16[np.ndarray, "codes"]:
    """Count of every code."""
    table = compression_table(full_scale_dn)
    first = np.searchsorted(table, np.arange(CODES), side="left")
    last = np.searchsorted(table, np.arange(CODES), side="right") - 1
    counts: UInt16[np.ndarray, "codes"] = ((first + last) // 2).astype(np.uint16)
    counts.setflags(write=False)
    return counts


def compand(counts: UInt16[np.ndarray, "rows columns"], full_scale_dn: int) -> UInt8[np.ndarray, "rows columns"]:
    """Compress counts to 8-bit codes."""
    return np.asarray(compression_table(full_scale_dn)[counts])


def expand(codes: UInt8[np.ndarray, "rows columns"], full_scale_dn: int) -> UInt16[np.ndarray, "rows columns"]:
    """Expand 8-bit codes to counts."""
    return np.asarray(expansion_table(full_scale_dn)[codes])


@dataclass(frozen=True)
class AutoExposure:
    """Result of auto-exposure.

    - detector: the detector with the adjusted exposure time
    - exposures_s: exposure times of the test pictures
    - converged: whether the last test picture reached the target
    """

    detector: Detector
    exposures_s: tuple[float, ...]
    converged: bool


def auto_expose(
    detector: Detector,
    radiance: Float32[np.ndarray, "rows columns"],
    parameters: AutoExposureParameters,
    rng: np.random.Generator,
    region: tuple[slice, slice] | None = None,
    motion: ImageMotion | None = None,
) -> AutoExposure:
    """Take test pictures and scale the exposure time until the picture has the target brightness.

    - detector: its exposure time is tried first
    - rng: random stream of the test pictures' noise
    - region: rows and columns of the delivered picture whose percentile is used; all by default

    Raises ValueError if the region has no pixel.
    """
    tried: list[float] = []
    exposure = float(np.clip(detector.parameters.exposure_s, parameters.least_s, parameters.most_s))
    while True:
        current = detector.with_exposure(exposure)
        tried.append(exposure)
        counts = current.expose(radiance, rng, motion)
        factor = _correction(counts if region is None else counts[region], current, parameters)
        converged = abs(factor - 1.0) <= parameters.tolerance
        following = float(np.clip(exposure * factor, parameters.least_s, parameters.most_s))
        if converged or following == exposure:
            return AutoExposure(current, tuple(tried), converged)
        if len(tried) == parameters.pictures:
            return AutoExposure(detector.with_exposure(following), tuple(tried), False)
        exposure = following


def _correction(
    counts: UInt16[np.ndarray, "rows columns"], detector: Detector, parameters: AutoExposureParameters
) -> float:
    """Factor on the exposure time: 1/8 to 8, and a quarter if the counts saturate."""
    if counts.size == 0:
        raise ValueError("auto-exposure was given a region without pixels")
    p = detector.parameters
    saturation = min(float(p.full_scale_dn), p.full_well_e / p.gain_e_dn + p.offset_dn)
    level = float(np.percentile(counts, parameters.percentile))
    if level >= 0.99 * saturation:
        return 0.25
    signal = max(level - p.offset_dn, 1.0)
    return float(np.clip((parameters.target * saturation - p.offset_dn) / signal, 0.125, 8.0))
