"""Scenario of a parachute descent: world, motion, pictures, measurements, estimate, landing, score."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.algorithms.dimes import DimesDetails
from marsyard.scenarios.algorithm_run import case_result
from marsyard.scenarios.base import TerrainScenario, algorithm_result
from marsyard.scenarios.conditions import deliver, faulty_detector, hash_images, picture_columns
from marsyard.scenarios.descent.exposure import World, camera_optics, take_exposures
from marsyard.scenarios.descent.flight import DescentFlight, create_flight, picture_states, true_velocity
from marsyard.scenarios.descent.measurement import Instruments, measure
from marsyard.scenarios.descent.parameters import DescentScenarioParameters, faulty_terrain
from marsyard.scenarios.descent.score import (
    Pictures,
    conditions,
    feasible_overlap_row,
    instrument_errors,
    propagate_to_firing,
    touchdown,
)
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.exposure import Optics, Sample, pixel_sample
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredDescent, compute_scores
from marsyard.scenarios.velocity import (
    Horizontal,
    Span,
    consistency_row,
    run_estimator,
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
    """Parachute descent with pictures and measurements for a velocity estimator."""

    name = "descent"
    parameters_type = DescentScenarioParameters
    task = VELOCITY
    part_keys: Mapping[str, Kind] = {
        "flight.motion": DYNAMICS,
        "altimeter.instrument": INSTRUMENT,
        "attitude_source.instrument": INSTRUMENT,
        "scores": SCORE,
    }

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains."""
        return tuple(range(self.check_parameters(parameters).location.bank))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain below the descent; none with dunes of a fault, which are not in the bank."""
        p = self.check_parameters(parameters)
        return (p.location.terrain,) if faulty_terrain(p.faults, p.terrain) == p.terrain else ()

    def input_terrain(self, p: DescentScenarioParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """A terrain of the bank."""
        return TerrainBank(p.terrain, p.location.bank_seed), shared_input

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """Pictures of a case without delivery faults, with the truth of their pixels."""
        p = self.check_parameters(parameters)
        world = World.of(p)
        states = picture_states(p, create_flight(p, world.surface, streams))
        optics = camera_optics(p.camera)
        camera = optics.camera.bin(columns=1, rows=p.detector.rows_summed)
        exposed = take_exposures(p, world, states, optics, draw_detector(p, optics, streams), streams)
        for state, (counts, frame) in zip(states, exposed, strict=True):
            pose = frame.world_from_body
            about: dict[str, Any] = {
                "site": p.site or "plain",
                "time_s": state.time_s,
                # the camera's axes are the body's, rotated by the alignment error
                "position_m": np.asarray(pose.translation).tolist(),
                "world_from_body_xyzw": pose.rotation.as_quat().tolist(),
                "velocity_m_s": state.velocity_m_s.tolist(),
                "sun_direction": world.sun.direction.tolist(),
            }
            yield pixel_sample(counts, frame, p.detector, camera, about)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one descent and score all algorithms."""
        p = self.check_parameters(parameters)
        descent = Descent.simulate(p, streams)
        shared = {
            **descent.overlap,
            **conditions(p, descent.world, descent.states, descent.at_firing, descent.instruments),
            **instrument_errors(descent.world, descent.states, descent.measurements),
            **descent.flight.row,
            **picture_columns(p.render.backend, hash_images(descent.pictures)),
        }
        return case_result(p.algorithms, lambda algorithm: _score_algorithm(descent, algorithm, shared), shared)


def draw_detector(p: DescentScenarioParameters, optics: Optics, streams: Streams) -> Detector:
    """Draw the pixel response of a case's detector, its faults included."""
    settings = faulty_detector(p.faults, p.detector)
    return Detector.draw(optics.fall_off, settings, streams.generator("detector response"))


