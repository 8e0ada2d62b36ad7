"""Rover scenario: one run of the closed loop of driving and tracking."""

import time
from dataclasses import replace

from pydantic import BaseModel

from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.rover.closed_loop import drive_commanded_path, prepare_run, track_target
from marsyard.scenarios.rover.conditions import fixed_conditions, path_visibility, visibility_columns
from marsyard.scenarios.rover.parameters import RoverScenarioParameters, WorldParameters
from marsyard.scenarios.rover.placement import place_on_target, placement_row, placement_truth
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.rover.tracked_run import ScoredTrack, run_tracker, score_track
from marsyard.scenarios.rover.world import terrain_parameters
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class RoverScenario(TerrainScenario[RoverScenarioParameters]):
    """Tracking of a target at every stop of a rover that drives to, around or away from the target."""

    name = "rover"
    parameters_type = RoverScenarioParameters
    task = TRACKING

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
        tested_run = prepare_run(p, streams)
        # a second rover drives a commanded path to its end, also if the tracker loses the target before
        heads = drive_commanded_path(p, prepare_run(p, streams)) if p.is_commanded else []
        conditions = {**fixed_conditions(p, tested_run), **placement_truth(tested_run)}
        conditions |= path_visibility(p, tested_run, heads)

        def run(algorithm: str) -> AlgorithmRun[ScoredTrack]:
            with_algorithm = p.model_copy(update={"algorithm": algorithm})
            is_tested = algorithm == p.algorithm
            run_start_s = start_s if is_tested else time.process_time()
            # every tracker moves its own rover, from the same start
            prepared = tested_run if is_tested else prepare_run(with_algorithm, streams)
            return run_tracker(p, lambda: place_on_target(track_target(with_algorithm, prepared)), run_start_s)

        def score(algorithm: str, runs: Runs[ScoredTrack]) -> Score:
            track, is_tested = runs[algorithm].answer, algorithm == p.algorithm
            result = score_track(p, track, is_tested=is_tested)
            if track is None:
                return result
            visibility = visibility_columns(p, track.run) if is_tested else {}
            return replace(result, row={**result.row, **placement_row(track.run), **visibility})

        return evaluate_case(p, conditions, run, score)
