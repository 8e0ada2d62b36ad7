"""Auto-exposure: adjustment of the exposure time to a target brightness of the picture or a region of it."""

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
        float, Field(gt=0.0, lt=1.0, description="target of that percentile, as a fraction of full scale")
    ] = 0.75
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
