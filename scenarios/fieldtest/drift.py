"""The gyros' bias as the temperature of the inertial unit drifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.fieldtest.parameters import DriftParameters
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.sensor.imu import DEG_H, ImuIncrements


def temperature_k(
    parameters: DriftParameters, flight: HelicopterFlight, times_s: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "n"]:
    """Temperature of the unit less that over the targets, K.

    It follows the air, with a lag of first order: cooler from the end of the first pass over the targets to the end of
    the last pass along the line.
    """
    p = parameters
    start, end = flight.fly_overs_s[0][1], flight.passes[-1].end_s

    def approached(since_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        return np.asarray(-np.expm1(-np.maximum(since_s, 0.0) / p.time_constant_s))

    temperature: Float64[np.ndarray, "n"] = p.change_k * (approached(times_s - start) - approached(times_s - end))
    return temperature


def with_drift(
    increments: ImuIncrements, parameters: DriftParameters, flight: HelicopterFlight, start_s: float
) -> ImuIncrements:
    """Increments of a unit whose bias drifts as well; `start_s` is the true time of their first boundary."""
    count = len(increments.delta_angles_rad)
    middles = start_s + increments.period_s * (np.arange(count) + 0.5)
    rates = DEG_H * parameters.across_deg_h_k * temperature_k(parameters, flight, middles)
    drifted = increments.delta_angles_rad + np.outer(rates * increments.period_s, np.array([1.0, 0.0, 0.0]))
    return replace(increments, delta_angles_rad=drifted)
