"""Run times of velocity estimators on the same rendered descents: DIMES and baselines."""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.timing import Measurement
from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.interface import VelocityEstimator
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.descent import simulation
from marsyard.scenarios.descent.overlap import overlap_row
from marsyard.scenarios.descent.scenario import DescentScenario
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


@dataclass(frozen=True)
class Descent:
    """Measurements of a descent, true mean velocity over the second image pair, and whether the overlap is feasible."""

    measurements: DescentMeasurements
    velocity_m_s: np.ndarray
    has_feasible_overlap: bool


def simulate_descents(campaign_name: str, cases: int) -> list[Descent]:
    """Simulate the first cases of a descent campaign without an estimator."""
    campaign = load_campaign(campaign_name)
    descents = []
    for case in range(cases):
        p = DescentScenario().check_parameters(campaign.parameters(case))
        descent = simulation.Descent.simulate(p, campaign.streams(case))
        velocity = np.array(descent.truth(descent.measurements.last_interval_s))
        is_feasible = bool(overlap_row(p, descent.world, descent.states)["feasible_overlap"])
        descents.append(Descent(descent.measurements, velocity, is_feasible))
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
    descents = simulate_descents("dimes-smoke", cases)
    limits_s = {"DIMES": 0.015}
    return [
        Measurement(
            f"velocity from three images: {name}",
            run_estimator(estimator, descents).seconds.tolist(),
            limit=limits_s.get(name),
        )
        for name, estimator in ESTIMATORS.items()
    ]
