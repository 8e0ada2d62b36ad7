"""One descent after the other's steps: world, motion, pictures, measurements, estimate, score."""

from __future__ import annotations

from pydantic import BaseModel

from algorithms.dimes import DimesEstimator
from scenarios.descent.exposure import expose
from scenarios.descent.flight import mean_velocities, picture_states, placed_descent
from scenarios.descent.measurement import measure
from scenarios.descent.optics import camera_optics
from scenarios.descent.parameters import DescentScenarioParameters
from scenarios.descent.score import conditions, products, provenance, score
from scenarios.descent.world import World
from scenarios.interface import CaseResult
from sim.sensor import Altimeter, Detector
from sim.streams import Streams
from sim.terrain import TerrainBank


class DescentScenario:
    """Three pictures of a parachute descent, measured and given to DIMES."""

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
        descent = placed_descent(p, world.surface)
        states = picture_states(p, descent)
        optics = camera_optics(p.camera)
        detector = Detector.drawn(optics.fall_off, p.detector, streams.generator("detector response"))
        exposures = expose(p, world, states, optics, detector, streams)
        altimeter = Altimeter.drawn(p.altimeter, world.surface, streams.generator("altimeter bias"))
        measurements = measure(p, descent, exposures, world.sun, optics, detector, altimeter, streams)
        estimate = DimesEstimator().estimate(measurements)
        true_velocity = mean_velocities(states)[1]
        row = {
            **score(estimate, true_velocity),
            **conditions(p, exposures, measurements, altimeter, world.sun),
            **{f"descent_{name}": value for name, value in descent.parameters.model_dump().items()},
            **provenance(p, exposures),
        }
        return CaseResult(
            outcome=estimate.outcome.name,
            answered=estimate.velocity_m_s is not None,
            row=row,
            products=products(exposures, estimate, true_velocity),
        )


def _checked(parameters: BaseModel) -> DescentScenarioParameters:
    if not isinstance(parameters, DescentScenarioParameters):
        raise TypeError(f"the descent scenario takes DescentScenarioParameters, not {type(parameters).__name__}")
    return parameters
