"""True motion of a body: state at one or many instants, the interface `Trajectory`, a body at rest. Wind model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.kernels.swing import WindField, compute_wind_profile
from marsyard.sim.error_sources import GUSTS
from marsyard.sim.frames import rigid
from marsyard.sim.parameters import Parameters, Positive, bounded_field

Times = Float64[np.ndarray, "n"]
Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class State:
    """True state of a body at one instant.

    - position_m, velocity_m_s: of the body frame's origin, world axes
    - attitude: rotation from body to world axes
    - body_rate_rad_s: angular velocity relative to the world, body axes
    - specific_force_m_s2: acceleration minus gravity at the body's origin, body axes: an ideal accelerometer's output
    """

    time_s: float
    position_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    attitude: Rotation
    body_rate_rad_s: Float64[np.ndarray, "3"]
    specific_force_m_s2: Float64[np.ndarray, "3"]

    @property
    def world_from_body(self) -> RigidTransform:
        """Pose of the body in the world."""
        return rigid(self.attitude, self.position_m)


@dataclass(frozen=True)
class Motion:
    """True states at many instants, one in each row; axes as in `State`."""

    times_s: Times
    positions_m: Vectors
    velocities_m_s: Vectors
    attitudes: Rotation
    body_rates_rad_s: Vectors
    specific_forces_m_s2: Vectors

    @classmethod
    def from_accelerations(
        cls,
        times_s: Times,
        derivatives: Sequence[Vectors],
        attitudes: Rotation,
        body_rates_rad_s: Vectors,
        gravity_m_s2: float,
    ) -> Motion:
        """Create the motion from `derivatives`: position, velocity and acceleration in world axes."""
        positions, velocities, accelerations = derivatives
        forces = attitudes.inv().apply(accelerations + np.array([0.0, 0.0, gravity_m_s2]))
        return cls(times_s, positions, velocities, attitudes, body_rates_rad_s, forces)

    def state(self, row: int) -> State:
        """Return the true state of one row."""
        position, velocity, attitude = self.positions_m[row], self.velocities_m_s[row], self.attitudes[row]
        rate, force = self.body_rates_rad_s[row], self.specific_forces_m_s2[row]
        return State(float(self.times_s[row]), position, velocity, attitude, rate, force)


@runtime_checkable
class Trajectory(Protocol):
    """Interface of a true motion, whose velocity, rate and specific force are derivatives of position and attitude."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is defined; can be infinite."""

    def state(self, time_s: float) -> State:
        """Compute the true state at a time. Raises ValueError for a time outside the span."""
        return self.motion(np.array([time_s])).state(0)

    def motion(self, times_s: Times) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""


