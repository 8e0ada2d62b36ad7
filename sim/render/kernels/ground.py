"""Where a ray meets the ground, and where the ground keeps the sun from itself."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.terrain.kernels import Array, Level, sample

Array32 = NDArray[np.float32]


@njit(cache=True, inline="always")
def meet_ground(
    field: Level,
    inverse_spacing: float,
    x0: float,
    y0: float,
    z0: float,
    dx: float,
    dy: float,
    dz: float,
    start: float,
) -> float:
    """Distance along a ray to the surface near a first guess, by Newton's method; the guess itself where it fails."""
    t = start
    bound = 0.05 * start
    # A step that short leaves, by the surface's greatest curvature of about one over its spacing, less than 1e-6 of
    # the distance.
    short = math.sqrt(2e-6 * start / inverse_spacing)
    for _ in range(8):
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, x0 + t * dx, y0 + t * dy)
        miss = z0 + t * dz - height
        closing = dz - slope_x * dx - slope_y * dy
        if closing > -1e-3:
            return start
        step = miss / closing
        t -= step
        if abs(t - start) > bound:
            return start
        if abs(step) < short:
            break
    return t


@njit(cache=True)
def sweep_shadow(height: Array32, along: float, drop: float, slip: float, reach: int) -> Array32:
    """Height of the shadow over every post of a periodic grid: below it the sun is hidden by the ground.

    The sun stands towards growing rows. A shadow falls by `drop` and shifts by `-slip` columns from one row to the one
    before; a row's shadow is cast by the ground and the shadow of the row after it.

    Parameters
    ----------
    height
        Heights, shape (rows, columns); rows run towards the sun.
    along
        1.0 where rows run towards the sun as stored, -1.0 where they run away from it.
    drop
        How far a shadow falls from one row to the next, metres.
    slip
        Columns by which the sun's direction moves along from one row to the next.
    reach
        Rows that the longest shadow covers: the sweep starts as many before the first.
    """
    rows, columns = height.shape
    row_mask, column_mask = rows - 1, columns - 1
    shadow = np.empty_like(height)
    whole = math.floor(slip)
    share = np.float32(slip - whole)
    rest = np.float32(1.0) - share
    fall = np.float32(drop)
    lowest = np.float32(-1e9)
    before = np.full(columns, lowest, dtype=np.float32)
    caster = np.empty(columns, dtype=np.float32)
    for k in range(rows + reach):
        step = rows + reach - 1 - k
        i = step & row_mask if along > 0.0 else (rows - 1 - step) & row_mask
        source = (i + 1) & row_mask if along > 0.0 else (i - 1) & row_mask
        for j in range(columns):
            caster[j] = max(height[source, j], before[j])
        for j in range(columns):
            a = (j + whole) & column_mask
            b = (a + 1) & column_mask
            before[j] = rest * caster[a] + share * caster[b] - fall
        for j in range(columns):
            shadow[i, j] = before[j]
    return shadow


@njit(cache=True, inline="always")
def shadow_clearance(shadow: Array32, inverse_spacing: float, x: float, y: float, z: float) -> float:
    """How far a place lies above the ground's shadow, metres."""
    row_mask = shadow.shape[0] - 1
    gx = x * inverse_spacing
    gy = y * inverse_spacing
    j = math.floor(gx)
    i = math.floor(gy)
    fx = gx - j
    fy = gy - i
    i0 = i & row_mask
    i1 = (i + 1) & row_mask
    j0 = j & row_mask
    j1 = (j + 1) & row_mask
    edge = (1.0 - fy) * ((1.0 - fx) * shadow[i0, j0] + fx * shadow[i0, j1])
    edge += fy * ((1.0 - fx) * shadow[i1, j0] + fx * shadow[i1, j1])
    clearance: float = z - edge
    return clearance


@njit(cache=True)
def hidden_from_sun(
    field: Level, inverse_spacing: float, x: float, y: float, z: float, sun: Array, highest: float
) -> bool:
    """Whether the ground hides the sun from a place on it, by steps of half a sample or of the clearance reached."""
    spacing = 1.0 / inverse_spacing
    t = 0.25 * spacing
    farthest = (highest - z) / max(sun[2], 1e-6)
    while t < farthest:
        height, _slope_x, _slope_y, _albedo = sample(field, inverse_spacing, x + t * sun[0], y + t * sun[1])
        clearance = z + t * sun[2] - height
        if clearance < 0.0:
            return True
        t += max(0.5 * spacing, clearance)
    return False


@njit(cache=True)
def cross_ground(
    field: Level,
    inverse_spacing: float,
    x0: float,
    y0: float,
    z0: float,
    dx: float,
    dy: float,
    dz: float,
    start: float,
    farthest: float,
) -> float:
    """Distance at which a ray first dips below the ground between two distances; infinite where it does not.

    The ray is followed by steps of a sample, longer where it runs high above the ground, and the crossing closed in on
    by false position (Illinois) to a hundredth of a sample.
    """
    spacing = 1.0 / inverse_spacing
    before = start
    above = 0.0
    t = start
    clearance = 0.0
    while t < farthest:
        height, _slope_x, _slope_y, _albedo = sample(field, inverse_spacing, x0 + t * dx, y0 + t * dy)
        clearance = z0 + t * dz - height
        if clearance < 0.0:
            break
        before = t
        above = clearance
        t += max(spacing, 1.5 * clearance)
    if t >= farthest or t == before:
        return math.inf
    below = clearance
    for _ in range(40):
        if t - before <= 0.01 * spacing:
            break
        middle = before + (t - before) * above / (above - below)
        height, _slope_x, _slope_y, _albedo = sample(field, inverse_spacing, x0 + middle * dx, y0 + middle * dy)
        clearance = z0 + middle * dz - height
        if abs(clearance) < 1e-3 * spacing * max(-dz, 1e-3):
            return middle
        if clearance < 0.0:
            t = middle
            below = clearance
            above *= 0.5
        else:
            before = middle
            above = clearance
            below *= 0.5
    return 0.5 * (before + t)


@njit(cache=True)
def first_ground(
    field: Level,
    inverse_spacing: float,
    x0: float,
    y0: float,
    z0: float,
    dx: float,
    dy: float,
    dz: float,
    guess: float,
) -> float:
    """Distance at which a flat ray first dips below the ground, from four fifths of the way to a guess to past it.

    The mesh that gives the guess does not hold every crest. The guess itself where the ray does not dip.
    """
    farthest = 1.25 * guess + 4.0 / inverse_spacing
    met = cross_ground(field, inverse_spacing, x0, y0, z0, dx, dy, dz, 0.8 * guess, farthest)
    return met if met < math.inf else guess


@njit(cache=True)
def height_range(field: Level) -> tuple[float, float]:
    """Lowest and highest control value of height: bounds of the surface."""
    low = np.float32(np.inf)
    high = np.float32(-np.inf)
    for i in range(field.shape[0]):
        for j in range(field.shape[1]):
            low = min(low, field[i, j, 0])
            high = max(high, field[i, j, 0])
    return float(low), float(high)


__all__ = [
    "Array",
    "Array32",
    "Level",
    "cross_ground",
    "first_ground",
    "height_range",
    "hidden_from_sun",
    "meet_ground",
    "shadow_clearance",
    "sweep_shadow",
]