@dataclass(frozen=True)
class Descent:
    """A simulated descent and its measurements.

    - states, pictures: truth at the pictures, and the pictures as delivered
    - overlap: columns of `feasible_overlap_row`, empty without three pictures
    """

    p: DescentScenarioParameters
    streams: Streams
    world: World
    flight: DescentFlight
    instruments: Instruments
    states: Sequence[State]
    pictures: Pictures
    measurements: DescentMeasurements
    overlap: Mapping[str, Scalar]

    @classmethod
    def simulate(cls, p: DescentScenarioParameters, streams: Streams) -> Descent:
        """Simulate a case."""
        world = World.of(p)
        flight = create_flight(p, world.surface, streams)
        states = picture_states(p, flight)
        optics = camera_optics(p.camera)
        detector = draw_detector(p, optics, streams)
        exposed = take_exposures(p, world, states, optics, detector, streams)
        pictures = deliver([counts for counts, _ in exposed], p.faults.repeated_picture, p.faults.black_picture)
        instruments = Instruments.draw(p, world, flight, streams)
        measurements = measure(p, world, flight.motion, pictures, detector, instruments, streams)
        overlap: Mapping[str, Scalar] = {}
        if p.triple_indices is not None:
            three = [states[index] for index in p.triple_indices]
            camera = optics.camera.bin(columns=1, rows=p.detector.rows_summed)
            overlap = feasible_overlap_row(three, world, camera, detector.calibration, p.dimes)
        return cls(p, streams, world, flight, instruments, states, pictures, measurements, overlap)

    @cached_property
    def at_firing(self) -> State:
        """True state at the thrusters' firing."""
        return self.flight.motion.state(self.flight.firing_s)

    def truth(self, span_s: Span) -> Horizontal:
        """True horizontal velocity over a span of time tags."""
        return true_velocity(self.flight.motion, self.states, self.measurements.tags_s, span_s)


def _score_algorithm(descent: Descent, algorithm: str, shared: Mapping[str, Scalar]) -> CaseResult:
    p, firing, measurements = descent.p, descent.at_firing, descent.measurements
    make = partial(VELOCITY.make, algorithm, p.dimes, p.executable, descent.streams.case)
    attempt = run_estimator(make, measurements, p.triple_indices)
    estimate = attempt.answer
    velocity = None if estimate is None else estimate.velocity_m_s
    true = descent.truth((estimate and estimate.span_s) or measurements.last_interval_s)
    propagated = propagate_to_firing(estimate, descent.instruments, firing.time_s)
    available_s, at_firing = firing.time_s - descent.states[-1].time_s, firing.velocity_m_s[:2]
    landed = touchdown(p.landing, at_firing, propagated, available_s, descent.streams.generator("landing"))
    row = {
        **velocity_row("velocity", velocity, true),
        **consistency_row(estimate, true),
        **velocity_row("firing_velocity", propagated, at_firing),
        "touchdown_speed_corrected_m_s": float(np.hypot(*landed.with_answer)),
        "touchdown_speed_uncorrected_m_s": float(np.hypot(*landed.without_answer)),
        "answer_punctual": landed.punctual,
        # the measured computation time, scaled to the flight computer
        "answer_in_time": p.landing.processor_factor * float(attempt.row["estimation_time_s"]) <= available_s,
        **stream_row(estimate, descent.truth),
        **attempt.row,
    }
    if estimate is not None:
        case = ScoredDescent(
            measurements=measurements,
            answer=estimate,
            true_velocity_m_s=true,
            states=tuple(descent.states),
            motion=descent.flight.motion,
            at_firing=firing,
            touchdown_m_s=landed.with_answer,
        )
        row |= compute_scores(p.scores, case, {*row, *shared})
    # figures show the three pictures of DIMES' input, or all of other algorithms
    is_dimes = estimate is not None and isinstance(estimate.details, DimesDetails)
    shown = p.triple_indices if is_dimes and p.triple_indices is not None else range(len(descent.pictures))
    pictures = [descent.pictures[index] for index in shown]
    products = {**velocity_products(pictures, estimate, true), **stream_products(estimate, descent.truth)}
    return algorithm_result(attempt, velocity is not None, row, products)
