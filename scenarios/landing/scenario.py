"""Landing scenario: simulate images and measurements, run the algorithms, simulate the landings, and score them."""

from collections.abc import Iterator
from functools import partial
from typing import Any

from pydantic import BaseModel

from marsyard.algorithms.answers import check_site
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.condition_columns import hash_images, image_columns
from marsyard.scenarios.image_samples import ImageSample, pixel_sample, select_middle_rows
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.landing import score
from marsyard.scenarios.landing.conditions import conditions
from marsyard.scenarios.landing.figures import case_products, landing_timeline
from marsyard.scenarios.landing.map_score import map_row
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.score import motion_row, times_row
from marsyard.scenarios.landing.simulation import RenderedFlight, measure
from marsyard.scenarios.landing.touchdown import simulate_touchdown
from marsyard.scenarios.landing_task import LANDING
from marsyard.scenarios.parts.scores import ScoredLanding
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.sim.streams import Streams


class LandingScenario(TerrainScenario[LandingScenarioParameters]):
    """Estimation of a landing site from two images of a moving camera, and the landing at this site."""

    name = "landing"
    parameters_type = LandingScenarioParameters
    task = LANDING

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[ImageSample]:
        """Yield the two delivered images of a case with the ground truth of their pixels."""
        case = RenderedFlight.simulate(self.check_parameters(parameters), streams)
        p, pair = case.p, case.pair
        for frame, image, state in zip(pair.frames, pair.images, case.flight.states, strict=True):
            metadata: dict[str, Any] = {
                "site": p.site,
                "time_s": image.time_s,
                "position_m": state.position_m.tolist(),
                "world_from_body_xyzw": state.attitude.as_quat().tolist(),
                "sun_direction": case.world.sun.direction.tolist(),
                "lander": p.lander.model_dump(mode="json"),
            }
            hazard = case.truth.classify_points(frame.points_world()[select_middle_rows(p.detector.rows_summed)])
            yield pixel_sample(image.counts, frame, p.detector, image.camera, metadata, hazard)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one case, run all algorithms, and score their answers and the resulting landings."""
        p = self.check_parameters(parameters)
        case = RenderedFlight.simulate(p, streams)
        flight, truth = case.flight, case.truth
        measurements = measure(p, flight, case.pair, streams)
        provenance = image_columns(p.render.backend, hash_images(case.pair.counts))
        shared = {**conditions(case, measurements), **provenance}

        def run(algorithm: str) -> AlgorithmRun[SiteEstimate]:
            check = partial(check_site, apriori_m=measurements.apriori_site_world)
            return run_on_measurements(partial(p.make, algorithm, streams.case), check, measurements)

        def score_answer(algorithm: str, runs: Runs[SiteEstimate]) -> Score:
            # without an answer the helicopter lands at the a-priori site; NO_STRUCTURE stands for any failure
            answer = runs[algorithm].answer
            estimate = answer or SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world)
            touchdown = simulate_touchdown(p, estimate, flight, truth, streams)
            row = {
                **({} if answer is None else score.outcome_row(answer)),
                **score.site_row(estimate, flight, truth),
                **score.landing_row(touchdown, estimate, flight, truth),
                **motion_row(estimate.details, flight, case.pair),
                **map_row(p, estimate, flight, truth),
                **times_row(estimate.details),
            }
            scored = None
            if answer is not None:
                scored = ScoredLanding(
                    measurements=measurements,
                    answer=answer,
                    true_poses=(flight.states[0].world_from_body, flight.states[1].world_from_body),
                    states=flight.states,
                    ground=truth,
                )
            is_converged = answer is not None and estimate.outcome.converged
            timeline = partial(landing_timeline, case, estimate, touchdown)
            return Score(is_converged, row, case_products(case, estimate), scored, timeline)

        return evaluate_case(p, shared, run, score_answer)
