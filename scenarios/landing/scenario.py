"""One flight, step by step: world, motion, pictures, measurements, estimate, truth, score."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pydantic import BaseModel

from marsyard.algorithms.answers import checked_site
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.estimators import LANDING
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.landing.descent import landing_row
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.measurement import measure
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import take_pictures
from marsyard.scenarios.landing.samples import landing_samples
from marsyard.scenarios.landing.score import conditions, map_row, motion_row, outcome_row, products, site_row, times_row
from marsyard.scenarios.landing.truth import GroundTruth
from marsyard.scenarios.landing.world import KEPT_GROUNDS, World, camera_optics
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredLanding, scored
from marsyard.scenarios.provenance import rendered
from marsyard.scenarios.samples import Sample
from marsyard.scenarios.trial import Judged, attempted_with, case_result
from marsyard.sim.frames import rigid
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class LandingScenario:
    """Two pictures of the ground from a moving camera, given to an estimator of landing sites."""

    name = "landing"
    parameters_type = LandingScenarioParameters
    task = LANDING
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains; none of a bank so large that hardly two flights have the same one.

        Those are built by the flights that need them, in a tenth of a core-second each.
        """
        bank = _checked(parameters).place.bank
        return tuple(range(bank)) if bank <= KEPT_GROUNDS else ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        _bank(parameters).terrain(shared_input)

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain below the flight."""
        return (_checked(parameters).place.terrain,)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a terrain that is not on disk."""
        return _bank(parameters).missing_bytes(shared_input)

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """The two pictures of a case with the truth of their pixels."""
        return landing_samples(_checked(parameters), streams)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One flight."""
        p = _checked(parameters)
        world = World.of(p)
        flight = Flight.of(p, world.ground.surface, streams)
        pair = take_pictures(p, world, flight, camera_optics(p.optics), streams)
        measurements = measure(p, flight, pair, streams)
        truth = GroundTruth.of(world, flight, pair, p.lander.limits)
        known = {**conditions(p, world, flight, pair, measurements, truth), **rendered(p.render.backend, pair.counts)}
        # what is left to land on where an algorithm fails to answer
        nothing = SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world)

        def judge(algorithm: str) -> Judged:
            attempt = attempted_with(
                lambda given: LANDING.make(algorithm, p.hda, p.executable, streams.case).estimate(given),
                checked_site,
                measurements,
            )
            estimate = nothing if attempt.answer is None else attempt.answer
            row = {
                **({} if attempt.answer is None else outcome_row(attempt.answer)),
                **site_row(estimate, flight, truth),
                **landing_row(p, estimate, flight, truth, streams),
                **motion_row(estimate.details, flight, pair),
                **map_row(p, estimate, flight, truth),
                **times_row(estimate.details),
                **attempt.row,
            }
            if attempt.answer is not None:
                first, second = (rigid(state.attitude, state.position_m) for state in flight.states)
                case = ScoredLanding(
                    measurements=measurements,
                    answer=attempt.answer,
                    true_poses=(first, second),
                    states=flight.states,
                    ground=truth,
                )
                row |= scored(p.scores, case, {*row, *known})
            return Judged(
                outcome=attempt.outcome(lambda answer: answer.outcome.name),
                answered=attempt.answer is not None and estimate.outcome.converged,
                row=row,
                products=products(p, estimate, flight, pair, truth),
                failure=attempt.failure,
            )

        return case_result(p.algorithms, judge, known)


def _bank(parameters: BaseModel) -> TerrainBank:
    p = _checked(parameters)
    return TerrainBank(p.terrain, p.place.bank_seed)


def _checked(parameters: BaseModel) -> LandingScenarioParameters:
    if not isinstance(parameters, LandingScenarioParameters):
        raise TypeError(f"the landing scenario takes LandingScenarioParameters, not {type(parameters).__name__}")
    return parameters
