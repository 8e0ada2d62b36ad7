"""Compiled equations of motion of the two-stage pendulum; `marsyard.sim.dynamics.swing` derives them and their symbols.

A state is a vector of 22: position and velocity of the canopy, the line's direction and its rate, the lander's axis and
its rate, and the lander's x axis, each with three components in world axes; and the lander's spin about its axis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: First components of the vectors in a state, and its size.
CANOPY, CANOPY_RATE, LINE, LINE_RATE, AXIS, AXIS_RATE, SIDE, SPIN, SIZE = 0, 3, 6, 9, 12, 15, 18, 21, 22


class Chain(NamedTuple):
    """Constants of canopy, backshell, lander and air.

    `tangential` and `normal` are half density times area times coefficient, kg/m, at `reference_height_m`; `reach_m` is
    the camera's distance from the hinge, `mass_centre_m` the lander's centre of mass.
    """

    mass_kg: float
    lander_mass_kg: float
    first_moment: float
    second_moment: float
    line_m: float
    mass_centre_m: float
    reach_m: float
    transverse_inertia: float
    axial_inertia: float
    hinge_damping: float
    tangential: float
    normal: float
    reference_height_m: float
    scale_height_m: float
    gravity_m_s2: float


class WindField(NamedTuple):
    """Mean wind and gusts as functions of height: see `marsyard.sim.dynamics.trajectory`.

    A row of `waves`: wavenumber, rad/m; amplitudes east, north and up of its cosine, then of its sine.
    """

    ground_height_m: float
    mean_east_m_s: float
    mean_north_m_s: float
    layer_m: float
    roughness_m: float
    waves: Array


CHAIN_SIZE = len(Chain._fields)
#: Fields without the waves.
FIELD_SIZE = len(WindField._fields) - 1

#: Coefficients of SciPy's polynomial over a step of DOP853.
TERMS = 7


@njit(cache=True)
def wind_at(height: float, field: WindField) -> tuple[float, float, float]:
    """East, north and upward wind at a height of the world's z."""
    above = max(height - field.ground_height_m, 0.0)
    profile = 1.0
    if above < field.layer_m:
        profile = math.log1p(above / field.roughness_m) / math.log1p(field.layer_m / field.roughness_m)
    east = profile * field.mean_east_m_s
    north = profile * field.mean_north_m_s
    up = 0.0
    for k in range(field.waves.shape[0]):
        wave = field.waves[k]
        c = math.cos(wave[0] * height)
        s = math.sin(wave[0] * height)
        east += wave[1] * c + wave[4] * s
        north += wave[2] * c + wave[5] * s
        up += wave[3] * c + wave[6] * s
    return east, north, up


@njit(cache=True)
def wind_profile(heights: Array, field: WindField) -> Array:
    """Rows (east, north, up) of the wind at many heights."""
    rows = np.empty((heights.size, 3))
    for i in range(heights.size):
        rows[i] = wind_at(heights[i], field)
    return rows


@njit(cache=True)
def _dot(a: Array, b: Array) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True)
def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _vector(y: Array, first: int) -> Array:
    """The three components of a state from a first one on."""
    return y[first : first + 3]


@njit(cache=True)
def aerodynamic_force(y: Array, chain: Chain, field: WindField) -> Array:
    """Force of the air on the canopy, N, world axes."""
    height, line = y[CANOPY + 2], _vector(y, LINE)
    relative = _vector(y, CANOPY_RATE) - np.array(wind_at(height, field))
    speed = math.sqrt(_dot(relative, relative))
    along = _dot(relative, line)
    density = math.exp((chain.reference_height_m - height) / chain.scale_height_m)
    force: Array = -density * speed * (chain.tangential * speed * line + chain.normal * (relative - along * line))
    return force


@njit(cache=True)
def state_derivative(_t: float, y: Array, constants: Array, waves: Array) -> Array:
    """`derivatives` with the signature of an integrator; see `pack_constants`, as numba converts tuples slowly."""
    chain = Chain(*to_fixed_tuple(constants[:CHAIN_SIZE], CHAIN_SIZE))
    mean = to_fixed_tuple(constants[CHAIN_SIZE:], FIELD_SIZE)
    rates: Array = derivatives(y, chain, WindField(mean[0], mean[1], mean[2], mean[3], mean[4], waves))
    return rates


def pack_constants(chain: Chain, field: WindField) -> tuple[Array, Array]:
    """The last two arguments of `state_derivative`."""
    return np.array([*chain, *field[:FIELD_SIZE]]), field.waves


@njit(cache=True)
def interpolate_states(
    times: Array, knots: Array, starts: Array, lengths: Array, states: Array, polynomials: Array
) -> Array:
    """States at many times, a row each, from the polynomials of `marsyard.sim.dynamics.swing.Path`."""
    rows = np.empty((times.size, SIZE))
    for n in range(times.size):
        i = max(np.searchsorted(knots, times[n], side="right") - 1, 0)
        x = (times[n] - starts[i]) / lengths[i]
        for c in range(SIZE):
            value = 0.0
            for k in range(TERMS):
                value = (value + polynomials[i, TERMS - 1 - k, c]) * (x if k % 2 == 0 else 1.0 - x)
            rows[n, c] = states[i, c] + value
    return rows


