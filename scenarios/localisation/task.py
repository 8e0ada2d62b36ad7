"""Task of the position estimators: names of the algorithms, their options, and how they are created."""

from functools import partial

from marsyard.algorithms.exchange import ExecutableAlgorithm
from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.exchange import POSITION_STREAM
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionEstimator, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.localisation.offline_files import POSITION_FORMAT
from marsyard.scenarios.tasks import Task

LOCALISATION: Task[PositionEstimator, LvsOptions] = Task(
    name="localisation",
    noun="position estimator",
    methods=(),
    answers=(PositionEstimate, PositionOutcome),
    shipped={"lvs": MapRelativeEstimator, "sift": FeatureEstimator, "inertial": InertialEstimator},
    executable=partial(ExecutableAlgorithm, requests=POSITION_STREAM.requests),
    options=LvsOptions,
    offline=POSITION_FORMAT,
    accepts_streams=True,
    suite="marsyard.scenarios.localisation.conformance:position_suite",
)
