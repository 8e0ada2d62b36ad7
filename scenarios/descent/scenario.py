"""Descent scenario: simulate a parachute descent and its measurements, run the algorithms, and score them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.algorithms.dimes import DimesDetails
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.base import TerrainScenario
from marsyard.scenarios.cameras import Optics
from marsyard.scenarios.case_evaluation import Score, evaluate_case
from marsyard.scenarios.case_faults import add_detector_faults, corrupt_images
from marsyard.scenarios.condition_columns import contrast_columns, hash_images, image_columns
from marsyard.scenarios.descent import score
from marsyard.scenarios.descent.flight import (
    DescentFlight,
    create_flight,
    gravity_m_s2,
    states_at_images,
    true_velocity,
)
from marsyard.scenarios.descent.images import camera_optics, take_exposures
from marsyard.scenarios.descent.measurement import DescentInstruments, add_increments, measure, measure_exactly
from marsyard.scenarios.descent.overlap import overlap_row
from marsyard.scenarios.descent.parameters import DescentScenarioParameters, add_terrain_fault
from marsyard.scenarios.descent.timeline import descent_timeline
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.image_samples import ImageSample, pixel_sample
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, SCORE, PartKind
from marsyard.scenarios.parts.scores import ScoredDescent
from marsyard.scenarios.velocity import (
    VELOCITY,
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


class DescentScenario(TerrainScenario[DescentScenarioParameters]):
    """Parachute descent with images and measurements for a velocity estimator."""

    name = "descent"
    parameters_type = DescentScenarioParameters
    task = VELOCITY
    part_keys: Mapping[str, PartKind] = {
        "flight.motion": DYNAMICS,
        "altimeter.instrument": INSTRUMENT,
        "attitude_source.instrument": INSTRUMENT,
        "scores": SCORE,
    }

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the index of the terrain below the descent; empty with the dune fault, whose terrain is in no bank."""
        p = self.check_parameters(parameters)
        return (p.location.terrain,) if add_terrain_fault(p.faults, p.terrain) == p.terrain else ()

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[ImageSample]:
        """Yield the images of a case, without transmission faults, and the ground truth of their pixels."""
        p = self.check_parameters(parameters)
        world = DescentWorld.from_parameters(p)
        states = states_at_images(p, create_flight(p, world.surface, streams))
        optics = camera_optics(p.camera)
        camera = p.detector.delivered_camera(optics.camera)
        exposures = take_exposures(p, world, states, optics, draw_detector(p, optics, streams), streams)
        for state, (counts, frame) in zip(states, exposures, strict=True):
            pose = frame.world_from_body
            metadata: dict[str, Any] = {
                "site": p.site or "plain",
                "time_s": state.time_s,
                # pose of the camera: body pose, rotated by the alignment error
                "position_m": np.asarray(pose.translation).tolist(),
                "world_from_body_xyzw": pose.rotation.as_quat().tolist(),
                "velocity_m_s": state.velocity_m_s.tolist(),
                "sun_direction": world.sun.direction.tolist(),
            }
            yield pixel_sample(counts, frame, p.detector, camera, metadata)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one descent and score all algorithms."""
        p = self.check_parameters(parameters)
        descent = Descent.simulate(p, streams)
        shared = {
            **descent.overlap,
            **score.conditions(p, descent.world, descent.states, descent.at_firing, descent.instruments),
            **contrast_columns(descent.images[0], p.detector),
            **score.instrument_errors(descent.world, descent.states, descent.measurements),
            **descent.flight.row,
            **image_columns(p.render.backend, hash_images(descent.images)),
        }

        def run(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            return run_estimator(partial(p.make, algorithm, streams.case), descent.measurements, p.triple_indices)

        return evaluate_case(p, shared, run, lambda name, runs: _score_answer(descent, runs[name].answer))


def draw_detector(p: DescentScenarioParameters, optics: Optics, streams: Streams) -> Detector:
    """Draw the detector of a case: pixel response and faults."""
    parameters = add_detector_faults(p.faults, p.detector)
    return Detector.draw(optics.fall_off, parameters, streams.generator("detector response"))


@dataclass(frozen=True)
class Descent:
    """A simulated descent and its measurements, which all algorithms of a case use.

    - p: parameters of the case
    - states, images: true states at the images, and the delivered images
    - overlap: columns of `overlap_row`, empty if there are fewer than three images
    """

    p: DescentScenarioParameters
    streams: Streams
    world: DescentWorld
    flight: DescentFlight
    instruments: DescentInstruments
    states: Sequence[State]
    images: score.Images
    measurements: DescentMeasurements
    overlap: Mapping[str, Scalar]

    @classmethod
    def simulate(cls, p: DescentScenarioParameters, streams: Streams) -> Descent:
        """Simulate the descent of a case and its measurements."""
        world = DescentWorld.from_parameters(p)
        flight = create_flight(p, world.surface, streams)
        states = states_at_images(p, flight)
        optics = camera_optics(p.camera)
        detector = draw_detector(p, optics, streams)
        exposures = [counts for counts, _ in take_exposures(p, world, states, optics, detector, streams)]
        images = corrupt_images(exposures, p.faults.repeated_image, p.faults.black_image)
        instruments = DescentInstruments.draw(p, world, flight, streams)
        if p.exact_instruments:
            measurements = measure_exactly(p, world, states, images, detector)
        else:
            measurements = measure(p, world, flight.motion, images, detector, instruments, streams)
        measurements = add_increments(measurements, p, flight, streams)
        overlap: Mapping[str, Scalar] = {}
        if p.triple_indices is not None:
            triple = [states[index] for index in p.triple_indices]
            overlap = overlap_row(triple, world, optics.camera)
        return cls(p, streams, world, flight, instruments, states, images, measurements, overlap)

    @cached_property
    def at_firing(self) -> State:
        """True state at the thrusters' firing."""
        return self.flight.motion.state(self.flight.firing_s)

    def truth(self, span_s: Span) -> Horizontal:
        """Compute the true horizontal velocity over a span of time tags."""
        return true_velocity(self.flight.motion, self.states, self.measurements.tags_s, span_s)