@njit(cache=True)
def derivatives(y: Array, chain: Chain, field: WindField) -> Array:
    """Time derivatives of the state."""
    lander_moment = chain.lander_mass_kg * chain.mass_centre_m
    # moments of the line, of both, and of the lander with the canopy's position eliminated
    a = chain.second_moment - chain.first_moment**2 / chain.mass_kg
    c = lander_moment * (chain.line_m - chain.first_moment / chain.mass_kg)
    b = chain.transverse_inertia + lander_moment * (chain.mass_centre_m - lander_moment / chain.mass_kg)

    line, line_rate = _vector(y, LINE), _vector(y, LINE_RATE)
    axis, axis_rate, spin = _vector(y, AXIS), _vector(y, AXIS_RATE), y[SPIN]
    force = aerodynamic_force(y, chain, field)
    lander_rotation = _cross(axis, axis_rate)
    rolling = _dot(lander_rotation, line) + spin * _dot(axis, line)
    slip = lander_rotation + spin * axis - rolling * line - _cross(line, line_rate)

    line_speed2, axis_speed2, cosine = _dot(line_rate, line_rate), _dot(axis_rate, axis_rate), _dot(line, axis)
    on_line = (
        chain.hinge_damping * _cross(slip, line)
        - chain.first_moment / chain.mass_kg * (force - _dot(force, line) * line)
        + c * axis_speed2 * (axis - cosine * line)
    )
    on_axis = (
        -chain.hinge_damping * _cross(slip, axis)
        - chain.axial_inertia * spin * _cross(axis_rate, axis)
        - lander_moment / chain.mass_kg * (force - _dot(force, axis) * axis)
        + c * line_speed2 * (line - cosine * axis)
    )
    # A w + C P_n x = on_line and B x + C P_e w = on_axis, w across the line n, x across the axis e
    source = on_line - c / b * (on_axis - _dot(on_axis, line) * line)
    across = axis - cosine * line
    stiff = a - c * c / b
    extra = c * c / b
    along = _dot(across, source) / (stiff + extra * _dot(across, across))
    w = (source - extra * across * along) / stiff
    x = (on_axis - c * (w - _dot(w, axis) * axis)) / b

    rates = np.empty(SIZE)
    rates[CANOPY : CANOPY + 3] = _vector(y, CANOPY_RATE)
    rates[LINE : LINE + 3] = line_rate
    rates[AXIS : AXIS + 3] = axis_rate
    line_acceleration, axis_acceleration = w - line_speed2 * line, x - axis_speed2 * axis
    rates[LINE_RATE : LINE_RATE + 3] = line_acceleration
    rates[AXIS_RATE : AXIS_RATE + 3] = axis_acceleration
    rates[CANOPY_RATE : CANOPY_RATE + 3] = (
        force - chain.first_moment * line_acceleration - lander_moment * axis_acceleration
    ) / chain.mass_kg
    rates[CANOPY_RATE + 2] -= chain.gravity_m_s2
    rates[SIDE : SIDE + 3] = _cross(lander_rotation + spin * axis, _vector(y, SIDE))
    rates[SPIN] = -chain.hinge_damping * _dot(slip, axis) / chain.axial_inertia
    return rates


@njit(cache=True)
def compute_truth(states: Array, chain: Chain, field: WindField) -> tuple[Array, Array, Array, Array, Array]:
    """Position, velocity, rotation matrix from body to world, body rate and specific force for rows of states."""
    count = states.shape[0]
    positions, velocities = np.empty((count, 3)), np.empty((count, 3))
    body_rates, forces = np.empty((count, 3)), np.empty((count, 3))
    matrices = np.empty((count, 3, 3))
    for k in range(count):
        y = states[k]
        rates = derivatives(y, chain, field)
        axis, axis_rate, side = _vector(y, AXIS), _vector(y, AXIS_RATE), _vector(y, SIDE)
        positions[k] = _vector(y, CANOPY) + chain.line_m * _vector(y, LINE) + chain.reach_m * axis
        velocities[k] = _vector(y, CANOPY_RATE) + chain.line_m * _vector(y, LINE_RATE) + chain.reach_m * axis_rate
        force = (
            _vector(rates, CANOPY_RATE)
            + chain.line_m * _vector(rates, LINE_RATE)
            + chain.reach_m * _vector(rates, AXIS_RATE)
        )
        force[2] += chain.gravity_m_s2
        # Gram-Schmidt: removes the integration error of the side along the axis
        axis_norm = math.sqrt(_dot(axis, axis))
        x = side - _dot(side, axis) / axis_norm**2 * axis
        x = x / math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
        z = -axis / axis_norm
        matrices[k, :, 0], matrices[k, :, 1], matrices[k, :, 2] = x, _cross(z, x), z
        rotation = _cross(axis, axis_rate) + y[SPIN] * axis
        for j in range(3):
            body_rates[k, j] = _dot(matrices[k, :, j], rotation)
            forces[k, j] = _dot(matrices[k, :, j], force)
    return positions, velocities, matrices, body_rates, forces
