"""Rover scenarios: one run of the closed loop, or one target tracked over the pictures of a shared drive."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache, partial
from typing import cast

from pydantic import BaseModel

from marsyard.scenarios.algorithm_run import Judged, case_result, run_algorithm
from marsyard.scenarios.base import TerrainScenario
from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import scored
from marsyard.scenarios.rover.parameters import RoverScenarioParameters, WorldParameters
from marsyard.scenarios.rover.run import Run, prepare_run, track_target
from marsyard.scenarios.rover.score import (
    fixed_conditions,
    products,
    provenance,
    run_conditions,
    score,
    scored_run,
    sighting_columns,
    stored_updates,
    tracking,
)
from marsyard.scenarios.rover.shared import (
    DriveKey,
    SharedDriveParameters,
    render_drive,
    sightings_along,
    track_views,
)
from marsyard.scenarios.rover.shared import prepare_run as prepare_shared_run
from marsyard.scenarios.rover.stops import RunOutcome
from marsyard.scenarios.rover.world import terrain_parameters
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank

#: Terrains of a bank that are built before its runs; a larger bank's are built by the runs that need them.
PREPARED_TERRAINS = 64
#: Maximum number of grounds, shared drives with their pictures, and sightings along drives that a process keeps.
KEPT_GROUNDS, KEPT_DRIVES, KEPT_SIGHTINGS = 4, 1, 128


class RoverScenario(TerrainScenario[RoverScenarioParameters]):
    """A rover drives to, around or away from what it sees, and tracks it at every stop."""

    name = "rover"
    parameters_type = RoverScenarioParameters
    task = TRACKING
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def __init__(self) -> None:
        super().__init__(KEPT_GROUNDS)

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains; none of a large bank, whose terrains few runs share."""
        bank = self.checked(parameters).world.bank
        return tuple(range(bank)) if bank <= PREPARED_TERRAINS else ()

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The run's terrain."""
        return (self.checked(parameters).world.terrain,)

    def input_terrain(self, p: RoverScenarioParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """A terrain of the bank."""
        return _bank(p.world), shared_input

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One run for each algorithm, with the same draws."""
        p = self.checked(parameters)
        started = time.process_time()
        first = prepare_run(p, streams, self.load_ground)
        known = fixed_conditions(p, first)

        def judge(algorithm: str) -> Judged:
            judged = algorithm == p.algorithm
            own = p.model_copy(update={"algorithm": algorithm})
            began = started if judged else time.process_time()
            run = first if judged else prepare_run(own, streams, self.load_ground)

            def track() -> Run:
                track_target(own, run)
                return run

            def more_columns(run: Run) -> dict[str, Scalar]:
                return {"run_time_s": time.process_time() - began, **(sighting_columns(p, run) if judged else {})}

            return _judge(p, track, known, judged, more_columns)

        return case_result(p.algorithms, judge, known)


class SharedDriveScenario(TerrainScenario[SharedDriveParameters]):
    """Many targets tracked over the pictures of one drive."""

    name = "rover-drive"
    parameters_type = SharedDriveParameters
    task = TRACKING
    algorithm_table = ("drive",)
    part_keys: Mapping[str, Kind] = {"drive.scores": SCORE}

    def __init__(self) -> None:
        super().__init__(KEPT_GROUNDS)
        self._drive = lru_cache(maxsize=KEPT_DRIVES)(partial(render_drive, load_ground=self.load_ground))
        self._sightings = lru_cache(maxsize=KEPT_SIGHTINGS)(
            lambda key, point, options: sightings_along(self._drive(key), point, options)
        )

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains that runs use."""
        return tuple(sorted({one.terrain for one in self.checked(parameters).variants}))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain of the case's run."""
        p = self.checked(parameters)
        return (p.variants[p.run].terrain,)

    def input_terrain(self, p: SharedDriveParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """A terrain of the bank."""
        return _bank(p.drive.world), shared_input

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One target of one run, tracked with one step; all algorithms see the same pictures."""
        p = self.checked(parameters)
        key = DriveKey.of(p, streams)
        drive = self._drive(key)
        case = key.drive.model_copy(update={"algorithm": p.drive.algorithm, "vtt": p.drive.vtt})
        seen = self._sightings(key, p.targets[p.target], p.drive.vtt)
        on_face = seen.in_view and (p.face_deg is None or seen.obliquity_max_deg <= p.face_deg)
        conditions = fixed_conditions(case, prepare_shared_run(p, drive))
        known = {**conditions, **_case_columns(p), **asdict(seen), "on_face": on_face}

        def judge(algorithm: str) -> Judged:
            return _judge(case, lambda: track_views(p, drive, algorithm), known, algorithm == p.drive.algorithm)

        return case_result(p.drive.algorithms, judge, known)


def _judge(
    p: RoverScenarioParameters,
    track: Callable[[], Run],
    known: Mapping[str, Scalar],
    judged: bool,
    more_columns: Callable[[Run], dict[str, Scalar]] = lambda run: {},
) -> Judged:
    """Score a run; `judged` is the run of the algorithm under test, whose conditions and products are stored."""

    def track_and_score() -> tuple[Run, dict[str, Scalar]]:
        run = track()
        return run, {**score(p, run), **tracking(run)}

    attempt = run_algorithm(track_and_score, lambda answer: cast(tuple[Run, dict[str, Scalar]], answer))
    if attempt.answer is None:
        return Judged(attempt.outcome(str), False, attempt.row, failure=attempt.failure)
    run, row = attempt.answer
    row |= more_columns(run)
    if judged:
        updates = stored_updates(run, p.score.stored_updates)
        row |= {**updates, **run_conditions(p, run), **provenance(p, run)}
    row |= scored(p.scores, scored_run(run), {*row, *known})
    kept = products(p, run) if judged else {}
    return Judged(run.outcome.name, run.outcome is RunOutcome.COMPLETED, row, kept)


def _case_columns(p: SharedDriveParameters) -> dict[str, Scalar]:
    """Columns that identify a case."""
    point = p.targets[p.target]
    bands: dict[str, Scalar] = {one.name: bool(one.least <= p.step <= one.most) for one in p.bands}
    return {
        "run": p.run,
        "target": p.target,
        "point_across": point.across,
        "point_up": point.up,
        "skip": p.skip,
        "step": p.step,
        "with_scale": p.drive.algorithm != "pure-ncc" and p.drive.vtt.scale,
        "pure_ncc": p.drive.algorithm == "pure-ncc",
        **bands,
    }


def _bank(w: WorldParameters) -> TerrainBank:
    return TerrainBank(terrain_parameters(w), w.bank_seed)