def _score_answer(descent: Descent, estimate: VelocityEstimate | None) -> Score:
    """Score the answer of an algorithm, None for a failure."""
    p, state_at_firing, measurements = descent.p, descent.at_firing, descent.measurements
    velocity = None if estimate is None else estimate.velocity_m_s
    truth = descent.truth((estimate and estimate.span_s) or measurements.last_interval_s)
    propagated = score.propagate_to_firing(estimate, descent.instruments, state_at_firing.time_s, gravity_m_s2(p))
    available_s, firing_truth = state_at_firing.time_s - descent.states[-1].time_s, state_at_firing.velocity_m_s[:2]
    landing = score.compute_touchdown(
        p.landing, firing_truth, propagated, available_s, descent.streams.generator("landing")
    )
    row = {
        **velocity_row("velocity", velocity, truth),
        **consistency_row(estimate, truth),
        **velocity_row("firing_velocity", propagated, firing_truth),
        "touchdown_speed_corrected_m_s": float(np.hypot(*landing.with_answer)),
        "touchdown_speed_uncorrected_m_s": float(np.hypot(*landing.without_answer)),
        "in_time_assumed": landing.is_in_time,
        **stream_row(estimate, descent.truth),
    }
    scored = None
    if estimate is not None:
        scored = ScoredDescent(
            measurements=measurements,
            answer=estimate,
            true_velocity_m_s=truth,
            states=tuple(descent.states),
            motion=descent.flight.motion,
            at_firing=state_at_firing,
            touchdown_m_s=landing.with_answer,
        )
    # figures show the three input images of DIMES, or all images of other algorithms
    is_dimes = estimate is not None and isinstance(estimate.details, DimesDetails)
    indices = p.triple_indices if is_dimes and p.triple_indices is not None else range(len(descent.images))
    images = [descent.images[index] for index in indices]
    products = {**velocity_products(images, estimate, truth), **stream_products(estimate, descent.truth)}
    return Score(velocity is not None, row, products, scored, lambda: descent_timeline(descent, estimate))
