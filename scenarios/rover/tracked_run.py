"""Run of a tracker as an algorithm of a case: its columns and its score."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

from marsyard.scenarios.algorithm_run import AlgorithmRun, run_algorithm
from marsyard.scenarios.case_evaluation import Score
from marsyard.scenarios.condition_columns import image_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover import score
from marsyard.scenarios.rover.conditions import run_conditions
from marsyard.scenarios.rover.figures import run_products, run_timeline
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun, RunOutcome
from marsyard.scenarios.rover.score import update_columns


@dataclass(frozen=True)
class ScoredTrack:
    """A run of a tracker and the columns of its score."""

    run: RoverRun
    row: dict[str, Scalar]

    @property
    def outcome(self) -> RunOutcome:
        """Outcome of the run."""
        return self.run.outcome


def run_tracker(
    p: RoverScenarioParameters, track: Callable[[], RoverRun], start_s: float | None = None
) -> AlgorithmRun[ScoredTrack]:
    """Run a tracker, whose answers move the mast or the rover; an exception is a failure of the tracker.

    start_s: processor time at the start of a run that takes its own images
    """

    def track_and_score() -> ScoredTrack:
        run = track()
        times = {} if start_s is None else {"run_time_s": time.process_time() - start_s}
        return ScoredTrack(run, {**score.score_run(p, run), **score.tracking_row(run), **times})

    algorithm_run = run_algorithm(track_and_score, lambda answer: cast(ScoredTrack, answer))
    # without the measured time: it includes that of the images, which follow from the answers
    return algorithm_run if algorithm_run.answer is None else replace(algorithm_run, row={})


def score_track(p: RoverScenarioParameters, track: ScoredTrack | None, *, is_tested: bool) -> Score:
    """Score a run, None for a failure; conditions and products are stored only for the algorithm under test."""
    if track is None:
        return Score(False, {})
    run, row = track.run, dict(track.row)
    is_completed, scored = run.outcome is RunOutcome.COMPLETED, score.create_scored_run(run)
    if not is_tested:
        return Score(is_completed, row, custom_input=scored)
    digest = hashlib.sha256(b"".join(stop.images.digest for stop in run.stops)).hexdigest()
    row |= {**update_columns(run, p.score.stored_updates), **run_conditions(p, run)}
    row |= image_columns(p.backend, digest)
    return Score(is_completed, row, run_products(p, run), scored, lambda: run_timeline(p, run))
