"""One descent, step by step: world, motion, pictures, measurements, estimate, landing, score."""

from __future__ import annotations

import time

from pydantic import BaseModel

from scenarios.descent.exposure import expose
from scenarios.descent.faults import faulty_detector
from scenarios.descent.flight import flown_descent, picture_states
from scenarios.descent.landing import touchdown
from scenarios.descent.measurement import Instruments, measure
from scenarios.descent.optics import camera_optics
from scenarios.descent.parameters import DescentScenarioParameters
from scenarios.descent.room import room
from scenarios.descent.score import (
    carried_to_firing,
    conditions,
    instrument_conditions,
    instrument_errors,
    landing_row,
    products,
    provenance,
    score,
)
from scenarios.descent.world import World
from scenarios.estimators import velocity_estimator
from scenarios.interface import CaseResult
from sim.sensor import Detector
from sim.streams import Streams
from sim.terrain import TerrainBank


class DescentScenario:
    """Three pictures of a parachute descent, measured and given to a velocity estimator."""

    name = "descent"
    parameters_type = DescentScenarioParameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains."""
        return tuple(range(_checked(parameters).place.bank))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        p = _checked(parameters)
        TerrainBank(p.terrain, p.place.bank_seed).terrain(shared_input)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One descent."""
        p = _checked(parameters)
        world = World.of(p)
        descent = flown_descent(p, world.surface, streams)
        states = picture_states(p, descent)
        at_firing = descent.state(descent.thruster_firing_s)
        optics = camera_optics(p.camera)
        settings = faulty_detector(p.faults, p.detector)
        detector = Detector.drawn(optics.fall_off, settings, streams.generator("detector response"))
        pictures = expose(p, world, states, optics, detector, streams)
        instruments = Instruments.drawn(p, world, descent, streams)
        measurements = measure(p, world, descent, pictures, detector, instruments, streams)
        started = time.process_time()
        estimate = velocity_estimator(p.algorithm, p.dimes).estimate(measurements)
        taken = time.process_time() - started
        carried = carried_to_firing(estimate, measurements, instruments, at_firing.time_s)
        landed = touchdown(
            p.landing,
            at_firing.velocity_m_s[:2],
            carried,
            at_firing.time_s - states[-1].time_s,
            streams.generator("landing"),
        )
        camera = optics.camera.binned(columns=1, rows=p.detector.rows_summed)
        places = room(states, world.surface, camera, detector.calibration, world.sun.direction, p.dimes)
        row = {
            **score(estimate, states, carried, at_firing),
            "room": min(places) > 0,
            "room_first_pair": places[0],
            "room_second_pair": places[1],
            **conditions(p, world, states, at_firing),
            **instrument_conditions(instruments),
            **instrument_errors(world, states, measurements),
            **landing_row(landed),
            "estimation_time_s": taken,
            **{f"descent_{name}": value for name, value in descent.parameters.model_dump().items()},
            **provenance(p, pictures),
        }
        return CaseResult(
            outcome=estimate.outcome.name,
            answered=estimate.velocity_m_s is not None,
            row=row,
            products=products(pictures, estimate, states),
        )


def _checked(parameters: BaseModel) -> DescentScenarioParameters:
    if not isinstance(parameters, DescentScenarioParameters):
        raise TypeError(f"the descent scenario takes DescentScenarioParameters, not {type(parameters).__name__}")
    return parameters
