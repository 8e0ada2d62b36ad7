"""A frame-transfer CCD: radiance to counts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt16

from marsyard.sim.measurements import DetectorCalibration
from marsyard.sim.sensor.companding import compand, expand
from marsyard.sim.sensor.defects import add_bursts, dead_pixels, filled, hot_currents
from marsyard.sim.sensor.motion import ImageMotion, moving_exposure
from marsyard.sim.sensor.optics import dust_transmission, natural_fall_off, spread
from marsyard.sim.sensor.parameters import DetectorParameters

__all__ = ["Detector", "DetectorParameters", "dark_seconds", "natural_fall_off"]


@dataclass(frozen=True)
class Detector:
    """One detector behind one camera: its response is fixed, its noise is drawn anew for every picture.

    Attributes
    ----------
    parameters
        The detector's parameters.
    response
        Relative response of each physical pixel with the lens's fall-off, its dust and dead pixels, shape (rows,
        columns).
    calibration
        What the ground knows of it: neither dust nor dead pixels, nor dark current.
    hot_e_s
        Dark current of each physical pixel at 0 deg C beyond the common one, electrons per second; None without hot
        pixels.
    listed
        Delivered pixels that are filled from their neighbours; None without a list of bad pixels.
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
        """A detector of as many physical pixels behind a lens of this fall-off, its pixels and dust drawn."""
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
            full_scale_dn=parameters.full_scale_dn,
        )
        defects, optics = parameters.defects, parameters.optics
        hot = None if defects.hot_share == 0.0 else hot_currents(fall_off.shape, defects, rng)
        dead = None if defects.dead_share == 0.0 else dead_pixels(fall_off.shape, defects, rng)
        if dead is not None:
            response = np.where(dead, np.float32(0.0), response)
        if optics.dust_discs > 0:
            response = response * dust_transmission(fall_off.shape, optics, rng)
        listed = _listed(hot, dead, parameters)
        return cls(parameters, response.astype(np.float32), calibration, hot, listed)

    def with_exposure(self, exposure_s: float) -> Detector:
        """The same detector set to another exposure time, which its calibration states."""
        parameters = DetectorParameters.model_validate(self.parameters.model_dump() | {"exposure_s": exposure_s})
        return replace(self, parameters=parameters, calibration=replace(self.calibration, exposure_s=exposure_s))

    def window(self, column: int, row: int, size: tuple[int, int]) -> Detector:
        """The part of the detector that a subframe reads, given its upper left pixel and its size (columns, rows).

        Its pixels are those of the whole detector, noise apart. The part is cleared and shifted out as if it were all
        of the detector and lay beside the storage area: its packets gather smear under its own rows alone. A packet of
        the whole detector also passes `row` rows before the part on its way out, and those after the part when it is
        cleared, of which a subframe renders nothing. A subframe therefore lacks about ``row * transfer_row_s /
        exposure_s`` of the mean radiance of these rows, column by column, and the same of the rows after it with
        `clear_row_s`. It is exact for a detector without smear, as the research rover's cameras and the XC-55 are;
        where smear matters, expose the whole picture and cut it.

        Raises
        ------
        ValueError
            If the part is empty, leaves the detector or cuts through rows that are summed.
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
        known = self.calibration.flat_field[row // count : (row + size[1]) // count, part[1]]
        hot = None if self.hot_e_s is None else self.hot_e_s[part]
        return replace(
            self,
            response=np.ascontiguousarray(self.response[part]),
            calibration=replace(self.calibration, flat_field=known),
            hot_e_s=hot,
            listed=None if self.listed is None else self.listed[row // count : (row + size[1]) // count, part[1]],
        )

    def expose(
        self,
        radiance: Float32[np.ndarray, "rows columns"],
        rng: np.random.Generator,
        motion: ImageMotion | None = None,
    ) -> UInt16[np.ndarray, "delivered_rows columns"]:
        """Counts of one exposure.

        Parameters
        ----------
        radiance
            Radiance factor of the scene at mid exposure.
        rng
            Stream of the noise.
        motion
            How the picture moves; None for a still one.
        """
        p = self.parameters
        mean = _sum_rows(self.charge(radiance, motion), p.rows_summed) + self.dark_charge()
        # the point spread's kernel has weights below 0: beside a bright edge the mean may dip under it
        electrons = rng.poisson(np.maximum(mean, 0.0)).astype(np.float32)
        electrons += np.float32(p.read_noise_e) * rng.standard_normal(electrons.shape, dtype=np.float32)
        np.minimum(electrons, np.float32(p.full_well_e), out=electrons)
        counts = add_bursts(electrons / np.float32(p.gain_e_dn) + np.float32(p.offset_dn), p.bursts, rng)
        delivered: UInt16[np.ndarray, "delivered_rows columns"] = np.clip(np.rint(counts), 0, p.full_scale_dn).astype(
            np.uint16
        )
        if self.listed is not None:
            delivered = filled(delivered, self.listed)
        return expand(compand(delivered, p.full_scale_dn), p.full_scale_dn) if p.companded else delivered

    def charge(
        self, radiance: Float32[np.ndarray, "rows columns"], motion: ImageMotion | None = None
    ) -> Float32[np.ndarray, "rows columns"]:
        """Mean charge by light in electrons of each physical pixel at the end of the transfer.

        Besides its exposure, a packet collects light from the rows it passes under: before the exposure, while the
        detector is cleared, the rows after its own; after it, on the way to the storage area, the rows before its own.
        Each row is seen as it is when the packet passes it.
        """
        p = self.parameters
        scene = spread(radiance, p.optics)
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
        """Mean dark charge in electrons of each delivered pixel, one column where all columns are alike."""
        p = self.parameters
        rows = len(self.response)
        current = np.full((rows // p.rows_summed, 1), p.rows_summed * p.dark_e_s, dtype=np.float32)
        if self.hot_e_s is not None:
            current = current + _sum_rows(self.hot_e_s, p.rows_summed)
        seconds = dark_seconds(p, rows)[:, None].astype(np.float32)
        return np.asarray(np.float32(p.dark_growth) * current * seconds)


def dark_seconds(parameters: DetectorParameters, rows: int) -> Float64[np.ndarray, "delivered_rows"]:
    """How long the charge of each delivered row gathers dark current: exposure, transfer and the wait for its readout.

    Row 0 is read out first.
    """
    waits = parameters.readout_row_s * np.arange(rows // parameters.rows_summed, dtype=np.float64)
    return np.asarray(waits + parameters.exposure_s + rows * parameters.transfer_row_s)


def _listed(
    hot_e_s: Float32[np.ndarray, "rows columns"] | None,
    dead: Bool[np.ndarray, "rows columns"] | None,
    parameters: DetectorParameters,
) -> Bool[np.ndarray, "delivered_rows columns"] | None:
    """Delivered pixels that hold a hot or dead one, if the camera has a list of them."""
    bad = [one for one in (None if hot_e_s is None else hot_e_s > 0.0, dead) if one is not None]
    if not (parameters.defects.listed and bad):
        return None
    return np.asarray(_sum_rows(np.logical_or.reduce(bad).astype(np.float32), parameters.rows_summed) > 0.0)


def _sum_rows(picture: Float[np.ndarray, "rows columns"], count: int) -> Float[np.ndarray, "summed columns"]:
    rows, columns = picture.shape
    return np.asarray(picture.reshape(rows // count, count, columns).sum(axis=1))
