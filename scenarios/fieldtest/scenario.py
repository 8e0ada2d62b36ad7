"""Field test scenario: simulate, measure, estimate and score one triple of images of a run."""

from functools import lru_cache, partial
from typing import Any

from pydantic import BaseModel

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.condition_columns import hash_images, image_columns
from marsyard.scenarios.fieldtest.conditions import cloud_columns, triple_columns
from marsyard.scenarios.fieldtest.flight import RunKey
from marsyard.scenarios.fieldtest.images import build_start_scene, run_ground, take_image
from marsyard.scenarios.fieldtest.measurements import TripleCase, measure, truth_velocities
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.run import simulate_run
from marsyard.scenarios.fieldtest.timeline import triple_timeline
from marsyard.scenarios.fieldtest.triples import find_triple
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.parts.scores import ScoredFlight
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.scenarios.velocity import VELOCITY, check_last_interval
from marsyard.scenarios.velocity_score import consistency_row, velocity_products, velocity_row
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank

#: Cache sizes of runs and scenes: large enough for all runs of the paper, because the cases alternate runs.
_CACHED_RUNS, _CACHED_SCENES = 16, 5


class FieldTestScenario(TerrainScenario[FieldTestParameters]):
    """Triples of images from a helicopter flight, measured as in the paper, for a velocity estimator."""

    name = "fieldtest"
    parameters_type = FieldTestParameters
    task = VELOCITY

    def __init__(self) -> None:
        self._simulate_run = lru_cache(maxsize=_CACHED_RUNS)(simulate_run)
        self._start_scene = lru_cache(maxsize=_CACHED_SCENES)(
            lambda key: build_start_scene(self._simulate_run(key).flown, run_ground(key))
        )

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the indices of the sites."""
        return tuple(range(len(self.check_parameters(parameters).site_names)))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the site of the case's run. Raises ValueError if there is no such triple."""
        p = self.check_parameters(parameters)
        number, _ = find_triple(p, case)
        return (p.site_names.index(p.runs[number].site),)

    def input_terrain(self, p: FieldTestParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the terrain bank and index of a site's terrain."""
        return TerrainBank(p.terrain(p.site_names[shared_input]), p.bank_seed), 0

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one triple and score all algorithms."""
        p = self.check_parameters(parameters)
        number, index = find_triple(p, streams.case)
        key = RunKey(p, number, streams.seed, streams.campaign)
        run, ground = self._simulate_run(key), run_ground(key)
        triple = run.triples[index]
        times_s = run.truth.times_s[list(triple.image_indices)].tolist()
        first, second, third = map(run.flown.flight.state, times_s)
        case = TripleCase(run, triple, (first, second, third))
        detector = key.detector()
        noise, scene = streams.generator("detector noise"), self._start_scene(key)
        exposures = [take_image(run.flown, scene, ground, state, detector, noise) for state in case.states]
        images, frames = zip(*exposures, strict=True)
        truth = truth_velocities(p, case)[1, :2]
        inertial = streams.generator("inertial velocity")
        measurements = measure(p, case, images, detector, key.calibrated_camera(), inertial)
        conditions = {
            **triple_columns(p, case, measurements, ground.surface),
            **cloud_columns(case, second=frames[1]),
            **image_columns(p.backend, hash_images(images)),
        }

        def evaluate(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            check = partial(check_last_interval, measurements=measurements)
            return run_on_measurements(partial(p.make, algorithm, streams.case), check, measurements)

        def score(algorithm: str, runs: Runs[VelocityEstimate]) -> Score:
            estimate = runs[algorithm].answer
            velocity = None if estimate is None else estimate.velocity_m_s
            row = {**velocity_row("velocity", velocity, truth), **consistency_row(estimate, truth)}
            scored = None
            if estimate is not None:
                truths: dict[str, Any] = {"true_velocity_m_s": truth, "states": case.states, "motion": run.flown.flight}
                scored = ScoredFlight(measurements=measurements, answer=estimate, **truths)
            timeline = partial(triple_timeline, run, ground, case.states, images, estimate)
            return Score(velocity is not None, row, velocity_products(images, estimate, truth), scored, timeline)

        return evaluate_case(p, conditions, evaluate, score)
