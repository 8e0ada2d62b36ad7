"""A scenario with velocity estimators and without a world: the suite's descent, another inertial error in each case."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from pydantic import BaseModel

from marsyard.algorithms.answers import check_velocity
from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.algorithm_run import AlgorithmSelection, case_result, run_algorithm
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.estimators import VELOCITY, Task
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.velocity import velocity_row
from marsyard.sim.streams import Streams


class FakeVelocityParameters(AlgorithmSelection):
    task: ClassVar[Task] = VELOCITY

    algorithm: str = "homography"


class FakeVelocityScenario:
    name = "fake-velocity"
    parameters_type = FakeVelocityParameters
    task = VELOCITY
    algorithm_table = ()

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Nothing: there are no shared inputs."""

    def run(self, parameters: FakeVelocityParameters, streams: Streams) -> CaseResult:
        p, common = parameters, streams.generator("inertial").normal(size=3)
        given = inputs.descent()
        measurements = replace(given, interval_velocities_m_s=given.interval_velocities_m_s + common)

        def judge(algorithm: str) -> CaseResult:
            attempt = run_algorithm(
                lambda: VELOCITY.make(algorithm, DimesOptions(), p.executable, streams.case).estimate(measurements),
                check_velocity,
            )
            velocity = None if attempt.answer is None else attempt.answer.velocity_m_s
            return CaseResult(
                outcome=attempt.outcome(lambda answer: answer.outcome.name),
                answered=velocity is not None,
                row={**velocity_row("velocity", velocity, inputs.DESCENT_VELOCITY_M_S[:2]), **attempt.row},
                failure=attempt.failure,
            )

        hashed = f"{measurements.interval_velocities_m_s.tolist()}"
        return case_result(p.algorithms, judge, {"image_hash": hashed})
