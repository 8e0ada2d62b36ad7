"""A scenario without rendering for tests of velocity estimators: one descent, with a random inertial error per case."""

from dataclasses import replace
from typing import ClassVar

from marsyard.algorithms.answers import check_velocity
from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_algorithm
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.tasks import Task
from marsyard.scenarios.velocity import VELOCITY
from marsyard.scenarios.velocity_score import velocity_row
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs


class FakeVelocityParameters(AlgorithmSelection):
    task: ClassVar[Task] = VELOCITY

    algorithm: str = "homography"


class FakeVelocityScenario(ScenarioWithoutInputs):
    name = "fake-velocity"
    parameters_type = FakeVelocityParameters
    task = VELOCITY
    algorithm_table = ()

    def run(self, parameters: FakeVelocityParameters, streams: Streams) -> CaseResult:
        inertial_error_m_s = streams.generator("inertial").normal(size=3)
        descent = inputs.descent()
        measurements = replace(descent, interval_velocities_m_s=descent.interval_velocities_m_s + inertial_error_m_s)

        def run_estimator(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            return run_algorithm(
                lambda: VELOCITY.make(algorithm, DimesOptions(), parameters.executable, streams.case).estimate(
                    measurements
                ),
                check_velocity,
            )

        def score(algorithm: str, runs: Runs[VelocityEstimate]) -> Score:
            answer = runs[algorithm].answer
            velocity = None if answer is None else answer.velocity_m_s
            return Score(velocity is not None, velocity_row("velocity", velocity, inputs.DESCENT_VELOCITY_M_S[:2]))

        # the inputs of the cases differ only in their inertial velocities
        input_text = f"{measurements.interval_velocities_m_s.tolist()}"
        return evaluate_case(parameters, {"image_hash": input_text}, run_estimator, score)
