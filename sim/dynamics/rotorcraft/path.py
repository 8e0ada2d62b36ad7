"""Simulated motion of a helicopter, interpolated between the steps of the simulation, with vibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.dynamics.rotorcraft.parameters import VibrationParameters
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, attitudes_and_body_rates, check_times


@dataclass(frozen=True)
class Vibration:
    """Sines that are added to positions along the world's axes (m) and to yaw, pitch and roll (rad)."""

    rate_rad_s: float
    amplitudes: Float64[np.ndarray, "6"]
    phases_rad: Float64[np.ndarray, "6"]

    @classmethod
    def draw(cls, parameters: VibrationParameters, rng: np.random.Generator) -> Vibration:
        """Draw the phases."""
        rate = 2.0 * np.pi * parameters.rate_hz
        amplitudes = np.repeat([parameters.acceleration_m_s2 / rate**2, np.radians(parameters.angle_deg)], 3)
        return cls(rate, amplitudes, 2.0 * np.pi * rng.random(6))

    def derivative(self, times_s: Float64[np.ndarray, "n"], order: int) -> Float64[np.ndarray, "n 6"]:
        """Compute the time derivative of the given order; order 0 is the displacement."""
        phases = self.rate_rad_s * times_s[:, None] + self.phases_rad + 0.5 * np.pi * order
        return np.asarray(self.amplitudes * self.rate_rad_s**order * np.sin(phases))


@dataclass(frozen=True)
class SimulatedPath(Trajectory):
    """Simulated motion: states at equidistant times (columns: see `kernels`), interpolated exactly, plus vibration.

    Position and angles are twice continuously differentiable. The body frame has its origin at the camera; laser
    and inertial unit are assumed to be at the same point. Its axes are x forward, y to the left, z up along the rotor's
    axis.
    """

    start_s: float
    step_s: float
    rows: Float64[np.ndarray, "knots 18"]
    vibration: Vibration
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the simulation."""
        return self.start_s, self.start_s + self.step_s * (len(self.rows) - 1)

    @property
    def knots_s(self) -> Float64[np.ndarray, "knots"]:
        """Times of the rows."""
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.rows)))

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s, 1e-6 * self.step_s)  # sums of steps have rounding errors
        interval = np.clip(((times_s - self.start_s) / self.step_s).astype(int), 0, len(self.rows) - 2)
        elapsed_s = (times_s - self.start_s - self.step_s * interval)[:, None]
        angles, angle_rates, _ = self._interpolate(interval, elapsed_s, kernels.ANGLE)
        vibration = [self.vibration.derivative(times_s, order) for order in range(3)]
        attitudes, rates = attitudes_and_body_rates(angles + vibration[0][:, 3:], angle_rates + vibration[1][:, 3:])
        path = self._interpolate(interval, elapsed_s, kernels.POSITION)
        derivatives = [vector + sine[:, :3] for vector, sine in zip(path, vibration, strict=True)]
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)

    def _interpolate(
        self, interval: np.ndarray, elapsed_s: Float64[np.ndarray, "n 1"], column: int
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """Interpolate a vector and its first two derivatives (consecutive columns); the second derivative is linear."""
        value, first, second = np.split(self.rows[interval, column : column + 9], 3, axis=1)
        third = (self.rows[interval + 1, column + 6 : column + 9] - second) / self.step_s
        return (
            value + elapsed_s * (first + elapsed_s * (second / 2.0 + elapsed_s * third / 6.0)),
            first + elapsed_s * (second + elapsed_s * third / 2.0),
            second + elapsed_s * third,
        )
