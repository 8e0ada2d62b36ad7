"""Landing scenario: one flight from its world and pictures to the estimate, the landing and the score."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from marsyard.algorithms.answers import check_site
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.algorithm_run import case_result, run_algorithm_on_copy
from marsyard.scenarios.base import TerrainScenario, algorithm_result
from marsyard.scenarios.conditions import hash_images, picture_columns
from marsyard.scenarios.estimators import LANDING
from marsyard.scenarios.exposure import Sample, pixel_sample, sum_rows
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import KEPT_GROUNDS, RenderedFlight, measure
from marsyard.scenarios.landing.score import (
    conditions,
    landing_row,
    map_row,
    motion_row,
    outcome_row,
    products,
    site_row,
    times_row,
)
from marsyard.scenarios.parts.scores import ScoredLanding, compute_scores
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class LandingScenario(TerrainScenario[LandingScenarioParameters]):
    """Two pictures of the ground from a moving camera, given to an estimator of landing sites."""

    name = "landing"
    parameters_type = LandingScenarioParameters
    task = LANDING

    def __init__(self) -> None:
        super().__init__(KEPT_GROUNDS)

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains; none of a large bank, whose terrains few flights share (0.1 s each)."""
        bank = self.check_parameters(parameters).location.bank
        return tuple(range(bank)) if bank <= KEPT_GROUNDS else ()

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain below the flight."""
        return (self.check_parameters(parameters).location.terrain,)

    def input_terrain(self, p: LandingScenarioParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """A terrain of the bank."""
        return TerrainBank(p.terrain, p.location.bank_seed), shared_input

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """The two delivered pictures of a case, with the truth of their pixels."""
        case = RenderedFlight.of(self.check_parameters(parameters), streams, self.load_ground)
        p, pair = case.p, case.pair
        for frame, image, state in zip(pair.frames, pair.images, case.flight.states, strict=True):
            about: dict[str, Any] = {
                "site": p.site,
                "time_s": image.time_s,
                "position_m": state.position_m.tolist(),
                "world_from_body_xyzw": state.attitude.as_quat().tolist(),
                "sun_direction": case.world.sun.direction.tolist(),
                "lander": p.lander.model_dump(mode="json"),
            }
            hazard = case.truth.hazard_map(frame.points_world()[sum_rows(p.detector.rows_summed)])
            yield pixel_sample(image.counts, frame, p.detector, image.camera, about, hazard)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Fly one case; run each algorithm, and score its answer and the resulting landing."""
        p = self.check_parameters(parameters)
        case = RenderedFlight.of(p, streams, self.load_ground)
        flight, truth = case.flight, case.truth
        measurements = measure(p, flight, case.pair, streams)
        provenance = picture_columns(p.render.backend, hash_images(case.pair.counts))
        known = {**conditions(case, measurements), **provenance}

        def evaluate(algorithm: str) -> CaseResult:
            attempt = run_algorithm_on_copy(
                lambda given: LANDING.make(algorithm, p.hda, p.executable, streams.case).estimate(given),
                check_site,
                measurements,
            )
            # without an answer the a-priori site is landed on
            estimate = attempt.answer or SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world)
            row = {
                **({} if attempt.answer is None else outcome_row(attempt.answer)),
                **site_row(estimate, flight, truth),
                **landing_row(p, estimate, flight, truth, streams),
                **motion_row(estimate.details, flight, case.pair),
                **map_row(p, estimate, flight, truth),
                **times_row(estimate.details),
                **attempt.row,
            }
            if attempt.answer is not None:
                answered = ScoredLanding(
                    measurements=measurements,
                    answer=attempt.answer,
                    true_poses=(flight.states[0].world_from_body, flight.states[1].world_from_body),
                    states=flight.states,
                    ground=truth,
                )
                row |= compute_scores(p.scores, answered, {*row, *known})
            converged = attempt.answer is not None and estimate.outcome.converged
            return algorithm_result(attempt, converged, row, products(case, estimate))

        return case_result(p.algorithms, evaluate, known)