@dataclass(frozen=True)
class Resting(Trajectory):
    """A body at rest in the world."""

    position_m: Float64[np.ndarray, "3"]
    attitude: Rotation
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time: the motion is defined at all times."""
        return -np.inf, np.inf

    def motion(self, times_s: Times) -> Motion:
        """Return the state at rest for each time."""
        count = times_s.size
        zeros = np.zeros((count, 3))
        forces = np.tile(self.attitude.inv().apply(np.array([0.0, 0.0, self.gravity_m_s2])), (count, 1))
        attitudes = Rotation.concatenate([self.attitude] * count) if count else Rotation.from_quat(np.zeros((0, 4)))
        return Motion(times_s, np.tile(self.position_m, (count, 1)), zeros, attitudes, zeros, forces)


def check_times(times_s: Times, span_s: tuple[float, float], tolerance_s: float = 0.0) -> None:
    """Raise ValueError for a time outside a span."""
    first, last = span_s
    outside = times_s[(times_s < first - tolerance_s) | (times_s > last + tolerance_s)]
    if outside.size:
        raise ValueError(f"time {outside[0]:.6g} s is outside of the motion; allowed: {first:.6g} to {last:.6g} s")


def attitudes_and_body_rates(angles_rad: Vectors, rates_rad_s: Vectors) -> tuple[Rotation, Vectors]:
    """Convert Euler angles (yaw, pitch, roll) and their rates to attitudes and angular velocities in body axes.

    The rotation sequence is yaw about z, pitch about the new y axis, roll about the new x axis.
    """
    yaw_rate, pitch_rate, roll_rate = rates_rad_s.T
    _, pitch, roll = angles_rad.T
    # product of the quaternions of the three rotations: a fifth of the time of `Rotation.from_euler`
    (cy, cp, cr), (sy, sp, sr) = np.cos(0.5 * angles_rad).T, np.sin(0.5 * angles_rad).T
    quaternions = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    rates = [
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
        -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
    ]
    return Rotation.from_quat(np.stack(quaternions, axis=-1)), np.stack(rates, axis=-1)


#: Shortest wavelength of the gusts: two diameters of the canopy, over which shorter gusts average out.
SHORTEST_WAVE_M = 30.0
#: Longest wavelength of the gusts in units of their length scale; longer waves are part of the mean wind.
LONGEST_WAVE_SCALES = 20.0
#: Number of waves of the gusts.
WAVES = 24


class WindParameters(Parameters):
    """Parameters of the wind: mean wind above the boundary layer, profile within the layer, and gusts."""

    wind_east_m_s: Annotated[float, bounded_field(-60.0, 60.0, "mean wind to the east")] = 0.0
    wind_north_m_s: Annotated[float, bounded_field(-60.0, 60.0, "mean wind to the north")] = 0.0
    wind_layer_m: Annotated[Positive, Field(le=5000.0, description="depth of the boundary layer (assumed)")] = 500.0
    wind_roughness_m: Annotated[Positive, Field(le=1.0, description="roughness (Mars Pathfinder: 0.03)")] = 0.03
    gust_intensity_m_s: Annotated[
        float, GUSTS, bounded_field(0.0, 20.0, "RMS of each component of the gusts (assumed)")
    ] = 1.5
    gust_length_m: Annotated[float, bounded_field(50.0, 5000.0, "length scale (MIL-F-8785C above 610 m: 533 m)")] = (
        533.0
    )


@dataclass(frozen=True)
class Wind:
    """Mean wind and gusts as a function of height only: the same at all times and horizontal positions.

    Mean wind at the height h above ground: the wind of `WindParameters` times ``ln(1 + h / z0) / ln(1 + H / z0)``, with
    the roughness z0 and the depth H of the boundary layer; constant above H.

    Gusts: Dryden's spectra (MIL-F-8785C, 3.7.2) for the wavenumber k in rad/m along a vertical path, with the length
    scale L. Vertical gusts have the longitudinal spectrum ``2 sigma^2 L / pi / (1 + (L k)^2)``, horizontal gusts the
    transverse one ``sigma^2 L / pi (1 + 3 (L k)^2) / (1 + (L k)^2)^2``. k is limited to wavelengths from
    `SHORTEST_WAVE_M` to `LONGEST_WAVE_SCALES` L; sigma^2 is the variance in this band. The gusts are sums of `WAVES`
    waves with normal amplitudes (Rice 1944); each k is drawn within one of `WAVES` equal intervals of log k.
    """

    field: WindField

    @classmethod
    def draw(cls, parameters: WindParameters, ground_height_m: float, rng: np.random.Generator) -> Wind:
        """Draw the gusts; `ground_height_m` is the world z of the ground."""
        p = parameters
        longest_m = LONGEST_WAVE_SCALES * p.gust_length_m
        edges = np.geomspace(2.0 * np.pi / longest_m, 2.0 * np.pi / SHORTEST_WAVE_M, WAVES + 1)
        wavenumbers = edges[:-1] * (edges[1:] / edges[:-1]) ** rng.random(WAVES)
        # integrals of the transverse and the longitudinal spectrum over each interval, with x = L k
        x = p.gust_length_m * edges
        transverse = np.diff(2.0 * np.arctan(x) - x / (1.0 + x**2)) / np.pi
        longitudinal = np.diff(2.0 * np.arctan(x)) / np.pi
        variances = np.stack([transverse, transverse, longitudinal], axis=1)
        deviations = p.gust_intensity_m_s * np.sqrt(variances / variances.sum(axis=0))
        amplitudes = np.tile(deviations, 2) * rng.standard_normal((WAVES, 6))
        return cls(
            WindField(
                ground_height_m=ground_height_m,
                mean_east_m_s=p.wind_east_m_s,
                mean_north_m_s=p.wind_north_m_s,
                layer_m=p.wind_layer_m,
                roughness_m=p.wind_roughness_m,
                waves=np.column_stack([wavenumbers, amplitudes]),
            )
        )

    @property
    def without_gusts(self) -> Wind:
        """The same mean wind without gusts."""
        return Wind(self.field._replace(waves=np.zeros((0, 7))))

    def velocities(self, heights_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Compute the wind towards east, north and up, m/s, at heights (world z, metres)."""
        return np.asarray(compute_wind_profile(heights_m, self.field))
