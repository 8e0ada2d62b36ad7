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
    """Mean wind and gusts as functions of height: see `marsyard.sim.dynamics.wind`.

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
def winds(heights: Array, field: WindField) -> Array:
    """Rows (east, north, up) of the wind at many heights."""
    rows = np.empty((heights.size, 3))
    for i in range(heights.size):
        rows[i] = wind_at(heights[i], field)
    return rows


@njit(cache=True)
def _dot(a: Array, i: int, b: Array, j: int) -> float:
    return float(a[i] * b[j] + a[i + 1] * b[j + 1] + a[i + 2] * b[j + 2])


@njit(cache=True)
def _cross(a: Array, i: int, b: Array, j: int) -> Array:
    out = np.empty(3)
    out[0] = a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1]
    out[1] = a[i + 2] * b[j] - a[i] * b[j + 2]
    out[2] = a[i] * b[j + 1] - a[i + 1] * b[j]
    return out


@njit(cache=True)
def aerodynamic_force(y: Array, chain: Chain, field: WindField) -> Array:
    """Force of the air on the canopy, N, world axes."""
    height = y[CANOPY + 2]
    relative = y[CANOPY_RATE : CANOPY_RATE + 3] - np.array(wind_at(height, field))
    force = np.empty(3)
    speed = math.sqrt(_dot(relative, 0, relative, 0))
    along = _dot(relative, 0, y, LINE)
    density = math.exp((chain.reference_height_m - height) / chain.scale_height_m)
    for i in range(3):
        across = relative[i] - along * y[LINE + i]
        force[i] = -density * speed * (chain.tangential * speed * y[LINE + i] + chain.normal * across)
    return force


@njit(cache=True)
def slope(_t: float, y: Array, constants: Array, waves: Array) -> Array:
    """`derivatives` with the signature of an integrator; constants are `packed`, as numba converts tuples slowly."""
    chain = Chain(*to_fixed_tuple(constants[:CHAIN_SIZE], CHAIN_SIZE))
    mean = to_fixed_tuple(constants[CHAIN_SIZE:], FIELD_SIZE)
    rates: Array = derivatives(y, chain, WindField(mean[0], mean[1], mean[2], mean[3], mean[4], waves))
    return rates


def packed(chain: Chain, field: WindField) -> tuple[Array, Array]:
    """The last two arguments of `slope`."""
    return np.array([*chain, *field[:FIELD_SIZE]]), field.waves


@njit(cache=True)
def interpolated(times: Array, knots: Array, starts: Array, lengths: Array, states: Array, polynomials: Array) -> Array:
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

    force = aerodynamic_force(y, chain, field)
    line_rotation = _cross(y, LINE, y, LINE_RATE)
    lander_rotation = _cross(y, AXIS, y, AXIS_RATE)
    spin = y[SPIN]
    rolling = _dot(lander_rotation, 0, y, LINE) + spin * _dot(y, AXIS, y, LINE)
    slip = np.empty(3)
    for i in range(3):
        slip[i] = lander_rotation[i] + spin * y[AXIS + i] - rolling * y[LINE + i] - line_rotation[i]
    slip_line = _cross(slip, 0, y, LINE)
    slip_axis = _cross(slip, 0, y, AXIS)
    gyro = _cross(y, AXIS_RATE, y, AXIS)

    line_speed2 = _dot(y, LINE_RATE, y, LINE_RATE)
    axis_speed2 = _dot(y, AXIS_RATE, y, AXIS_RATE)
    cosine = _dot(y, LINE, y, AXIS)
    force_line = _dot(force, 0, y, LINE)
    force_axis = _dot(force, 0, y, AXIS)
    pull_line = chain.first_moment / chain.mass_kg
    pull_axis = lander_moment / chain.mass_kg
    on_line = np.empty(3)
    on_axis = np.empty(3)
    for i in range(3):
        n = y[LINE + i]
        e = y[AXIS + i]
        on_line[i] = (
            chain.hinge_damping * slip_line[i]
            - pull_line * (force[i] - force_line * n)
            + c * axis_speed2 * (e - cosine * n)
        )
        on_axis[i] = (
            -chain.hinge_damping * slip_axis[i]
            - chain.axial_inertia * spin * gyro[i]
            - pull_axis * (force[i] - force_axis * e)
            + c * line_speed2 * (n - cosine * e)
        )
    # A w + C P_n x = on_line and B x + C P_e w = on_axis, w across the line n, x across the axis e
    source = np.empty(3)
    across = np.empty(3)
    pulled = _dot(on_axis, 0, y, LINE)
    for i in range(3):
        source[i] = on_line[i] - c / b * (on_axis[i] - pulled * y[LINE + i])
        across[i] = y[AXIS + i] - cosine * y[LINE + i]
    stiff = a - c * c / b
    extra = c * c / b
    along = _dot(across, 0, source, 0) / (stiff + extra * _dot(across, 0, across, 0))

    rates = np.empty(SIZE)
    turn = np.empty(3)
    for i in range(3):
        rates[CANOPY + i] = y[CANOPY_RATE + i]
        rates[LINE + i] = y[LINE_RATE + i]
        rates[AXIS + i] = y[AXIS_RATE + i]
        rates[LINE_RATE + i] = (source[i] - extra * across[i] * along) / stiff
    reaction = _dot(rates, LINE_RATE, y, AXIS)
    for i in range(3):
        w = rates[LINE_RATE + i]
        x = (on_axis[i] - c * (w - reaction * y[AXIS + i])) / b
        rates[AXIS_RATE + i] = x - axis_speed2 * y[AXIS + i]
        rates[LINE_RATE + i] = w - line_speed2 * y[LINE + i]
        rates[CANOPY_RATE + i] = (
            force[i] - chain.first_moment * rates[LINE_RATE + i] - lander_moment * rates[AXIS_RATE + i]
        ) / chain.mass_kg
        turn[i] = lander_rotation[i] + spin * y[AXIS + i]
    rates[CANOPY_RATE + 2] -= chain.gravity_m_s2
    rates[SIDE : SIDE + 3] = _cross(turn, 0, y, SIDE)
    rates[SPIN] = -chain.hinge_damping * _dot(slip, 0, y, AXIS) / chain.axial_inertia
    return rates


@njit(cache=True)
def truth(states: Array, chain: Chain, field: WindField) -> tuple[Array, Array, Array, Array, Array]:
    """Position, velocity, rotation matrix from body to world, body rate and specific force for rows of states."""
    count = states.shape[0]
    positions = np.empty((count, 3))
    velocities = np.empty((count, 3))
    matrices = np.empty((count, 3, 3))
    body_rates = np.empty((count, 3))
    forces = np.empty((count, 3))
    force = np.empty(3)
    for k in range(count):
        y = states[k]
        rates = derivatives(y, chain, field)
        # Gram-Schmidt: removes the integration error of the side along the axis
        axis_norm = math.sqrt(_dot(y, AXIS, y, AXIS))
        along_axis = _dot(y, SIDE, y, AXIS) / axis_norm**2
        for i in range(3):
            positions[k, i] = y[CANOPY + i] + chain.line_m * y[LINE + i] + chain.reach_m * y[AXIS + i]
            velocities[k, i] = y[CANOPY_RATE + i] + chain.line_m * y[LINE_RATE + i] + chain.reach_m * y[AXIS_RATE + i]
            force[i] = (
                rates[CANOPY_RATE + i] + chain.line_m * rates[LINE_RATE + i] + chain.reach_m * rates[AXIS_RATE + i]
            )
            matrices[k, i, 2] = -y[AXIS + i] / axis_norm
            matrices[k, i, 0] = y[SIDE + i] - along_axis * y[AXIS + i]
        force[2] += chain.gravity_m_s2
        side_norm = math.sqrt(matrices[k, 0, 0] ** 2 + matrices[k, 1, 0] ** 2 + matrices[k, 2, 0] ** 2)
        for i in range(3):
            matrices[k, i, 0] /= side_norm
        matrices[k, :, 1] = _cross(matrices[k, :, 2].copy(), 0, matrices[k, :, 0].copy(), 0)
        turn = _cross(y, AXIS, y, AXIS_RATE)
        for i in range(3):
            turn[i] += y[SPIN] * y[AXIS + i]
        for j in range(3):
            body_rates[k, j] = matrices[k, 0, j] * turn[0] + matrices[k, 1, j] * turn[1] + matrices[k, 2, j] * turn[2]
            forces[k, j] = matrices[k, 0, j] * force[0] + matrices[k, 1, j] * force[1] + matrices[k, 2, j] * force[2]
    return positions, velocities, matrices, body_rates, forces
