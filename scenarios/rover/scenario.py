"""One run of the closed loop as a case."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import cast

from pydantic import BaseModel

from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import scored
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import Run, prepare_run, track_target
from marsyard.scenarios.rover.score import (
    fixed_conditions,
    products,
    provenance,
    run_conditions,
    score,
    scored_run,
    sighted,
    stored_updates,
    tracking,
)
from marsyard.scenarios.rover.stops import RunOutcome
from marsyard.scenarios.rover.world import terrain_parameters
from marsyard.scenarios.trial import Judged, attempted, case_result
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank

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

        started = time.process_time()
        first = prepare_run(p, streams)
        known = fixed_conditions(p, first)

        def judge(algorithm: str) -> Judged:
            judged = algorithm == p.algorithm
            mine = p.model_copy(update={"algorithm": algorithm})
            began, run = (started, first) if judged else (time.process_time(), prepare_run(mine, streams))
            attempt = attempted(lambda: _tracked(mine, run, streams), lambda row: cast(dict[str, Scalar], row))
            if attempt.answer is None:
                return Judged(attempt.outcome(lambda _: run.outcome.name), False, {}, failure=attempt.failure)
            row = {**attempt.answer, "run_time_s": time.process_time() - began}
            if judged:
                row |= {
                    **stored_updates(run, p.score.stored_updates),
                    **run_conditions(p, run),
                    **sighted(p, run),
                    **provenance(p, run),
                }
            row |= scored(p.scores, scored_run(run), {*row, *known})
            return _judged(run, row, products(p, run) if judged else None)

        return case_result(p.algorithms, judge, known)


def _tracked(p: RoverScenarioParameters, run: Run, streams: Streams) -> dict[str, Scalar]:
    """A prepared run of the closed loop driven to its end, and its score."""
    track_target(p, run, streams)
    return {**score(p, run), **tracking(run)}


def _judged(run: Run, row: Mapping[str, Scalar], kept: Mapping[str, object] | None = None) -> Judged:
    return Judged(run.outcome.name, run.outcome is RunOutcome.COMPLETED, row, kept or {})


def _bank(parameters: BaseModel) -> TerrainBank:
    w = _checked(parameters).world
    return TerrainBank(terrain_parameters(w), w.bank_seed)


def _checked(parameters: BaseModel) -> RoverScenarioParameters:
    if not isinstance(parameters, RoverScenarioParameters):
        raise TypeError(f"the rover scenario takes RoverScenarioParameters, not {type(parameters).__name__}")
    return parameters
