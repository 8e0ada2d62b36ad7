"""Measurements for the checks of estimators: a textured plane, and pictures that show nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.scenarios.conformance.surfaces import TexturedPlane
from marsyard.sim.frames import direction, rigid
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    AttitudeMeasurement,
    DescentMeasurements,
    DetectorCalibration,
    DetectorImage,
    LandingMeasurements,
    PoseMeasurement,
)
from marsyard.sim.sensor import Detector, natural_fall_off, preset
from marsyard.sim.sensor.presets import Preset

Measurements = TypeVar("Measurements", DescentMeasurements, LandingMeasurements)

#: Mean velocity of the descent, of its wind and fall, east, north, up, m/s.
DESCENT_VELOCITY_M_S = np.array([12.0, -7.0, -75.0])
#: Time between pictures, at most, and from the first to the last, at most, s.
_INTERVAL_S, _LASTS_S = 3.75, 7.5
#: Attitudes that the pictures are taken in, in turn: about z, y and x, degrees.
_TURNS_DEG = ((40, 4, -3), (44, 2, 3), (41, -3, 5))
_FIRST_M = np.array([0.0, 0.0, 1900.0])

#: Where the landing's two pictures are taken, metres.
_HOVER_M = np.array([[0.0, 0.0, 30.0], [1.2, 0.2, 29.8]])

#: Counts of a picture as a function of the detector's calibration.
Blank = Callable[[DetectorCalibration], int]

#: Pictures that show nothing, by name: their count.
BLANKS: dict[str, Blank] = {
    "featureless": lambda known: round(0.4 * known.full_scale_dn),
    "dark": lambda known: round(known.offset_dn),
    "saturated": lambda known: known.full_scale_dn,
}


@cache
def descent(pictures: int = 3) -> DescentMeasurements:
    """Descent pictures of level, textured ground; instruments without errors but in the inertial velocity."""
    apart_s = min(_INTERVAL_S, _LASTS_S / (pictures - 1))
    places = _FIRST_M + apart_s * np.arange(pictures)[:, None] * DESCENT_VELOCITY_M_S
    turned = [_TURNS_DEG[number % len(_TURNS_DEG)] for number in range(pictures)]
    turns = [Rotation.from_euler("ZYX", angles, degrees=True) for angles in turned]
    times = [100.0 + apart_s * number for number in range(pictures)]
    inertial = DESCENT_VELOCITY_M_S + np.array([9.0, -4.0, 0.0])
    return DescentMeasurements(
        images=tuple(_pictures(preset("mer-descent-flown"), places, turns, times, 2.0)),
        attitudes=tuple(AttitudeMeasurement(turn, time) for turn, time in zip(turns, times, strict=True)),
        altitudes=tuple(AltitudeMeasurement(float(place[2]), time) for place, time in zip(places, times, strict=True)),
        interval_velocities_m_s=np.tile(inertial, (pictures - 1, 1)),
        sun_direction=direction(np.radians(250.0), np.radians(35.0)),
        inertial_velocities_m_s=np.tile(inertial, (pictures, 1)),
    )


@cache
def landing() -> LandingMeasurements:
    """Two pictures of level, textured ground from a helicopter; instruments without errors."""
    turns = [Rotation.from_euler("ZYX", angles, degrees=True) for angles in ((10, 3, -2), (10.2, 2.8, -1.9))]
    times = [0.0, 2.0]
    first, second = _pictures(preset("xc-55"), _HOVER_M, turns, times, 0.03)
    poses = [
        PoseMeasurement(rigid(turn, place), time) for turn, place, time in zip(turns, _HOVER_M, times, strict=True)
    ]
    axis = turns[0].apply(first.camera.a.copy())
    slant = -_HOVER_M[0, 2] / axis[2]
    return LandingMeasurements(
        images=(first, second),
        poses=(poses[0], poses[1]),
        slant_range_m=float(slant),
        up_body=np.asarray(turns[0].inv().apply([0.0, 0.0, 1.0])),
        apriori_site_world=np.asarray(_HOVER_M[0] + slant * axis),
    )


def _pictures(
    chosen: Preset, places: np.ndarray, turns: Sequence[Rotation], times: Sequence[float], step_m: float
) -> list[DetectorImage]:
    """Pictures through a preset's camera, from these places with these attitudes."""
    (camera,) = chosen.cameras()
    ground = TexturedPlane(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), step_m)
    rng = np.random.default_rng(1)
    detector = Detector.drawn(natural_fall_off(camera), chosen.detector, rng)
    delivered = camera.binned(columns=1, rows=chosen.detector.rows_summed)
    return [
        DetectorImage(
            detector.expose(ground.radiance(camera.moved(rigid(turn, place))), rng),
            time,
            delivered,
            detector.calibration,
        )
        for place, turn, time in zip(places, turns, times, strict=True)
    ]


def blanked(measurements: Measurements, blank: Blank) -> Measurements:
    """The measurements with pictures that show nothing."""
    return _repictured(measurements, lambda one: np.full(one.counts.shape, blank(one.calibration), np.uint16))


def noisy(measurements: Measurements) -> Measurements:
    """The measurements with pictures of which nothing is left but noise."""
    rng = np.random.default_rng(2)
    return _repictured(
        measurements,
        lambda one: rng.integers(0, one.calibration.full_scale_dn, one.counts.shape, np.uint16, endpoint=True),
    )


def _repictured(measurements: Measurements, counts: Callable[[DetectorImage], np.ndarray]) -> Measurements:
    """The measurements with other counts in their pictures."""
    images: Any = tuple(replace(one, counts=counts(one)) for one in measurements.images)
    return replace(measurements, images=images)
