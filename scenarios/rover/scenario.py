"""Rover scenario: one run of the closed loop of driving and tracking."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pydantic import BaseModel

from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.base import TerrainScenario
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.rover import placement
from marsyard.scenarios.rover.closed_loop import prepare_run, track_target
from marsyard.scenarios.rover.conditions import fixed_conditions, visibility_columns
from marsyard.scenarios.rover.parameters import RoverScenarioParameters, WorldParameters
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.rover.tracked_run import ScoredTrack, run_tracker, score_track
from marsyard.scenarios.rover.world import terrain_parameters
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class RoverScenario(TerrainScenario[RoverScenarioParameters]):
    """Tracking of a target at every stop of a rover that drives to, around or away from the target."""

    name = "rover"
    parameters_type = RoverScenarioParameters
    task = TRACKING
    max_cached_grounds = 4

    def check_parameters(self, parameters: BaseModel) -> RoverScenarioParameters:
        """Return the parameters of the selected run. Raises TypeError for parameters of another scenario."""
        return super().check_parameters(parameters).select_variant()

    def location(self, p: RoverScenarioParameters) -> WorldParameters:
        """Return the parameters of the terrain."""
        return p.world

    def input_terrain(self, p: RoverScenarioParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the terrain bank and the index of a terrain in it."""
        return TerrainBank(terrain_parameters(p.world), p.world.bank_seed), shared_input

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run the case with each algorithm and the same random draws."""
        p = self.check_parameters(parameters)
        start_s = time.process_time()
        first = prepare_run(p, streams, self.load_ground)
        shared = {**fixed_conditions(p, first), **placement.placement_truth(first)}

        def run(algorithm: str) -> AlgorithmRun[ScoredTrack]:
            is_tested = algorithm == p.algorithm
            candidate = p.model_copy(update={"algorithm": algorithm})
            run_start_s = start_s if is_tested else time.process_time()
            prepared = first if is_tested else prepare_run(candidate, streams, self.load_ground)
            return run_tracker(p, lambda: place_target(track_target(candidate, prepared)), run_start_s)

        def score_run(algorithm: str, runs: Runs[ScoredTrack]) -> Score:
            result = score_track(p, runs[algorithm].answer, is_tested=algorithm == p.algorithm)
            track = runs[algorithm].answer
            if track is None:
                return result
            row = {**result.row, **placement.placement_row(track.run)}
            row |= visibility_columns(p, track.run) if algorithm == p.algorithm else {}
            return replace(result, row=row)

        return evaluate_case(p, shared, run, score_run)


def place_target(run: RoverRun) -> RoverRun:
    """Place the instrument on a target that was handed off to the arm; return the run."""
    target = run.stops[-1].update.position_rover if run.handed_off else None
    if target is not None:
        measurements = run.stops[-1].measurements(run.setup.rig.calibrated)
        run.placement = placement.auto_place(measurements, np.asarray(target))
    return run
