"""Run times of velocity estimators on the same rendered descents: DIMES and baselines."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from benchmarks.timing import Measurement
from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.interface import VelocityEstimate, VelocityEstimator, VelocityOutcome
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.sim.measurements import DescentMeasurements

#: Compared estimators, by name.
ESTIMATORS: Mapping[str, VelocityEstimator] = {
    "DIMES": DimesEstimator(),
    "DIMES, without sub-pixel refinement": DimesEstimator(DimesOptions(subpixel=False)),
    "OpenCV's phase correlation": PhaseCorrelationEstimator(),
    "OpenCV's ORB and homography": HomographyEstimator(),
}
#: Runs of each estimate. The fastest run is used, because other programs only add time.
REPEATS = 3


class Recorder:
    """Estimator that records its measurements for other estimators."""

    measurements_of_runs: ClassVar[list[DescentMeasurements]] = []

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Record the measurements without an answer."""
        self.measurements_of_runs.append(measurements)
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


@dataclass(frozen=True)
class Descent:
    """Measurements of a descent, true mean velocity over the second image pair, and whether the overlap is feasible."""

    measurements: DescentMeasurements
    velocity_m_s: np.ndarray
    has_feasible_overlap: bool


def record_descents(campaign_name: str, cases: int) -> list[Descent]:
    """Run the first cases of a descent campaign and record their measurements."""
    campaign = load_campaign(campaign_name, ["parameters.algorithm=benchmarks.estimators:Recorder"])
    descents = []
    for case in range(cases):
        Recorder.measurements_of_runs.clear()
        row = campaign.scenario.run(campaign.parameters(case), campaign.streams(case)).row
        velocity = np.array([row["velocity_true_x_m_s"], row["velocity_true_y_m_s"]])
        descents.append(Descent(Recorder.measurements_of_runs[0], velocity, bool(row["feasible_overlap"])))
    return descents


@dataclass(frozen=True)
class EstimatorResult:
    """Errors of an estimator in m/s (NaN without an answer) and core-seconds per descent."""

    errors_m_s: np.ndarray
    seconds: np.ndarray

    @property
    def valid_errors_m_s(self) -> np.ndarray:
        """Errors of the answers."""
        return self.errors_m_s[np.isfinite(self.errors_m_s)]


def run_estimator(estimator: VelocityEstimator, descents: list[Descent]) -> EstimatorResult:
    """Run an estimator on descents."""
    errors, seconds = [], []
    for descent in descents:
        times = []
        for _ in range(REPEATS):
            start = time.process_time()
            answer = estimator.estimate(descent.measurements)
            times.append(time.process_time() - start)
        velocity = np.full(2, np.nan) if answer.velocity_m_s is None else answer.velocity_m_s
        errors.append(float(np.hypot(*(velocity - descent.velocity_m_s))))
        seconds.append(min(times))
    return EstimatorResult(np.array(errors), np.array(seconds))


def compare_estimators(cases: int) -> list[Measurement]:
    """Measure the core-seconds of each estimator on the same descents of three images, binned to 256 x 256."""
    descents = record_descents("dimes-smoke", cases)
    limits_s = {"DIMES": 0.015}
    return [
        Measurement(
            f"velocity from three images: {name}",
            run_estimator(estimator, descents).seconds.tolist(),
            limit=limits_s.get(name),
        )
        for name, estimator in ESTIMATORS.items()
    ]
