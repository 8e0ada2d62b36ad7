"""One descent, step by step: world, motion, pictures, measurements, estimate, landing, score."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.scenarios.base import TerrainScenario, judged_attempt
from marsyard.scenarios.conditions import rendered
from marsyard.scenarios.descent.exposure import expose, exposures
from marsyard.scenarios.descent.faults import faulty_terrain
from marsyard.scenarios.descent.flight import Flown, flown_descent, picture_states, true_velocity
from marsyard.scenarios.descent.landing import touchdown
from marsyard.scenarios.descent.measurement import Instruments, measure
from marsyard.scenarios.descent.optics import camera_optics
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.room import room
from marsyard.scenarios.descent.score import (
    Pictures,
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
from marsyard.scenarios.exposure import Sample, pixel_sample
from marsyard.scenarios.faults import faulty_detector
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.optics import Optics
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredDescent, scored
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
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class DescentScenario(TerrainScenario[DescentScenarioParameters]):
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
        return tuple(range(self.checked(parameters).place.bank))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain below the descent; none where a fault puts dunes on it, which is no terrain of the bank."""
        p = self.checked(parameters)
        return (p.place.terrain,) if faulty_terrain(p.faults, p.terrain) == p.terrain else ()

    def input_terrain(self, p: DescentScenarioParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """A terrain of the bank."""
        return TerrainBank(p.terrain, p.place.bank_seed), shared_input

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """The pictures of a case as the detector made them, with the truth of their pixels."""
        p = self.checked(parameters)
        world = World.of(p)
        states = picture_states(p, flown_descent(p, world.surface, streams))
        optics = camera_optics(p.camera)
        camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
        taken = exposures(p, world, states, optics, draw_detector(p, optics, streams), streams)
        for state, exposure in zip(states, taken, strict=True):
            pose = exposure.frame.world_from_body
            about: dict[str, Any] = {
                "site": p.site or "plain",
                "time_s": state.time_s,
                # the camera's axes are the body's, turned by the error of its alignment
                "position_m": np.asarray(pose.translation).tolist(),
                "world_from_body_xyzw": pose.rotation.as_quat().tolist(),
                "velocity_m_s": state.velocity_m_s.tolist(),
                "sun_direction": world.sun.direction.tolist(),
            }
            yield pixel_sample(exposure.counts, exposure.frame, p.detector, camera, about)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One descent."""
        p = self.checked(parameters)
        descent = Descent.simulated(p, streams)
        known = descent.conditions()
        return case_result(p.algorithms, lambda algorithm: _judge(descent, algorithm, known), known)


def draw_detector(p: DescentScenarioParameters, optics: Optics, streams: Streams) -> Detector:
    """The detector of a case with its faults; the response of its pixels is drawn."""
    settings = faulty_detector(p.faults, p.detector)
    return Detector.drawn(optics.fall_off, settings, streams.generator("detector response"))


@dataclass(frozen=True)
class Descent:
    """A descent, simulated and measured.

    Attributes
    ----------
    p, streams
        What it is a function of.
    world, flown, instruments
        What it was simulated with.
    states, pictures
        Truth at the pictures, and the pictures as delivered.
    measurements
        What an estimator is given.
    places
        See `room_row`.
    """

    p: DescentScenarioParameters
    streams: Streams
    world: World
    flown: Flown
    instruments: Instruments
    states: Sequence[State]
    pictures: Pictures
    measurements: DescentMeasurements
    places: tuple[int, int] | None

    @classmethod
    def simulated(cls, p: DescentScenarioParameters, streams: Streams) -> Descent:
        """Simulate a case."""
        world = World.of(p)
        flown = flown_descent(p, world.surface, streams)
        states = picture_states(p, flown)
        optics = camera_optics(p.camera)
        detector = draw_detector(p, optics, streams)
        pictures = expose(p, world, states, optics, detector, streams)
        instruments = Instruments.drawn(p, world, flown, streams)
        measurements = measure(p, world, flown.motion, pictures, detector, instruments, streams)
        places = None
        if p.triple_places is not None:
            three = [states[place] for place in p.triple_places]
            camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
            places = room(three, world.surface, camera, detector.calibration, world.sun.direction, p.dimes)
        return cls(p, streams, world, flown, instruments, states, pictures, measurements, places)

    @cached_property
    def at_firing(self) -> State:
        """Truth at the thrusters' firing."""
        return self.flown.motion.state(self.flown.firing_s)

    def conditions(self) -> dict[str, Scalar]:
        """Columns that depend on no algorithm."""
        return {
            **room_row(self.places),
            **conditions(self.p, self.world, self.states, self.at_firing),
            **instrument_conditions(self.instruments),
            **instrument_errors(self.world, self.states, self.measurements),
            **self.flown.row,
            **rendered(self.p.render.backend, self.pictures),
        }

    def truth(self, span_s: Span) -> Horizontal:
        """True horizontal velocity over a span of time tags."""
        return true_velocity(self.flown.motion, self.states, self.measurements.tags_s, span_s)


def _judge(descent: Descent, algorithm: str, known: Mapping[str, Scalar]) -> Judged:
    """Ask one algorithm, and score its answer and the landing that it leads to."""
    p, firing, measurements = descent.p, descent.at_firing, descent.measurements
    make = partial(VELOCITY.make, algorithm, p.dimes, p.executable, descent.streams.case)
    attempt = asked(make, measurements, p.triple_places)
    estimate = attempt.answer
    velocity = None if estimate is None else estimate.velocity_m_s
    true = descent.truth((estimate and estimate.span_s) or measurements.last_interval_s)
    carried = carried_to_firing(estimate, descent.instruments, firing.time_s)
    available_s, at_firing = firing.time_s - descent.states[-1].time_s, firing.velocity_m_s[:2]
    landed = touchdown(p.landing, at_firing, carried, available_s, descent.streams.generator("landing"))
    row = {
        **velocity_row("velocity", velocity, true),
        **consistency_row(estimate, true),
        **velocity_row("firing_velocity", carried, at_firing),
        **landing_row(p.landing, landed, float(attempt.row["estimation_time_s"]), available_s),
        **stream_row(estimate, descent.truth),
        **attempt.row,
    }
    if estimate is not None:
        case = ScoredDescent(
            measurements=measurements,
            answer=estimate,
            true_velocity_m_s=true,
            states=tuple(descent.states),
            motion=descent.flown.motion,
            at_firing=firing,
            touchdown_m_s=landed.with_answer,
        )
        row |= scored(p.scores, case, {*row, *known})
    pictures = shown(descent.pictures, estimate, p.triple_places)
    products = {**velocity_products(pictures, estimate, true), **stream_products(estimate, descent.truth)}
    return judged_attempt(attempt, velocity is not None, row, products)
