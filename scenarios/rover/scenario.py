"""One run of the closed loop as a case."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import cast

from pydantic import BaseModel

from scenarios.estimators import TRACKING
from scenarios.interface import CaseResult, Scalar
from scenarios.parts.named import SCORE, Kind
from scenarios.parts.scores import scored
from scenarios.rover.parameters import RoverScenarioParameters
from scenarios.rover.run import Run, run_case
from scenarios.rover.score import conditions, products, provenance, score, scored_run, sighted, stored_updates, tracking
from scenarios.rover.stops import RunOutcome
from scenarios.rover.world import terrain_parameters
from scenarios.trial import Judged, attempted, case_result
from sim.streams import Streams
from sim.terrain import TerrainBank

#: Terrains of a bank that are built before its runs; a larger bank's are built by the runs that need them.
PREPARED_TERRAINS = 64


class RoverScenario:
    """A rover drives to, around or away from what it sees, and tracks it at every stop."""

    name = "rover"
    parameters_type = RoverScenarioParameters
    task = TRACKING
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains; none of a bank so large that hardly two runs have the same one."""
        bank = _checked(parameters).world.bank
        return tuple(range(bank)) if bank <= PREPARED_TERRAINS else ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        _bank(parameters).terrain(shared_input)

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain that the rover drives on."""
        return (_checked(parameters).world.terrain,)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a terrain that is not on disk."""
        return _bank(parameters).missing_bytes(shared_input)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One run; each algorithm that is compared makes one of its own, with the same draws."""
        p = _checked(parameters)

        def judge(algorithm: str) -> Judged:
            mine = p.model_copy(update={"algorithm": algorithm})
            attempt = attempted(lambda: _tracked(mine, streams), lambda made: cast(tuple[Run, dict[str, Scalar]], made))
            if attempt.answer is None:
                return Judged(attempt.outcome(lambda made: made[0].outcome.name), False, {}, failure=attempt.failure)
            run, row = attempt.answer
            judged = algorithm == p.algorithm
            if judged:
                row |= {
                    **stored_updates(run, p.score.stored_updates),
                    **conditions(p, run),
                    **sighted(p, run),
                    **provenance(p, run),
                }
            row |= scored(p.scores, scored_run(run), row)
            return _judged(run, row, products(p, run) if judged else None)

        return case_result(p.algorithms, judge, {})


def _tracked(p: RoverScenarioParameters, streams: Streams) -> tuple[Run, dict[str, Scalar]]:
    """One run of the closed loop, and its score."""
    started = time.process_time()
    run = run_case(p, streams)
    taken = time.process_time() - started
    return run, {**score(p, run), **tracking(run), "run_time_s": taken}


def _judged(run: Run, row: Mapping[str, Scalar], kept: Mapping[str, object] | None = None) -> Judged:
    return Judged(run.outcome.name, run.outcome is RunOutcome.COMPLETED, row, kept or {})


def _bank(parameters: BaseModel) -> TerrainBank:
    w = _checked(parameters).world
    return TerrainBank(terrain_parameters(w), w.bank_seed)


def _checked(parameters: BaseModel) -> RoverScenarioParameters:
    if not isinstance(parameters, RoverScenarioParameters):
        raise TypeError(f"the rover scenario takes RoverScenarioParameters, not {type(parameters).__name__}")
    return parameters
