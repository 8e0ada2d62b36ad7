"""The motion of a flight that was integrated: exact between its knots, with the rotor's shaking on top."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.sim.dynamics.angles import turning
from marsyard.sim.dynamics.rotorcraft.kernels import ANGLE, PLACE, PUSH, RATE, SPEED, TWIST
from marsyard.sim.dynamics.rotorcraft.parameters import VibrationParameters
from marsyard.sim.dynamics.trajectory import Motion, Trajectory


@dataclass(frozen=True)
class Vibration:
    """Sines along the world's axes and in yaw, pitch and roll, added to places and angles.

    Attributes
    ----------
    rate_rad_s
        Angular frequency.
    amplitudes
        Of place (m) and angle (rad), six values.
    phases_rad
        Of each, six values.
    """

    rate_rad_s: float
    amplitudes: Float64[np.ndarray, "6"]
    phases_rad: Float64[np.ndarray, "6"]

    @classmethod
    def drawn(cls, parameters: VibrationParameters, rng: np.random.Generator) -> Vibration:
        """A vibration, its phases drawn."""
        rate = 2.0 * np.pi * parameters.rate_hz
        sizes = np.repeat([parameters.acceleration_m_s2 / rate**2, np.radians(parameters.angle_deg)], 3)
        return cls(rate, sizes, 2.0 * np.pi * rng.random(6))

    def derivative(self, times_s: Float64[np.ndarray, "n"], order: int) -> Float64[np.ndarray, "n 6"]:
        """Displacement (order 0) or a derivative of it at these times."""
        turned = self.rate_rad_s * times_s[:, None] + self.phases_rad + 0.5 * np.pi * order
        return np.asarray(self.amplitudes * self.rate_rad_s**order * np.sin(turned))


@dataclass(frozen=True)
class FlownPath(Trajectory):
    """A flight from its rows (see `kernels`); place and angles are twice continuously differentiable.

    The body frame has its origin in camera, laser and instruments, x forward, y to the left, z up along the rotor.

    Attributes
    ----------
    start_s, step_s
        Time of the first row, and between rows.
    rows
        States at the knots.
    vibration
        What is added to them.
    gravity_m_s2
        Acceleration of gravity.
    """

    start_s: float
    step_s: float
    rows: Float64[np.ndarray, "knots 18"]
    vibration: Vibration
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is known."""
        return self.start_s, self.start_s + self.step_s * (len(self.rows) - 1)

    @property
    def knots_s(self) -> Float64[np.ndarray, "knots"]:
        """Times of the rows."""
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.rows)))

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times. Raises ValueError outside of the span."""
        first, last = self.span_s
        # a millionth of a step is what sums of steps may be off by
        slack = 1e-6 * self.step_s
        if times_s.size and (times_s.min() < first - slack or times_s.max() > last + slack):
            raise ValueError(f"the flight is known from {first} s to {last} s, not at {times_s.min()}..{times_s.max()}")
        interval = np.clip(((times_s - first) / self.step_s).astype(int), 0, len(self.rows) - 2)
        passed = times_s - first - self.step_s * interval
        positions, velocities, accelerations = self._between(interval, passed, PLACE, SPEED, PUSH)
        angles, rates, _ = self._between(interval, passed, ANGLE, RATE, TWIST)
        place, speed, push = (self.vibration.derivative(times_s, order) for order in range(3))
        attitudes, body_rates = turning(angles + place[:, 3:], rates + speed[:, 3:])
        weightless = accelerations + push[:, :3] + np.array([0.0, 0.0, self.gravity_m_s2])
        return Motion(
            times_s=times_s,
            positions_m=positions + place[:, :3],
            velocities_m_s=velocities + speed[:, :3],
            attitudes=attitudes,
            body_rates_rad_s=body_rates,
            specific_forces_m_s2=attitudes.inv().apply(weightless),
        )

    def _between(
        self, interval: np.ndarray, passed_s: Float64[np.ndarray, "n"], place: int, speed: int, push: int
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """A quantity and its first two derivatives: the second is a straight line between knots."""
        t = passed_s[:, None]
        value, first, second = (self.rows[interval, at : at + 3] for at in (place, speed, push))
        third = (self.rows[interval + 1, push : push + 3] - second) / self.step_s
        return (
            value + t * (first + t * (second / 2.0 + t * third / 6.0)),
            first + t * (second + t * third / 2.0),
            second + t * third,
        )
