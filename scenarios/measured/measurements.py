"""Inputs of estimators from stored cases."""

import math

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.measured.store import Quaternion, StoredCase, Vector
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    AttitudeMeasurement,
    DescentMeasurements,
    DetectorImage,
    LandingMeasurements,
    PoseMeasurement,
)


def descent_measurements(case: StoredCase, images: tuple[DetectorImage, ...]) -> DescentMeasurements:
    """Return the inputs of a velocity estimator."""
    attitudes, altitudes = [], []
    for item in case.images:
        attitudes.append(AttitudeMeasurement(item.attitude, item.time_s))
        time_s = item.time_s if item.altitude_time_s is None else item.altitude_time_s
        altitudes.append(AltitudeMeasurement(math.nan if item.altitude_m is None else item.altitude_m, time_s))
    return DescentMeasurements(
        images=images,
        attitudes=tuple(attitudes),
        altitudes=tuple(altitudes),
        interval_velocities_m_s=np.array(case.interval_velocities_m_s, dtype=np.float64),
        sun_direction=np.array(case.sun_direction, dtype=np.float64),
    )


def body_pose(position_m: Vector, xyzw: Quaternion) -> RigidTransform:
    """Return the pose of a body in the world."""
    return rigid(Rotation.from_quat(np.array(xyzw)), np.array(position_m))


def landing_measurements(case: StoredCase, images: tuple[DetectorImage, ...]) -> LandingMeasurements:
    """Return the inputs of an estimator of landing sites."""
    first, second = (PoseMeasurement(image.pose, image.time_s) for image in case.images)
    return LandingMeasurements(
        images=(images[0], images[1]),
        poses=(first, second),
        slant_range_m=math.nan if case.slant_range_m is None else case.slant_range_m,
        up_body=case.images[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0])),
        apriori_site_world=np.array(case.site_m, dtype=np.float64),
    )
