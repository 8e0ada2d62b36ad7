"""Triple of images of a run, and the measurements of an estimator (paper, III.D)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.run import FieldRun
from marsyard.scenarios.fieldtest.triples import Triple
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import Detector


@dataclass(frozen=True)
class TripleCase:
    """A triple of a run, and the true states at its images."""

    run: FieldRun
    triple: Triple
    states: tuple[State, State, State]


def truth_velocities(p: FieldTestParameters, case: TripleCase) -> Float64[np.ndarray, "2 3"]:
    """Compute the paper's truth velocities: GPS differences divided by the virtual interval, world axes (III.D.5).

    The images of a triple are not consecutive, so the time between them has no meaning for an inertial unit. The paper
    assigns a fixed virtual interval to each pair.
    """
    fixes = case.run.images.position_m[list(case.triple.image_indices)]
    return np.asarray(np.diff(fixes, axis=0) / p.triples.virtual_interval_s)


def measure(
    p: FieldTestParameters,
    case: TripleCase,
    images: Sequence[UInt16[np.ndarray, "rows columns"]],
    detector: Detector,
    camera: CameraModel,
    rng: np.random.Generator,
) -> DescentMeasurements:
    """Create an estimator's inputs: time tags at the virtual interval, calibrated camera, sun of each image (III.D).

    The inertial velocities are the paper's truth velocities plus a constant horizontal error, drawn from `rng`: "biased
    IMU velocities" (III.D.3), because an inertial unit measures changes of velocity, but does not know the wind.
    Without the error the truth would be an input.
    """
    bias = np.append(p.triples.velocity_bias_m_s * rng.standard_normal(2), 0.0)
    tags = [number * p.triples.virtual_interval_s for number in range(len(images))]
    indices_and_tags = list(zip(case.triple.image_indices, tags, strict=True))
    altitudes = case.run.images.altitude_m
    suns = np.stack([case.run.flown.sun(state.time_s) for state in case.states])
    return DescentMeasurements(
        images=tuple(
            DetectorImage(counts, tag, camera, detector.calibration) for counts, tag in zip(images, tags, strict=True)
        ),
        attitudes=tuple(AttitudeMeasurement(case.run.attitudes[index], tag) for index, tag in indices_and_tags),
        altitudes=tuple(AltitudeMeasurement(float(altitudes[index]), tag) for index, tag in indices_and_tags),
        interval_velocities_m_s=truth_velocities(p, case) + bias,
        sun_direction=suns[1],
        sun_directions=suns,
    )
