"""A run of the field test: its key, its flight with clouds and sun, and the camera that all its cases share."""

from dataclasses import dataclass
from datetime import timedelta

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.cameras import camera_optics, draw_calibrated
from marsyard.scenarios.fieldtest.parameters import CAMERA, FieldTestParameters, RunParameters
from marsyard.scenarios.fieldtest.sun_position import sun_direction
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import Detector, preset
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class RunKey:
    """Inputs that determine a run: the field test, the run's index in it, the campaign's seed and name."""

    field_test: FieldTestParameters
    number: int
    seed: int
    campaign: str

    @property
    def parameters(self) -> RunParameters:
        """Parameters of the run."""
        return self.field_test.runs[self.number]

    def generator(self, name: str) -> np.random.Generator:
        """Create a generator that is the same for all cases of the run."""
        return self.shared_generator(f"run {self.parameters.name}: {name}")

    def shared_generator(self, name: str) -> np.random.Generator:
        """Create a generator that is the same for all runs and cases."""
        return Streams(self.seed, self.campaign, 0).generator(name)

    def detector(self) -> Detector:
        """Draw the detector, which is the same for all cases; a faulty cable disturbs its readout in some runs."""
        fall_off = camera_optics(field_camera()).fall_off
        rng = self.shared_generator("detector response")
        return Detector.draw(fall_off, self.field_test.run_detector(self.number), rng)

    def calibrated_camera(self) -> CameraModel:
        """Draw the calibrated camera of the delivered images in the body frame, which is the same for all cases."""
        p, rng = self.field_test, self.shared_generator("camera calibration")
        return p.detector.delivered_camera(draw_calibrated(field_camera(), p.calibration, rng))


@dataclass(frozen=True)
class FlownRun:
    """Flight and clouds of a run, before its data are processed.

    - clouds: clouds that drift with the flight's time; None for a clear sky
    - flight: the true motion
    """

    key: RunKey
    clouds: CloudLayer | None
    flight: HelicopterFlight

    @property
    def parameters(self) -> RunParameters:
        """Parameters of the run."""
        return self.key.parameters

    def sun(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Return the unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        elapsed = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + elapsed, p.latitude_deg, p.longitude_deg)


def field_camera() -> CameraModel:
    """Return the field test's camera in the body frame."""
    (camera,) = preset(CAMERA).cameras()
    return camera
