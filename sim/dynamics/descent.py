"""Parachute descent in closed form: drift with the wind, coning about the parachute, nodding about the bridle.

The lander hangs at the end of a line from the parachute, which falls and drifts. The line cones about the vertical,
slowly; the lander nods about its attachment to the bridle, fast; and it spins slowly about its axis. The motion is
given by formula, so that position and attitude are exact at any time; velocity, rates and specific force are their
derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from sim.dynamics.state import State
from sim.dynamics.trajectory import Motion

Phase = Annotated[float, Field(ge=-360.0, le=720.0)]


class DescentParameters(BaseModel):
    """A descent. Angles in degrees, as in campaign files; altitudes above the ground below the lander."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    altitude_first_m: Annotated[float, Field(gt=100.0, le=10000.0, description="altitude of the first picture, m")] = (
        2000.0
    )
    interval_s: Annotated[float, Field(gt=0.1, le=60.0, description="time between pictures, s")] = 3.75
    descent_rate_m_s: Annotated[
        float, Field(gt=0.0, le=200.0, description="descent rate at the first picture, m/s")
    ] = 75.0
    deceleration_m_s2: Annotated[float, Field(ge=-5.0, le=5.0, description="upward acceleration, m/s2")] = 0.2
    wind_east_m_s: Annotated[float, Field(ge=-60.0, le=60.0, description="drift to the east at the first picture")] = (
        0.0
    )
    wind_north_m_s: Annotated[
        float, Field(ge=-60.0, le=60.0, description="drift to the north at the first picture")
    ] = 0.0
    gust_east_m_s2: Annotated[float, Field(ge=-5.0, le=5.0, description="change of the eastward drift, m/s2")] = 0.0
    gust_north_m_s2: Annotated[float, Field(ge=-5.0, le=5.0, description="change of the northward drift, m/s2")] = 0.0
    cone_angle_deg: Annotated[float, Field(ge=0.0, le=45.0, description="greatest angle of the line from nadir")] = 15.0
    cone_minor_share: Annotated[
        float, Field(ge=-1.0, le=1.0, description="smaller over greater half-axis of the cone; the sign is its sense")
    ] = 0.5
    cone_direction_deg: Annotated[Phase, Field(description="azimuth of the cone's greater axis")] = 0.0
    cone_phase_deg: Annotated[Phase, Field(description="phase of the coning at the first picture")] = 0.0
    cone_period_s: Annotated[float, Field(gt=1.0, le=100.0, description="period of the coning")] = 22.0
    line_length_m: Annotated[float, Field(ge=0.0, le=200.0, description="from the parachute to the lander")] = 45.0
    nod_rate_deg_s: Annotated[float, Field(ge=0.0, le=120.0, description="greatest rate of the nodding")] = 20.0
    nod_direction_deg: Annotated[Phase, Field(description="azimuth of the nodding, relative to the cone's axis")] = 0.0
    nod_phase_deg: Annotated[Phase, Field(description="phase of the nodding at the first picture")] = 0.0
    nod_period_s: Annotated[float, Field(gt=0.1, le=20.0, description="period of the nodding")] = 1.2
    arm_length_m: Annotated[float, Field(ge=0.0, le=10.0, description="from the bridle's attachment to the camera")] = (
        1.0
    )
    heading_deg: Annotated[Phase, Field(description="rotation about the lander's axis at the first picture")] = 0.0
    spin_rate_deg_s: Annotated[float, Field(ge=-30.0, le=30.0, description="rate of rotation about the axis")] = 0.0

    @property
    def nod_amplitude_deg(self) -> float:
        """Greatest angle of the nodding: rate over angular frequency."""
        return self.nod_rate_deg_s * self.nod_period_s / (2.0 * np.pi)


#: Step of the central differences that give rates from the closed form, s: truncation 1e-13, round-off 1e-9 m/s.
_STEP_S = 1e-3
#: Fourth-order central differences: weights of f(t - 2h) ... f(t + 2h).
_FIRST = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
_SECOND = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12.0
#: Step for second derivatives, s, where round-off grows with its square.
_SECOND_STEP_S = 1e-2


