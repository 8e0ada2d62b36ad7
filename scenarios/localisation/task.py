"""Task of the position estimators: names of the algorithms, their options, and how they are created."""

from __future__ import annotations

from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.exchange import ExecutablePositionEstimator
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionEstimator, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.estimators import Task
from marsyard.scenarios.localisation.offline import POSITION_FORMAT

LOCALISATION: Task[PositionEstimator, LvsOptions] = Task(
    name="localisation",
    what="position estimator",
    methods=("start", "imu", "altitude", "image", "finish"),
    answers=(PositionEstimate, PositionOutcome),
    shipped={"lvs": MapRelativeEstimator, "sift": FeatureEstimator, "inertial": InertialEstimator},
    executable=ExecutablePositionEstimator,
    options=LvsOptions,
    offline=POSITION_FORMAT,
    suite="marsyard.scenarios.localisation.conformance:PositionSuite",
)
