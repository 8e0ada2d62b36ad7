"""Frame-transfer CCD: radiance to counts, with noise, smear, defects, bursts and 8-bit companding.

Physical pixels are those of the detector. A delivered row is the sum of `rows_summed` physical rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt16
from pydantic import Field
from scipy.ndimage import uniform_filter

from marsyard.sim.camera import CameraModel
from marsyard.sim.error_sources import DETECTOR
from marsyard.sim.measurements import DetectorCalibration
from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive
from marsyard.sim.sensor.image_coding import Counts, compand, expand
from marsyard.sim.sensor.image_motion import ImageMotion, moving_exposure
from marsyard.sim.sensor.optics import Image, OpticsParameters, apply_point_spread, dust_transmission

#: Charge, electrons, from which `add_noise` draws both noises together.
MIN_COMMON_E = 100.0
MAX_EXPOSURE_S = 10.0  #: Longest allowed exposure time, seconds.
_RelativeError = Annotated[float, Field(ge=0.0, le=0.1)]
#: Counts of an image after the summation of rows.
Delivered = UInt16[np.ndarray, "delivered_rows columns"]


class DefectParameters(Parameters):
    """Defective pixels; none by default."""

    hot_fraction: Annotated[Fraction, DETECTOR, Field(description="fraction of hot pixels")] = 0.0
    hot_e_s: Annotated[NonNegative, Field(description="mean dark current of a hot pixel at 0 deg C, e/s")] = 20000.0
    dead_fraction: Annotated[Fraction, DETECTOR, Field(description="fraction of pixels without response")] = 0.0
    listed: Annotated[bool, Field(description="bad pixels are listed and interpolated")] = False


#: Bursts in scenarios that set only their number: RMS noise, counts (a third of the image's signal), and mean length,
#: delivered pixels (two rows).
BURST_DN, BURST_PX = 300.0, 2048.0


class BurstParameters(Parameters):
    """Bursts of noise on the cable during the readout; none by default."""

    bursts: Annotated[NonNegative, DETECTOR, Field(le=1e4, description="mean number of bursts in an image")] = 0.0
    length_px: Annotated[float, Field(gt=0.0, le=1e7, description="mean length of a burst, delivered pixels")] = 2000.0
    amplitude_dn: Annotated[NonNegative, Field(description="RMS of the noise in a burst, counts")] = 300.0


class DetectorParameters(Parameters):
    """A frame-transfer detector without mechanical shutter. Defaults: the MER descent camera as flown.

    Full well, gain, read noise and readout rate: Maki et al. 2003. Responsivity and dark current are calibrated (see
    `marsyard.sim.sensor.radiometry`). The clearing time is assumed. The pattern `residual_spread` is no default.
    """

    exposure_s: Annotated[float, Field(gt=0.0, le=MAX_EXPOSURE_S, description="exposure time, s")] = 0.004
    responsivity_e_s: Annotated[Positive, Field(description="electrons/s on axis at radiance factor 1")] = 1.019e7
    sun_au: Annotated[float, Field(gt=0.1, le=100.0, description="distance of the sun for this responsivity, AU")] = 1.5
    rows_summed: Annotated[int, Field(ge=1, le=16, description="rows summed on the chip")] = 4
    transfer_row_s: Annotated[NonNegative, Field(description="time per row during the transfer, s")] = 5.0e-6
    clear_row_s: Annotated[NonNegative, Field(description="time per row during the clearing, s")] = 1.0e-6
    readout_row_s: Annotated[NonNegative, Field(description="time to read out a delivered row, s")] = 5.3e-3
    full_well_e: Annotated[Positive, Field(description="full well, electrons")] = 170000.0
    gain_e_dn: Annotated[Positive, Field(description="electrons per count")] = 41.5
    photon_noise: Annotated[bool, DETECTOR, Field(description="whether the charge has Poisson noise")] = True
    read_noise_e: Annotated[NonNegative, DETECTOR, Field(description="read noise, electrons")] = 25.0
    offset_dn: Annotated[NonNegative, Field(description="counts without light")] = 20.0
    bits: Annotated[int, Field(ge=8, le=16, description="bits of a count")] = 12
    temperature_c: Annotated[float, Field(ge=-150.0, le=80.0, description="temperature of the detector, deg C")] = -34.0
    dark_e_s: Annotated[NonNegative, Field(description="dark current of a pixel at 0 deg C, electrons/s")] = 159.0
    dark_doubling_c: Annotated[float, Field(gt=0.0, le=50.0, description="temperature rise for doubling, deg C")] = 6.0
    response_spread: Annotated[_RelativeError, DETECTOR, Field(description="RMS of the pixels' relative response")] = (
        0.01
    )
    residual_spread: Annotated[
        _RelativeError, DETECTOR, Field(description="RMS of a pattern in the response that the calibration lacks")
    ] = 0.0
    residual_px: Annotated[float, Field(gt=0.0, le=100.0, description="scale (SD) of this pattern's blur, px")] = 2.0
    calibration_error: Annotated[
        _RelativeError, DETECTOR, Field(description="RMS error of the calibrated response")
    ] = 0.002
    companded: Annotated[bool, Field(description="compress counts to 8 bits and expand them again")] = False
    optics: OpticsParameters = OpticsParameters()
    defects: DefectParameters = DefectParameters()
    bursts: BurstParameters = BurstParameters()
    file: Annotated[str | None, Field(description="datasheet that the values were read from")] = None

    def input_files(self) -> tuple[str, ...]:
        """Return the datasheet that the values were read from, if any."""
        return () if self.file is None else (self.file,)

    def delivered_camera(self, camera: CameraModel) -> CameraModel:
        """Return the camera of delivered images, of which a row is the sum of `rows_summed` rows of `camera`."""
        return camera.bin(columns=1, rows=self.rows_summed)

    def bin(self, side: int) -> DetectorParameters:
        """Return the parameters of a detector whose pixels are the sums of blocks of side x side pixels.

        The electrons per count grow by the number of pixels in a block: the counts of a uniform scene are unchanged.
        The blur of the lens is a smaller fraction of a pixel. Defects are omitted.
        """
        area = side * side
        factors = {
            "responsivity_e_s": area, "full_well_e": area, "gain_e_dn": area, "dark_e_s": area,
            "read_noise_e": side, "transfer_row_s": side, "clear_row_s": side, "readout_row_s": side,
            "response_spread": 1.0 / side, "calibration_error": 1.0 / side, "residual_px": 1.0 / side,
        }  # fmt: skip
        scaled = {name: getattr(self, name) * factor for name, factor in factors.items()}
        lengths = ("diffraction_px", "diffusion_px", "defocus_px", "dust_radius_px")
        optics = {name: getattr(self.optics, name) / side for name in lengths}
        return self.model_copy(
            update=scaled | {"optics": self.optics.model_copy(update=optics), "defects": DefectParameters()}
        )

    @property
    def sunlight(self) -> float:
        """Solar irradiance at `sun_au`, relative to 1 AU."""
        return 1.0 / self.sun_au**2

    @property
    def full_scale_dn(self) -> int:
        """Maximum count."""
        return int(2**self.bits - 1)

    @property
    def dark_growth(self) -> float:
        """Dark current at the detector's temperature, divided by that at 0 deg C."""
        return float(2.0 ** (self.temperature_c / self.dark_doubling_c))


