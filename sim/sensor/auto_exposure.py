"""Auto-exposure of a detector by test images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.detector import MAX_EXPOSURE_S, Detector
from marsyard.sim.sensor.optics import Image

#: Assumed: smallest and largest factor of the exposure time after a test image; the factor after a saturated one, whose
#: brightness is unknown; and the fraction of full scale or full well from which the percentile is saturated.
_FACTOR_LIMITS, _SATURATED_FACTOR, _SATURATED_FRACTION = (0.125, 8.0), 0.25, 0.99


class AutoExposureParameters(Parameters):
    """Auto-exposure by a percentile of the counts, as on the MER rovers (Maki et al. 2003); the numbers are assumed."""

    percentile: Annotated[float, Field(gt=0.0, lt=100.0, description="controlled percentile of the counts")] = 98.0
    target: Annotated[float, Field(gt=0.0, lt=1.0, description="target of the percentile / full scale")] = 0.75
    tolerance: Annotated[float, Field(gt=0.0, le=0.5, description="accepted relative deviation from the target")] = 0.05
    images: Annotated[int, Field(ge=1, le=20, description="maximum number of test images")] = 5
    min_exposure_s: Annotated[float, Field(gt=0.0, le=MAX_EXPOSURE_S, description="shortest exposure, s")] = 1e-4
    max_exposure_s: Annotated[float, Field(gt=0.0, le=MAX_EXPOSURE_S, description="longest exposure, s")] = 1.0

    @model_validator(mode="after")
    def _check_limits(self) -> AutoExposureParameters:
        if self.min_exposure_s > self.max_exposure_s:
            raise ValueError(
                f"min_exposure_s {self.min_exposure_s} is greater than max_exposure_s {self.max_exposure_s}"
            )
        return self


@dataclass(frozen=True)
class AutoExposure:
    """Result of auto-exposure.

    - detector: detector with the adjusted exposure time
    - exposures_s: exposure times of the test images
    - converged: whether the last test image reached the target
    """

    detector: Detector
    exposures_s: tuple[float, ...]
    converged: bool


def auto_expose(
    detector: Detector, radiance: Image, parameters: AutoExposureParameters, rng: np.random.Generator
) -> AutoExposure:
    """Expose test images and scale the exposure time until the image has the target brightness.

    - detector: its exposure time is that of the first test image
    - rng: random generator for the noise of the test images

    After each test image the exposure time is multiplied by a factor from 1/8 to 8. The factor is 1/4 if the percentile
    is saturated (99 % of full scale or full well).
    """
    exposures: list[float] = []
    p = detector.parameters
    saturation = min(float(p.full_scale_dn), p.full_well_e / p.gain_e_dn + p.offset_dn)
    exposure = float(np.clip(p.exposure_s, parameters.min_exposure_s, parameters.max_exposure_s))
    while True:
        test_detector = detector.with_exposure(exposure)
        exposures.append(exposure)
        counts = test_detector.expose(radiance, rng)
        level = float(np.percentile(counts, parameters.percentile))
        signal = max(level - p.offset_dn, 1.0)
        factor = float(np.clip((parameters.target * saturation - p.offset_dn) / signal, *_FACTOR_LIMITS))
        factor = _SATURATED_FACTOR if level >= _SATURATED_FRACTION * saturation else factor
        converged = abs(factor - 1.0) <= parameters.tolerance
        next_exposure = float(np.clip(exposure * factor, parameters.min_exposure_s, parameters.max_exposure_s))
        if converged or next_exposure == exposure:
            return AutoExposure(test_detector, tuple(exposures), converged)
        if len(exposures) == parameters.images:
            return AutoExposure(detector.with_exposure(next_exposure), tuple(exposures), False)
        exposure = next_exposure
