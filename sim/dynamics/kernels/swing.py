"""Compiled equations of motion of the two-stage pendulum; `marsyard.sim.dynamics.swing` defines equations and symbols.

A state vector has 22 components: position and velocity of the canopy, unit vector along the line (downwards) and its
time derivative, direction of the lander's axis and its time derivative, and the lander's x axis (three components each,
world axes), then the lander's spin.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from marsyard.sim.dynamics.kernels.wind import WIND_SCALARS, WindField, compute_wind

Array = NDArray[np.float64]
#: Index of the first component of each vector in a state, and the size of a state.
CANOPY, CANOPY_VELOCITY, LINE, LINE_RATE, AXIS, AXIS_RATE, SIDE, SPIN, SIZE = 0, 3, 6, 9, 12, 15, 18, 21, 22


class Chain(NamedTuple):
    """Constants of canopy, backshell, lander and air, SI units; symbols of `marsyard.sim.dynamics.swing` in brackets.

    - mass_kg, lander_mass_kg: total mass (M) and mass of the lander (m_l)
    - first_moment, second_moment: moments of mass about the canopy (S, J)
    - line_m, mass_centre_m, camera_m: distances from canopy to hinge (L), from hinge to centre of mass (d) and camera
    - transverse_inertia, axial_inertia, hinge_damping: (I_t, I_a, c)
    - tangential, normal: rho A C_T / 2 and rho A C_N / 2, kg/m, at `reference_height_m`
    """

    mass_kg: float
    lander_mass_kg: float
    first_moment: float
    second_moment: float
    line_m: float
    mass_centre_m: float
    camera_m: float
    transverse_inertia: float
    axial_inertia: float
    hinge_damping: float
    tangential: float
    normal: float
    reference_height_m: float
    scale_height_m: float
    gravity_m_s2: float


CHAIN_SIZE = len(Chain._fields)


@njit(cache=True)
def _dot(a: Array, b: Array) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True)
def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _vector(y: Array, first: int) -> Array:
    """Return the three components of a state that begin with index `first`."""
    return y[first : first + 3]


@njit(cache=True)
def compute_aerodynamic_force(y: Array, chain: Chain, field: WindField) -> Array:
    """Compute the force F of the air on the canopy, N, world axes."""
    height, line = y[CANOPY + 2], _vector(y, LINE)
    velocity = _vector(y, CANOPY_VELOCITY) - np.array(compute_wind(height, field))  # relative to the air
    speed = math.sqrt(_dot(velocity, velocity))
    axial = _dot(velocity, line)
    density = math.exp((chain.reference_height_m - height) / chain.scale_height_m)
    force: Array = -density * speed * (chain.tangential * speed * line + chain.normal * (velocity - axial * line))
    return force


@njit(cache=True)
def state_derivative(_t: float, y: Array, constants: Array, waves: Array) -> Array:
    """Compute the time derivatives of a state for CyRK's integrator; the other arguments are from `pack_constants`.

    They are arrays, because numba converts named tuples slowly.
    """
    chain = Chain(*to_fixed_tuple(constants[:CHAIN_SIZE], CHAIN_SIZE))
    ground_height, mean_east, mean_north, layer, roughness = to_fixed_tuple(constants[CHAIN_SIZE:], WIND_SCALARS)
    field = WindField(ground_height, mean_east, mean_north, layer, roughness, waves)
    rates: Array = compute_derivatives(y, chain, field)
    return rates


def pack_constants(chain: Chain, field: WindField) -> tuple[Array, Array]:
    """Convert the constants of chain and wind to arrays: the last two arguments of `state_derivative`."""
    return np.array([*chain, *field[:WIND_SCALARS]]), field.waves


@njit(cache=True)
def compute_derivatives(y: Array, chain: Chain, field: WindField) -> Array:
    """Compute the time derivatives of a state from equations (1) to (4) of `marsyard.sim.dynamics.swing`."""
    lander_moment = chain.lander_mass_kg * chain.mass_centre_m
    # coefficients A, C and B of n'' and e'' in equations (2) and (3), after r'' is eliminated with equation (1)
    a = chain.second_moment - chain.first_moment**2 / chain.mass_kg
    c = lander_moment * (chain.line_m - chain.first_moment / chain.mass_kg)
    b = chain.transverse_inertia + lander_moment * (chain.mass_centre_m - lander_moment / chain.mass_kg)

    line, line_rate = _vector(y, LINE), _vector(y, LINE_RATE)
    axis, axis_rate, spin = _vector(y, AXIS), _vector(y, AXIS_RATE), y[SPIN]
    force = compute_aerodynamic_force(y, chain, field)
    lander_rotation = _cross(axis, axis_rate)
    line_spin = _dot(lander_rotation, line) + spin * _dot(axis, line)
    hinge_rate = lander_rotation + spin * axis - line_spin * line - _cross(line, line_rate)  # s of the equations

    line_speed2, axis_speed2, cosine = _dot(line_rate, line_rate), _dot(axis_rate, axis_rate), _dot(line, axis)
    line_source = (
        chain.hinge_damping * _cross(hinge_rate, line)
        - chain.first_moment / chain.mass_kg * (force - _dot(force, line) * line)
        + c * axis_speed2 * (axis - cosine * line)
    )
    axis_source = (
        -chain.hinge_damping * _cross(hinge_rate, axis)
        - chain.axial_inertia * spin * _cross(axis_rate, axis)
        - lander_moment / chain.mass_kg * (force - _dot(force, axis) * axis)
        + c * line_speed2 * (line - cosine * axis)
    )
    # solve A p + C P_n q = line_source and B q + C P_e p = axis_source for p = P_n n'' and q = P_e e''
    source = line_source - c / b * (axis_source - _dot(axis_source, line) * line)
    axis_lateral = axis - cosine * line
    reduced_a = a - c * c / b
    coupling = c * c / b
    projection = _dot(axis_lateral, source) / (reduced_a + coupling * _dot(axis_lateral, axis_lateral))
    p = (source - coupling * axis_lateral * projection) / reduced_a
    q = (axis_source - c * (p - _dot(p, axis) * axis)) / b

    rates = np.empty(SIZE)
    rates[CANOPY : CANOPY + 3] = _vector(y, CANOPY_VELOCITY)
    rates[LINE : LINE + 3] = line_rate
    rates[AXIS : AXIS + 3] = axis_rate
    line_acceleration, axis_acceleration = p - line_speed2 * line, q - axis_speed2 * axis
    rates[LINE_RATE : LINE_RATE + 3] = line_acceleration
    rates[AXIS_RATE : AXIS_RATE + 3] = axis_acceleration
    rates[CANOPY_VELOCITY : CANOPY_VELOCITY + 3] = (
        force - chain.first_moment * line_acceleration - lander_moment * axis_acceleration
    ) / chain.mass_kg
    rates[CANOPY_VELOCITY + 2] -= chain.gravity_m_s2
    rates[SIDE : SIDE + 3] = _cross(lander_rotation + spin * axis, _vector(y, SIDE))
    rates[SPIN] = -chain.hinge_damping * _dot(hinge_rate, axis) / chain.axial_inertia
    return rates


class CameraMotion(NamedTuple):
    """True motion of the camera, a row per time, SI units.

    - positions, velocities: world axes
    - attitudes: rotation matrices from body to world axes
    - body_rates, specific_forces: body axes
    """

    positions: Array
    velocities: Array
    attitudes: Array
    body_rates: Array
    specific_forces: Array


@njit(cache=True)
def compute_truth(states: Array, chain: Chain, field: WindField) -> CameraMotion:
    """Compute the true motion of the camera in the given states."""
    count = states.shape[0]
    positions, velocities = np.empty((count, 3)), np.empty((count, 3))
    body_rates, forces = np.empty((count, 3)), np.empty((count, 3))
    matrices = np.empty((count, 3, 3))
    for k in range(count):
        y = states[k]
        rates = compute_derivatives(y, chain, field)
        axis, axis_rate, side = _vector(y, AXIS), _vector(y, AXIS_RATE), _vector(y, SIDE)
        positions[k] = _vector(y, CANOPY) + chain.line_m * _vector(y, LINE) + chain.camera_m * axis
        velocities[k] = _vector(y, CANOPY_VELOCITY) + chain.line_m * _vector(y, LINE_RATE) + chain.camera_m * axis_rate
        force = (
            _vector(rates, CANOPY_VELOCITY)
            + chain.line_m * _vector(rates, LINE_RATE)
            + chain.camera_m * _vector(rates, AXIS_RATE)
        )
        force[2] += chain.gravity_m_s2
        # Gram-Schmidt: make the x axis perpendicular to the lander's axis in spite of integration errors
        axis_norm = math.sqrt(_dot(axis, axis))
        x = side - _dot(side, axis) / axis_norm**2 * axis
        x = x / math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
        z = -axis / axis_norm
        matrices[k, :, 0], matrices[k, :, 1], matrices[k, :, 2] = x, _cross(z, x), z
        rotation = _cross(axis, axis_rate) + y[SPIN] * axis
        for j in range(3):
            body_rates[k, j] = _dot(matrices[k, :, j], rotation)
            forces[k, j] = _dot(matrices[k, :, j], force)
    return CameraMotion(positions, velocities, matrices, body_rates, forces)
