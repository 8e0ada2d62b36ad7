"""Errors of an inertial unit as the navigation filter assumes them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Vector3

_DEG_H = np.radians(1.0) / 3600.0
_DEG_SQRT_H = np.radians(1.0) / 60.0
_STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class ImuErrorModel:
    """Errors of an inertial unit as assumed by the filter; standard deviations per axis.

    The defaults are those of an LN-200 (Northrop Grumman's data sheet: bias repeatability from 1 deg/h and from 0.3 mg,
    bias instability, random walks, scale factors, misalignment).

    - gyro_wander_deg_h, gyro_wander_s: standard deviation and correlation time of a Gauss-Markov bias that is added to
      the constant bias; the same for accelerometer_wander_mg and accelerometer_wander_s
    - sensitivity_correlation_s: time over which rate and force are nearly constant, assumed. An error of scale or
      misalignment s acts like white noise of the density s * force * sqrt(2 * sensitivity_correlation_s).
    """

    angular_random_walk_deg_sqrt_h: float = 0.07
    gyro_bias_deg_h: float = 1.0
    gyro_wander_deg_h: float = 0.35
    gyro_wander_s: float = 100.0
    gyro_scale_ppm: float = 100.0
    gyro_misalignment_mrad: float = 0.1
    velocity_random_walk_ug_sqrt_hz: float = 50.0
    accelerometer_bias_mg: float = 0.3
    accelerometer_wander_mg: float = 0.05
    accelerometer_wander_s: float = 60.0
    accelerometer_scale_ppm: float = 300.0
    accelerometer_misalignment_mrad: float = 0.1
    sensitivity_correlation_s: float = 10.0

    @property
    def initial_bias_variances(self) -> Float[np.ndarray, "6"]:
        """Variances of gyro biases, (rad/s)^2, and accelerometer biases, (m/s2)^2: constant part and wander."""
        gyro = (self.gyro_bias_deg_h**2 + self.gyro_wander_deg_h**2) * _DEG_H**2
        milli_g = 1e-3 * _STANDARD_GRAVITY_M_S2
        accelerometer = (self.accelerometer_bias_mg**2 + self.accelerometer_wander_mg**2) * milli_g**2
        return np.repeat([gyro, accelerometer], 3)

    @property
    def white_densities(self) -> Float[np.ndarray, "15"]:
        """Spectral densities of white noise that does not depend on the motion, squared units of the errors per s."""
        angle = self.angular_random_walk_deg_sqrt_h * _DEG_SQRT_H
        velocity = 1e-6 * self.velocity_random_walk_ug_sqrt_hz * _STANDARD_GRAVITY_M_S2
        # over times much shorter than its correlation time a Gauss-Markov bias is a random walk of this density
        gyro = (self.gyro_wander_deg_h * _DEG_H) ** 2 * 2.0 / self.gyro_wander_s
        wander = 1e-3 * self.accelerometer_wander_mg * _STANDARD_GRAVITY_M_S2
        accelerometer = wander**2 * 2.0 / self.accelerometer_wander_s
        return np.repeat([0.0, velocity**2, angle**2, gyro, accelerometer], 3)

    def sensitivity_densities(self, body_rate_rad_s: Vector3, force_m_s2: Vector3) -> tuple[Vector3, Vector3]:
        """Compute densities of the noise by scale and misalignment per body axis: angle, rad^2/s; velocity, m^2/s^3."""
        rate_squares, force_squares = body_rate_rad_s**2, force_m_s2**2
        gyro_scale, gyro_cross = 1e-6 * self.gyro_scale_ppm, 1e-3 * self.gyro_misalignment_mrad
        scale, cross = 1e-6 * self.accelerometer_scale_ppm, 1e-3 * self.accelerometer_misalignment_mrad
        angle = gyro_scale**2 * rate_squares + gyro_cross**2 * (rate_squares.sum() - rate_squares)
        velocity = scale**2 * force_squares + cross**2 * (force_squares.sum() - force_squares)
        factor = 2.0 * self.sensitivity_correlation_s
        return factor * angle, factor * velocity
