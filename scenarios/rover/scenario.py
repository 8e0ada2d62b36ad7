"""One run of the closed loop as a case."""

from __future__ import annotations

import time

from pydantic import BaseModel

from scenarios.interface import CaseResult
from scenarios.rover.parameters import RoverScenarioParameters
from scenarios.rover.run import run_case
from scenarios.rover.score import conditions, products, provenance, score, stored_updates, tracking
from scenarios.rover.stops import RunOutcome
from scenarios.rover.world import terrain_parameters
from sim.streams import Streams
from sim.terrain import TerrainBank


class RoverScenario:
    """A rover drives to, around or away from what it sees, and tracks it at every stop."""

    name = "rover"
    parameters_type = RoverScenarioParameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains."""
        return tuple(range(_checked(parameters).world.bank))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        w = _checked(parameters).world
        TerrainBank(terrain_parameters(w), w.bank_seed).terrain(shared_input)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One run."""
        p = _checked(parameters)
        started = time.process_time()
        run = run_case(p, streams)
        taken = time.process_time() - started
        row = {
            **score(p, run),
            **tracking(run),
            **conditions(p, run),
            **stored_updates(run, p.score.stored_updates),
            "run_time_s": taken,
            **provenance(p, run),
        }
        return CaseResult(
            outcome=run.outcome.name,
            answered=run.outcome is RunOutcome.COMPLETED,
            row=row,
            products=products(p, run),
        )


def _checked(parameters: BaseModel) -> RoverScenarioParameters:
    if not isinstance(parameters, RoverScenarioParameters):
        raise TypeError(f"the rover scenario takes RoverScenarioParameters, not {type(parameters).__name__}")
    return parameters
