"""One descent, step by step: world, motion, pictures, measurements, estimate, landing, score."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from pydantic import BaseModel

from marsyard.scenarios.descent.exposure import expose
from marsyard.scenarios.descent.faults import faulty_detector, faulty_terrain
from marsyard.scenarios.descent.flight import flown_descent, picture_states, true_velocity
from marsyard.scenarios.descent.landing import touchdown
from marsyard.scenarios.descent.measurement import Instruments, measure
from marsyard.scenarios.descent.optics import camera_optics
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.room import room
from marsyard.scenarios.descent.samples import descent_samples
from marsyard.scenarios.descent.score import (
    carried_to_firing,
    conditions,
    instrument_conditions,
    instrument_errors,
    landing_row,
    room_row,
    shown,
)
from marsyard.scenarios.descent.world import World
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredDescent, scored
from marsyard.scenarios.provenance import rendered
from marsyard.scenarios.samples import Sample
from marsyard.scenarios.trial import Judged, case_result
from marsyard.scenarios.velocity import (
    Horizontal,
    Span,
    asked,
    consistency_row,
    stream_products,
    stream_row,
    velocity_products,
    velocity_row,
)
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class DescentScenario:
    """Pictures of a parachute descent, three or as many as asked for, measured and given to a velocity estimator."""

    name = "descent"
    parameters_type = DescentScenarioParameters
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {
        "flight.motion": DYNAMICS,
        "altimeter.instrument": INSTRUMENT,
        "attitude_source.instrument": INSTRUMENT,
        "scores": SCORE,
    }

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains."""
        return tuple(range(_checked(parameters).place.bank))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        _bank(parameters).terrain(shared_input)

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain below the descent; none where a fault puts dunes on it, which is no terrain of the bank."""
        p = _checked(parameters)
        return (p.place.terrain,) if faulty_terrain(p.faults, p.terrain) == p.terrain else ()

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a terrain that is not on disk."""
        return _bank(parameters).missing_bytes(shared_input)

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """The pictures of a case with the truth of their pixels."""
        return descent_samples(_checked(parameters), streams)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One descent."""
        p = _checked(parameters)
        world = World.of(p)
        flown = flown_descent(p, world.surface, streams)
        states = picture_states(p, flown)
        at_firing = flown.motion.state(flown.firing_s)
        optics = camera_optics(p.camera)
        settings = faulty_detector(p.faults, p.detector)
        detector = Detector.drawn(optics.fall_off, settings, streams.generator("detector response"))
        pictures = expose(p, world, states, optics, detector, streams)
        instruments = Instruments.drawn(p, world, flown, streams)
        measurements = measure(p, world, flown.motion, pictures, detector, instruments, streams)
        camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
        triple = p.triple_places
        places = None
        if triple is not None:
            three = [states[place] for place in triple]
            places = room(three, world.surface, camera, detector.calibration, world.sun.direction, p.dimes)
        conditions_row = {
            **room_row(places),
            **conditions(p, world, states, at_firing),
            **instrument_conditions(instruments),
            **instrument_errors(world, states, measurements),
            **flown.row,
            **rendered(p.render.backend, pictures),
        }

        def truth(span_s: Span) -> Horizontal:
            return true_velocity(flown.motion, states, measurements.tags_s, span_s)

        def judge(algorithm: str) -> Judged:
            make = partial(VELOCITY.make, algorithm, p.dimes, p.executable, streams.case)
            attempt = asked(make, measurements, triple)
            estimate = attempt.answer
            velocity = None if estimate is None else estimate.velocity_m_s
            span = None if estimate is None else estimate.span_s
            true = truth(span or measurements.last_interval_s)
            carried = carried_to_firing(estimate, instruments, at_firing.time_s)
            available_s = at_firing.time_s - states[-1].time_s
            velocity_at_firing = at_firing.velocity_m_s[:2]
            landed = touchdown(p.landing, velocity_at_firing, carried, available_s, streams.generator("landing"))
            row = {
                **velocity_row("velocity", velocity, true),
                **consistency_row(estimate, true),
                **velocity_row("firing_velocity", carried, velocity_at_firing),
                **landing_row(p.landing, landed, float(attempt.row["estimation_time_s"]), available_s),
                **stream_row(estimate, truth),
                **attempt.row,
            }
            if estimate is not None:
                case = ScoredDescent(
                    measurements=measurements,
                    answer=estimate,
                    true_velocity_m_s=true,
                    states=tuple(states),
                    motion=flown.motion,
                    at_firing=at_firing,
                    touchdown_m_s=landed.with_answer,
                )
                row |= scored(p.scores, case, {*row, *conditions_row})
            return Judged(
                outcome=attempt.outcome(lambda answer: answer.outcome.name),
                answered=velocity is not None,
                row=row,
                products={
                    **velocity_products(shown(pictures, estimate, triple), estimate, true),
                    **stream_products(estimate, truth),
                },
                failure=attempt.failure,
            )

        return case_result(p.algorithms, judge, conditions_row)


def _bank(parameters: BaseModel) -> TerrainBank:
    p = _checked(parameters)
    return TerrainBank(p.terrain, p.place.bank_seed)


def _checked(parameters: BaseModel) -> DescentScenarioParameters:
    if not isinstance(parameters, DescentScenarioParameters):
        raise TypeError(f"the descent scenario takes DescentScenarioParameters, not {type(parameters).__name__}")
    return parameters