@dataclass(frozen=True)
class Detector:
    """A detector with its lens: the response of the pixels is drawn once, the noise for each image.

    - response: relative response of each physical pixel, including natural fall-off, dust and dead pixels
    - calibration: calibration before flight, without dust, dead pixels and dark current
    - hot_e_s: excess dark current of each physical pixel at 0 deg C, electrons per second; None without hot pixels
    - listed: delivered pixels that are interpolated from neighbours; None without a list of bad pixels
    """

    parameters: DetectorParameters
    response: Image
    calibration: DetectorCalibration
    hot_e_s: Image | None = None
    listed: Bool[np.ndarray, "delivered_rows columns"] | None = None

    @classmethod
    def draw(cls, fall_off: Image, parameters: DetectorParameters, rng: np.random.Generator) -> Detector:
        """Draw pixel responses, defects and dust; `fall_off` is the natural fall-off of the lens."""
        p, rows = parameters, len(fall_off)
        if rows % p.rows_summed:
            raise ValueError(f"{rows} rows cannot be summed by {p.rows_summed}")
        response = fall_off * (1.0 + p.response_spread * rng.standard_normal(fall_off.shape, dtype=np.float32))
        summed_response = _sum_rows(response, p.rows_summed) / p.rows_summed
        measured_response = summed_response * (1.0 + p.calibration_error * rng.standard_normal(summed_response.shape))
        names = ("exposure_s", "transfer_row_s", "clear_row_s", "rows_summed", "offset_dn", "full_scale_dn")
        values = {name: getattr(p, name) for name in names}
        calibration = DetectorCalibration(flat_field=measured_response.astype(np.float64), **values)
        if p.residual_spread > 0.0:
            pattern = cv2.GaussianBlur(rng.standard_normal(fall_off.shape, dtype=np.float32), (0, 0), p.residual_px)
            response = response * (1.0 + np.float32(p.residual_spread / pattern.std()) * pattern)
        is_bad, hot_e_s = np.zeros(fall_off.shape, dtype=np.bool_), None
        if p.defects.hot_fraction > 0.0:
            # the dark current of hot pixels is exponentially distributed
            is_hot = rng.random(fall_off.shape, dtype=np.float32) < p.defects.hot_fraction
            hot_e_s = np.zeros(fall_off.shape, dtype=np.float32)
            hot_e_s[is_hot] = p.defects.hot_e_s * rng.standard_exponential(int(is_hot.sum()), dtype=np.float32)
            is_bad |= hot_e_s > 0.0
        if p.defects.dead_fraction > 0.0:
            is_dead = rng.random(fall_off.shape, dtype=np.float32) < p.defects.dead_fraction
            response = np.where(is_dead, np.float32(0.0), response)
            is_bad |= is_dead
        if p.optics.dust_discs > 0:
            response = response * dust_transmission(fall_off.shape, p.optics, rng)
        has_list = p.defects.listed and (p.defects.hot_fraction > 0.0 or p.defects.dead_fraction > 0.0)
        listed = _sum_rows(is_bad.astype(np.float32), p.rows_summed) > 0.0 if has_list else None
        return cls(p, response.astype(np.float32), calibration, hot_e_s, listed)

    def with_exposure(self, exposure_s: float) -> Detector:
        """Return the same detector with another exposure time; the calibration is updated.

        Raises ValueError if the exposure time is not allowed.
        """
        if not 0.0 < exposure_s <= MAX_EXPOSURE_S:
            raise ValueError(f"exposure_s is {exposure_s:g}; allowed: above 0, at most {MAX_EXPOSURE_S:g}")
        # the other parameters are valid; to validate all of them takes about 2 ms
        parameters = self.parameters.model_copy(update={"exposure_s": exposure_s})
        return replace(self, parameters=parameters, calibration=replace(self.calibration, exposure_s=exposure_s))

    def window(self, column: int, row: int, size: tuple[int, int]) -> Detector:
        """Return the part of the detector that a subframe reads: upper left pixel and size (columns, rows).

        The pixel responses are those of the full detector. The smear of rows outside the subframe is missing: for the
        rows above, about ``row * transfer_row_s / exposure_s`` of their mean radiance; for the rows below, the same
        with their number and `clear_row_s`. The result is exact for a detector without smear,
        such as the XC-55. If smear is relevant, expose the full image and crop it. Raises ValueError if the subframe is
        empty, extends beyond the detector or splits summed rows.
        """
        rows, columns = self.response.shape
        rows_summed = self.parameters.rows_summed
        if row % rows_summed or size[1] % rows_summed:
            raise ValueError(f"a subframe of {size[1]} rows from row {row} splits groups of {rows_summed} summed rows")
        if min(row, column) < 0 or min(size) < 1 or column + size[0] > columns or row + size[1] > rows:
            raise ValueError(
                f"a subframe of {size[0]} x {size[1]} pixels at ({column}, {row}) is not inside the detector of "
                f"{columns} x {rows}"
            )
        part = np.s_[row : row + size[1], column : column + size[0]]
        summed = np.s_[row // rows_summed : (row + size[1]) // rows_summed, part[1]]
        hot_e_s = None if self.hot_e_s is None else self.hot_e_s[part]
        listed = None if self.listed is None else self.listed[summed]
        calibration = replace(self.calibration, flat_field=self.calibration.flat_field[summed])
        return replace(
            self, response=self.response[part].copy(), calibration=calibration, hot_e_s=hot_e_s, listed=listed
        )

    def expose(self, radiance: Image, rng: np.random.Generator, motion: ImageMotion | None = None) -> Delivered:
        """Simulate the counts of one exposure; `radiance` is the radiance factor of the scene at mid exposure."""
        p = self.parameters
        mean = _sum_rows(self.charge(radiance, motion), p.rows_summed) + self.dark_charge()
        # the point spread kernel has negative weights, so that the mean can be negative next to a bright edge
        mean = np.maximum(mean, 0.0)
        electrons = add_noise(mean, p.read_noise_e, p.photon_noise, rng)
        np.minimum(electrons, np.float32(p.full_well_e), out=electrons)
        counts = electrons / np.float32(p.gain_e_dn) + np.float32(p.offset_dn)
        if p.bursts.bursts > 0.0:
            # bursts start at random positions of the readout, which is row by row
            readout = counts.reshape(-1)
            for _ in range(int(rng.poisson(p.bursts.bursts))):
                start = int(rng.integers(readout.size))
                burst = readout[start : start + 1 + int(rng.exponential(p.bursts.length_px))]
                burst += np.float32(p.bursts.amplitude_dn) * rng.standard_normal(burst.size, dtype=np.float32)
        image: Delivered = np.clip(np.rint(counts), 0, p.full_scale_dn).astype(np.uint16)
        if self.listed is not None:
            image = fill_bad_pixels(image, self.listed)
        return expand(compand(image, p.full_scale_dn), p.full_scale_dn) if p.companded else image

    def charge(self, radiance: Image, motion: ImageMotion | None = None) -> Image:
        """Compute the mean photo charge in electrons of each physical pixel at the end of the transfer.

        A charge packet is the charge of one pixel. It also collects light in the rows through which it is shifted:
        in the rows after its own row during the clearing before the exposure, and in the rows before its own row
        during the transfer to the storage area. The radiance of each row is that at the time when the packet passes it.
        """
        p = self.parameters
        scene = apply_point_spread(radiance, p.optics)
        duration = p.exposure_s + len(radiance) * (p.transfer_row_s + p.clear_row_s)
        if motion is not None and not motion.is_still(duration):
            exposure = moving_exposure(scene, self.response, motion, p.exposure_s, p.transfer_row_s, p.clear_row_s)
            exposure *= np.float32(p.responsivity_e_s)
            return exposure
        rate = scene * self.response * np.float32(p.responsivity_e_s)
        charge: Image = np.float32(p.exposure_s) * rate
        if p.transfer_row_s > 0.0 or p.clear_row_s > 0.0:
            cumulative = np.cumsum(rate, axis=0)
            charge += np.float32(p.transfer_row_s) * (cumulative - rate)
            charge += np.float32(p.clear_row_s) * (cumulative[-1:] - cumulative)
        return charge

    def dark_charge(self) -> Float32[np.ndarray, "delivered_rows _"]:
        """Compute the mean dark charge in electrons of each delivered pixel; one column if all columns are equal."""
        p = self.parameters
        rows = len(self.response)
        current_e_s = np.full((rows // p.rows_summed, 1), p.rows_summed * p.dark_e_s, dtype=np.float32)
        if self.hot_e_s is not None:
            current_e_s = current_e_s + _sum_rows(self.hot_e_s, p.rows_summed)
        times_s = dark_seconds(p, rows)[:, None].astype(np.float32)
        return np.asarray(np.float32(p.dark_growth) * current_e_s * times_s)


def add_noise(mean: Image, read_noise_e: float, photon_noise: bool, rng: np.random.Generator) -> Image:
    """Draw charges in electrons with Poisson noise, if `photon_noise`, and normal noise.

    Poisson numbers take most of a detector's time. Charges of at least `MIN_COMMON_E` are therefore drawn from one
    normal number by the expansion of Cornish & Fisher (1938) with the variance and the third cumulant of the sum of
    both noises. Their probabilities deviate from those of the exact sum by less than 3e-5 for a read noise
    of at least 5 electrons. (Without read noise the deviation is 2e-3, because the exact charge is a whole number.)
    """
    normal = rng.standard_normal(mean.shape, dtype=np.float32)
    if not photon_noise:
        return np.asarray(mean + np.float32(read_noise_e) * normal)
    variance = mean + np.float32(max(read_noise_e**2, 1e-6))
    electrons: Image = mean + np.sqrt(variance) * normal + mean / variance * ((normal * normal - 1.0) / np.float32(6.0))
    is_exact = mean < MIN_COMMON_E
    if is_exact.any():
        electrons[is_exact] = rng.poisson(mean[is_exact]) + np.float32(read_noise_e) * normal[is_exact]
    return electrons


def dark_seconds(parameters: DetectorParameters, rows: int) -> Float64[np.ndarray, "delivered_rows"]:
    """Compute the integration time of the dark current of each delivered row: exposure, transfer, wait for readout."""
    waits = parameters.readout_row_s * np.arange(rows // parameters.rows_summed, dtype=np.float64)
    return np.asarray(waits + parameters.exposure_s + rows * parameters.transfer_row_s)


def _sum_rows(image: Float[np.ndarray, "rows columns"], count: int) -> Float[np.ndarray, "summed columns"]:
    rows, columns = image.shape
    return np.asarray(image.reshape(rows // count, count, columns).sum(axis=1))


def fill_bad_pixels(counts: Counts, bad: Bool[np.ndarray, "rows columns"]) -> Counts:
    """Replace bad pixels by the mean of the good pixels among the eight neighbours; no change if there are none."""
    weights = np.where(bad, 0.0, 1.0)
    mean_counts, mean_weights = (uniform_filter(values, 3, mode="constant") for values in (weights * counts, weights))
    # means over nine pixels: with one good neighbour the mean weight is 1/9
    is_fillable = bad & (mean_weights > 0.5 / 9.0)
    filled = counts.copy()
    filled[is_fillable] = np.rint(mean_counts[is_fillable] / mean_weights[is_fillable]).astype(np.uint16)
    return filled
