"""Auto-exposure: exposure times until the picture, or a part of it, is as bright as asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, UInt16
from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.detector import Detector
from marsyard.sim.sensor.motion import ImageMotion


class AutoExposureParameters(Parameters):
    """Auto-exposure by a percentile of the counts, as on the MER rovers (Maki et al. 2003); the numbers are assumed."""

    percentile: Annotated[float, Field(gt=0.0, lt=100.0, description="percentile of the counts that is judged")] = 98.0
    target: Annotated[
        float, Field(gt=0.0, lt=1.0, description="what that percentile shall be, as a share of full scale")
    ] = 0.75
    tolerance: Annotated[float, Field(gt=0.0, le=0.5, description="accepted relative distance from the target")] = 0.05
    pictures: Annotated[int, Field(ge=1, le=20, description="test pictures at most")] = 5
    least_s: Annotated[float, Field(gt=0.0, le=10.0, description="shortest exposure, s")] = 1e-4
    most_s: Annotated[float, Field(gt=0.0, le=10.0, description="longest exposure, s")] = 1.0

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> AutoExposureParameters:
        if self.least_s > self.most_s:
            raise ValueError(f"the shortest exposure {self.least_s} s is longer than the longest {self.most_s} s")
        return self


@dataclass(frozen=True)
class AutoExposure:
    """What auto-exposure found.

    Attributes
    ----------
    detector
        The detector set to the exposure time that was found.
    exposures_s
        Exposure times of the test pictures.
    converged
        Whether the last test picture met the target.
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
    """Takes test pictures and scales the exposure time until the picture is as bright as asked for.

    Parameters
    ----------
    detector, radiance, motion
        The detector, whose exposure time is tried first, and the scene.
    parameters
        What is asked for.
    rng
        Stream of the test pictures' noise.
    region
        Rows and columns of the delivered picture that are judged; all of it if not given.

    Raises
    ------
    ValueError
        If the region holds no pixel.
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
    """By what to multiply the exposure time; at most a factor of 8 at once, and a quarter where the counts saturate."""
    if counts.size == 0:
        raise ValueError("auto-exposure was given a region without pixels")
    p = detector.parameters
    most = min(float(p.full_scale_dn), p.full_well_e / p.gain_e_dn + p.offset_dn)
    level = float(np.percentile(counts, parameters.percentile))
    if level >= 0.99 * most:
        return 0.25
    signal = max(level - p.offset_dn, 1.0)
    return float(np.clip((parameters.target * most - p.offset_dn) / signal, 0.125, 8.0))
