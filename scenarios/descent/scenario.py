"""Descent scenario: simulate a parachute descent and its measurements, run the algorithms, and score them."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from pydantic import BaseModel

from marsyard.algorithms.dimes import DimesDetails
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.case_evaluation import Score, evaluate_case
from marsyard.scenarios.condition_columns import contrast_columns, hash_images, image_columns
from marsyard.scenarios.descent.conditions import conditions, instrument_errors
from marsyard.scenarios.descent.faults import add_terrain_fault
from marsyard.scenarios.descent.flight import create_flight, gravity_m_s2, states_at_images
from marsyard.scenarios.descent.images import camera_optics, take_exposures
from marsyard.scenarios.descent.overlap import overlap_row
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.simulation import Descent, draw_detector
from marsyard.scenarios.descent.timeline import descent_timeline
from marsyard.scenarios.descent.touchdown import compute_touchdown, propagate_to_firing
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.image_samples import ImageSample, pixel_sample
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, SCORE, PartKind
from marsyard.scenarios.parts.scores import ScoredDescent
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.scenarios.velocity import VELOCITY, run_estimator
from marsyard.scenarios.velocity_score import (
    consistency_row,
    stream_products,
    stream_row,
    velocity_products,
    velocity_row,
)
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
            **overlap_row(p, descent.world, descent.states),
            **conditions(p, descent.world, descent.states, descent.at_firing, descent.instruments),
            **contrast_columns(descent.images[0], p.detector),
            **instrument_errors(p, descent.world, descent.states, descent.measurements),
            **descent.flight.row,
            **image_columns(p.render.backend, hash_images(descent.images)),
        }

        def run(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            return run_estimator(partial(p.make, algorithm, streams.case), descent.measurements, p.triple_indices)

        return evaluate_case(p, shared, run, lambda name, runs: _score_answer(descent, runs[name].answer))


def _score_answer(descent: Descent, estimate: VelocityEstimate | None) -> Score:
    """Score the answer of an algorithm, None for a failure."""
    p, state_at_firing, measurements = descent.p, descent.at_firing, descent.measurements
    velocity = None if estimate is None else estimate.velocity_m_s
    truth = descent.truth((estimate and estimate.span_s) or measurements.last_interval_s)
    propagated = propagate_to_firing(estimate, descent.instruments, state_at_firing.time_s, gravity_m_s2(p))
    available_s, firing_truth = state_at_firing.time_s - descent.states[-1].time_s, state_at_firing.velocity_m_s[:2]
    landing = compute_touchdown(p.landing, firing_truth, propagated, available_s, descent.streams.generator("landing"))
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
