"""Localisation scenario: simulate a descent, its map and its measurements, run the algorithms, and score them."""

from collections.abc import Mapping
from functools import partial

from pydantic import BaseModel

from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.condition_columns import hash_images, image_columns
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.localisation import score
from marsyard.scenarios.localisation.figures import case_products, localisation_timeline
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.simulation import LocalisedDescent, map_terrain
from marsyard.scenarios.localisation.task import LOCALISATION
from marsyard.scenarios.parts.named import PartKind
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.sim.render.renderer import return_freed_memory
from marsyard.sim.streams import Streams


class LocalisationScenario(TerrainScenario[LocalisationScenarioParameters]):
    """Descent to a mapped site with images, inertial data and altitudes for a position estimator."""

    name = "localisation"
    parameters_type = LocalisationScenarioParameters
    task = LOCALISATION
    max_stored_terrains = 20  # a terrain needs 180 MB on disk
    part_keys: Mapping[str, PartKind] = {}

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the indices of the terrains below the descent and on the map."""
        p = self.check_parameters(parameters)
        return (p.location.terrain, map_terrain(p)) if p.faults.wrong_map else (p.location.terrain,)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one descent and score all algorithms."""
        return_freed_memory()  # that of the previous case: the memory of a new terrain would be in addition
        descent = LocalisedDescent.simulate(self.check_parameters(parameters), streams)
        p = descent.p
        shared = {
            **score.conditions(descent),
            **image_columns(p.render.backend, hash_images(image.counts for image in descent.images)),
        }

        def run(algorithm: str) -> AlgorithmRun[StreamAnswers[PositionEstimate]]:
            make = partial(p.make, algorithm, streams.case)
            return run_on_measurements(make, descent.measurements.check, descent.measurements)

        def score_answers(algorithm: str, runs: Runs[StreamAnswers[PositionEstimate]]) -> Score:
            answers = runs[algorithm].answer
            timeline = partial(localisation_timeline, descent, answers)
            if answers is None:
                return Score(False, {}, timeline=timeline)
            is_answered = answers.outcome is PositionOutcome.VALID
            row, products = score.answer_row(descent, answers), case_products(descent, answers)
            return Score(is_answered, row, products, timeline=timeline)

        return evaluate_case(p, shared, run, score_answers)
