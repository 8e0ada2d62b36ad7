"""A synthetic descent of constant velocity and attitude, over which position estimators of tests run."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import AltitudeMeasurement, DetectorCalibration, DetectorImage, ImuIncrements
from tests.algorithms.localisation.synthetic_map import make_camera

GRAVITY_M_S2, RATE_HZ = 3.71, 100
START_M, VELOCITY_M_S = np.array([150.0, -100.0, 1700.0]), np.array([12.0, -8.0, -60.0])
ATTITUDE = Rotation.from_euler("zyx", [25.0, 4.0, -3.0], degrees=True)
ERROR_M = np.array([110.0, -70.0, 15.0])  #: True minus initial position.
STUB_CAMERA = make_camera(64)
FLAT_MAP = MapProduct(
    np.ones((300, 300), np.float32), np.zeros((300, 300), np.float32), np.array([-900.0, -900.0]), 6.0, 0.0, 0.0, 0.0
)


def true_position(time_s: float) -> np.ndarray:
    return START_M + VELOCITY_M_S * time_s


def make_initial(**changes: Any) -> InitialState:
    """Initial state with the error `ERROR_M` of the position; velocity and attitude are exact."""
    variances = [1e4, 1e4, 400.0, *[0.01] * 3, *[1e-6] * 3]
    initial = InitialState(0.0, START_M - ERROR_M, VELOCITY_M_S, ATTITUDE, np.diag(variances), GRAVITY_M_S2)
    return replace(initial, **changes)


def make_increments(first_s: float, last_s: float) -> ImuIncrements:
    """Exact increments of a flight with constant velocity and attitude."""
    times = np.linspace(first_s, last_s, round((last_s - first_s) * RATE_HZ) + 1)
    force = ATTITUDE.inv().apply([0.0, 0.0, GRAVITY_M_S2])
    velocities = np.diff(times)[:, np.newaxis] * force
    return ImuIncrements(times, 1.0 / RATE_HZ, np.zeros_like(velocities), velocities)


def make_image(time_s: float, radiance: np.ndarray, camera: CameraModel = STUB_CAMERA) -> DetectorImage:
    calibration = DetectorCalibration(np.ones(radiance.shape), 150e-6, 0.0, 0.0, 1, 0.0, 4095)
    return DetectorImage(np.rint(1000.0 * radiance).astype(np.uint16), time_s, camera, calibration)


def descend(
    estimator: InertialEstimator | MapRelativeEstimator,
    map_product: MapProduct,
    images: Sequence[DetectorImage],
    initial: InitialState | None = None,
    *,
    with_altitudes: bool = True,
) -> Iterator[PositionEstimate]:
    """Run an estimator over images, each with an exact altitude before it; yield each estimate, and the final one."""
    estimator.start(make_initial() if initial is None else initial, map_product)
    previous_s = 0.0
    for image in images:
        estimator.process_increments(make_increments(previous_s, image.time_s))
        previous_s = image.time_s
        position = true_position(image.time_s)
        if with_altitudes:
            height = float(position[2]) - elevation_at(map_product, position[:2])
            estimator.process_altitude(AltitudeMeasurement(height, image.time_s))
        yield estimator.process_image(image)
    yield estimator.finish()


def make_images(count: int) -> list[DetectorImage]:
    """Create uniform images, one per second, for the replaced stages."""
    return [make_image(1.0 + number, np.ones((64, 64))) for number in range(count)]


def list_outcomes(estimates: Sequence[PositionEstimate]) -> list[PositionOutcome]:
    return [estimate.outcome for estimate in estimates]


def position_error_m(estimate: PositionEstimate) -> float:
    return float(np.linalg.norm(estimate.position_m - true_position(estimate.time_s)))
