"""Simulated descent with its images and measurements, which all algorithms of a case use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from marsyard.scenarios.cameras import Optics
from marsyard.scenarios.case_faults import Images, add_detector_faults, corrupt_images
from marsyard.scenarios.descent.flight import DescentFlight, create_flight, states_at_images, true_velocity
from marsyard.scenarios.descent.images import camera_optics, take_exposures
from marsyard.scenarios.descent.measurements import DescentInstruments, add_increments, measure, measure_exactly
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.velocity_score import Horizontal, Span
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams


def draw_detector(p: DescentScenarioParameters, optics: Optics, streams: Streams) -> Detector:
    """Draw the detector of a case: pixel response and faults."""
    parameters = add_detector_faults(p.faults, p.detector)
    return Detector.draw(optics.fall_off, parameters, streams.generator("detector response"))


@dataclass(frozen=True)
class Descent:
    """A simulated descent and its measurements, which all algorithms of a case use.

    - p: parameters of the case
    - states, images: true states at the images, and the delivered images
    """

    p: DescentScenarioParameters
    streams: Streams
    world: DescentWorld
    flight: DescentFlight
    instruments: DescentInstruments
    states: Sequence[State]
    images: Images
    measurements: DescentMeasurements

    @classmethod
    def simulate(cls, p: DescentScenarioParameters, streams: Streams) -> Descent:
        """Simulate the descent of a case and its measurements."""
        world = DescentWorld.from_parameters(p)
        flight = create_flight(p, world.surface, streams)
        states = states_at_images(p, flight)
        optics = camera_optics(p.camera)
        detector = draw_detector(p, optics, streams)
        exposures = [counts for counts, _ in take_exposures(p, world, states, optics, detector, streams)]
        images = corrupt_images(exposures, repeated=p.faults.repeated_image, black=p.faults.black_image)
        instruments = DescentInstruments.draw(p, world, flight, streams)
        if p.exact_instruments:
            measurements = measure_exactly(p, world, states, images, detector)
        else:
            measurements = measure(p, world, flight.motion, images, detector, instruments, streams)
        measurements = add_increments(measurements, p, flight, streams)
        return cls(p, streams, world, flight, instruments, states, images, measurements)

    @cached_property
    def at_firing(self) -> State:
        """True state at the thrusters' firing."""
        return self.flight.motion.state(self.flight.firing_s)

    def truth(self, span_s: Span) -> Horizontal:
        """Compute the true horizontal velocity over a span of time tags."""
        return true_velocity(self.flight.motion, self.states, self.measurements.tags_s, span_s)