@dataclass(frozen=True)
class ParachuteDescent:
    """A descent through a place.

    Attributes
    ----------
    parameters
        The descent.
    start_m
        World position of the lander at time 0, the nominal time of the first picture.
    gravity_m_s2
        Acceleration of gravity.
    """

    parameters: DescentParameters
    start_m: Float64[np.ndarray, "3"]
    gravity_m_s2: float = 3.71

    def attitudes(self, times_s: Float64[np.ndarray, "n"]) -> Rotation:
        """Rotations from body to world axes."""
        p = self.parameters
        line = self._line_rotation(times_s)
        nod_angle = np.radians(p.nod_amplitude_deg) * np.sin(self._phase(times_s, p.nod_period_s, p.nod_phase_deg))
        azimuth = np.radians(p.cone_direction_deg + p.nod_direction_deg)
        nod = Rotation.from_rotvec(nod_angle[:, None] * _tilt_axis(azimuth))
        spin = np.radians(p.heading_deg + p.spin_rate_deg_s * times_s)
        return line * nod * Rotation.from_rotvec(spin[:, None] * np.array([0.0, 0.0, -1.0]))

    def positions(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """World positions of the lander's camera, metres."""
        offset: Float64[np.ndarray, "n 3"] = self._from_parachute(times_s) - self._from_parachute(np.zeros(1))
        positions: Float64[np.ndarray, "n 3"] = self.start_m + self._drift(times_s) + offset
        return positions

    @property
    def span_s(self) -> tuple[float, float]:
        """The formula holds at all times."""
        return -np.inf, np.inf

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times."""
        states = [self.state(float(time)) for time in times_s]
        return Motion(
            times_s=times_s,
            positions_m=np.array([s.position_m for s in states]),
            velocities_m_s=np.array([s.velocity_m_s for s in states]),
            attitudes=self.attitudes(times_s),
            body_rates_rad_s=np.array([s.body_rate_rad_s for s in states]),
            specific_forces_m_s2=np.array([s.specific_force_m_s2 for s in states]),
        )

    def state(self, time_s: float) -> State:
        """The full state at a time."""
        stencil = np.arange(-2.0, 3.0)
        attitude = self.attitudes(np.array([time_s]))[0]
        around = self.attitudes(time_s + _STEP_S * stencil)
        acceleration = _SECOND @ self.positions(time_s + _SECOND_STEP_S * stencil) / _SECOND_STEP_S**2
        gravity = np.array([0.0, 0.0, -self.gravity_m_s2])
        return State(
            time_s=time_s,
            position_m=self.positions(np.array([time_s]))[0],
            velocity_m_s=_FIRST @ self.positions(time_s + _STEP_S * stencil) / _STEP_S,
            attitude=attitude,
            body_rate_rad_s=_FIRST @ (attitude.inv() * around).as_rotvec() / _STEP_S,
            specific_force_m_s2=attitude.inv().apply(acceleration - gravity),
        )

    def _drift(self, t: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        p = self.parameters
        velocity = np.array([p.wind_east_m_s, p.wind_north_m_s, -p.descent_rate_m_s])
        acceleration = np.array([p.gust_east_m_s2, p.gust_north_m_s2, p.deceleration_m_s2])
        moved: Float64[np.ndarray, "n 3"] = t[:, None] * velocity + 0.5 * t[:, None] ** 2 * acceleration
        return moved

    def _phase(self, t: Float64[np.ndarray, "n"], period_s: float, phase_deg: float) -> Float64[np.ndarray, "n"]:
        phase: Float64[np.ndarray, "n"] = 2.0 * np.pi * t / period_s + np.radians(phase_deg)
        return phase

    def _line_rotation(self, t: Float64[np.ndarray, "n"]) -> Rotation:
        p = self.parameters
        phase = self._phase(t, p.cone_period_s, p.cone_phase_deg)
        major, minor = np.radians(p.cone_angle_deg) * np.array([1.0, p.cone_minor_share])
        along = _tilt_axis(np.radians(p.cone_direction_deg))
        across = _tilt_axis(np.radians(p.cone_direction_deg) + np.pi / 2.0)
        return Rotation.from_rotvec(major * np.cos(phase)[:, None] * along + minor * np.sin(phase)[:, None] * across)

    def _from_parachute(self, t: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        down = np.array([0.0, 0.0, -1.0])
        hung: Float64[np.ndarray, "n 3"] = self.parameters.line_length_m * self._line_rotation(t).apply(down)
        hung += self.parameters.arm_length_m * self.attitudes(t).apply(down)
        return hung


def _tilt_axis(azimuth_rad: float) -> Float64[np.ndarray, "3"]:
    """Axis of the rotation that tilts nadir towards an azimuth (clockwise from north)."""
    # nadir x towards: (0, 0, -1) x (sin a, cos a, 0) = (cos a, -sin a, 0)
    return np.array([np.cos(azimuth_rad), -np.sin(azimuth_rad), 0.0])
