"""Where a ray meets the ground."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.terrain.kernels import CEILING_BLOCK, Array, Level, sample

Array32 = NDArray[np.float32]
#: Where the ground that is drawn ends: least and greatest x, least and greatest y, metres.
Bounds = tuple[float, float, float, float]
#: Shortest step along a ray that looks for the ground, as a share of the distance: a quarter of what a navcam's pixel
#: takes in at 10 deg, for crests hide what is behind them however little they stand out.
FINEST_STEP = 0.00125
#: How often a crest between two places is looked for, ever closer to its top. Of 51,485 flat rays of a rover's pictures
#: 4 then go through one; with one look, and by steps alone, 25 did (ADR 34).
CREST_LOOKS = 4


@njit(cache=True, inline="always")
def turned(rotation: Array, vectors: Array | Array32, n: int) -> tuple[float, float, float]:
    """The n-th of some vectors in the axes that a rotation matrix turns it to."""
    x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@njit(cache=True, inline="always")
def world_ray(
    world_from_body: Array, position: Array, origins: Array | Array32, directions: Array | Array32, n: int
) -> tuple[float, float, float, float, float, float]:
    """Origin and direction in world axes of the n-th of some rays, whose origins are relative to `position`."""
    dx, dy, dz = turned(world_from_body, directions, n)
    x, y, z = turned(world_from_body, origins, n)
    return position[0] + x, position[1] + y, position[2] + z, dx, dy, dz


@njit(cache=True)
def pass_over(
    ceiling: Array32,
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
    """Distance at which a ray comes into the first block of the ground that it may not be clear of, from a distance on.

    At least `farthest` where it is clear of all on its way. The blocks are those of `Surface.ceilings`; they are gone
    through one by one (Amanatides & Woo 1987).
    """
    per_metre = inverse_spacing / CEILING_BLOCK
    mask = ceiling.shape[0] - 1
    gx, gy = (x0 + start * dx) * per_metre, (y0 + start * dy) * per_metre
    j, i = math.floor(gx), math.floor(gy)
    across, along = dx * per_metre, dy * per_metre
    step_x = 1.0 / abs(across) if across != 0.0 else math.inf
    step_y = 1.0 / abs(along) if along != 0.0 else math.inf
    next_x = start + ((j + 1 - gx) if across > 0.0 else (gx - j)) * step_x if across != 0.0 else math.inf
    next_y = start + ((i + 1 - gy) if along > 0.0 else (gy - i)) * step_y if along != 0.0 else math.inf
    t = start
    while t < farthest:
        out = min(next_x, next_y)
        lowest = z0 + (out if dz < 0.0 else t) * dz
        if lowest <= ceiling[i & mask, j & mask]:
            break
        t = out
        if next_x < next_y:
            next_x += step_x
            j += 1 if across > 0.0 else -1
        else:
            next_y += step_y
            i += 1 if along > 0.0 else -1
    return t


@njit(cache=True)
def _crest_over(
    field: Level,
    inverse_spacing: float,
    x0: float,
    y0: float,
    z0: float,
    dx: float,
    dy: float,
    dz: float,
    near: float,
    above_near: float,
    rate_near: float,
    far: float,
    above_far: float,
    rate_far: float,
) -> tuple[float, float]:
    """A place below a crest between two that are above the ground, and its clearance; 0 where there is none.

    The ray nears the ground at the first and leaves it at the second. A crest between stands no higher than where the
    tangents of the clearance meet; while that is below the ground, the place is looked at and takes that side's part.
    """
    for _ in range(CREST_LOOKS):
        step = (rate_far * (far - near) - above_far + above_near) / (rate_far - rate_near)
        if above_near + rate_near * step >= 0.0:
            break
        t = near + step
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, x0 + t * dx, y0 + t * dy)
        clearance = z0 + t * dz - height
        if clearance < 0.0:
            return t, clearance
        rate = dz - slope_x * dx - slope_y * dy
        if rate < 0.0:
            near, above_near, rate_near = t, clearance, rate
        else:
            far, above_far, rate_far = t, clearance, rate
    return far, 0.0


@njit(cache=True)
def cross_ground(
    field: Level,
    ceiling: Array32,
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

    The ray is followed by steps of a sample, longer far away; blocks of ground that it is clear of by their ceilings
    are passed over, or, where no ceilings are known (a single one), longer steps are taken high above the ground. Where
    it nears the ground at the beginning of a step and leaves it at the end, the crest between is looked for. The
    crossing is closed in on by false position (Illinois) to a hundredth of a sample.
    """
    spacing = 1.0 / inverse_spacing
    bounded = ceiling.shape[0] > 1
    t = start
    if bounded:
        t = pass_over(ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, start, farthest)
    before = t
    above = 0.0
    rate_before = 0.0
    clearance = 0.0
    while t < farthest:
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, x0 + t * dx, y0 + t * dy)
        clearance = z0 + t * dz - height
        if clearance < 0.0:
            break
        rate = dz - slope_x * dx - slope_y * dy
        if rate_before < 0.0 and rate > 0.0:
            crest, under = _crest_over(
                field, inverse_spacing, x0, y0, z0, dx, dy, dz, before, above, rate_before, t, clearance, rate
            )
            if under < 0.0:
                t = crest
                clearance = under
                break
        rate_before = rate
        before = t
        above = clearance
        step = max(spacing, FINEST_STEP * t)
        if not bounded:
            step = max(step, 1.5 * clearance)
        elif clearance > spacing:
            clear = pass_over(ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, t, farthest)
            if clear > t + step:
                step = clear - t
                rate_before = 0.0
        t += step
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


@njit(cache=True, inline="always")
def way_out(bounds: Bounds, x: float, y: float, dx: float, dy: float) -> float:
    """Distance along a ray to where it leaves the ground's bounds, in which it begins."""
    along_x = ((bounds[1] if dx > 0.0 else bounds[0]) - x) / dx if dx != 0.0 else math.inf
    along_y = ((bounds[3] if dy > 0.0 else bounds[2]) - y) / dy if dy != 0.0 else math.inf
    return min(along_x, along_y)


@njit(cache=True)
def first_ground(
    field: Level,
    ceiling: Array32,
    inverse_spacing: float,
    bounds: Bounds,
    x0: float,
    y0: float,
    z0: float,
    dx: float,
    dy: float,
    dz: float,
    guess: float,
) -> float:
    """Distance at which a flat ray first dips below the ground, from four fifths of the way to a guess to past it.

    The mesh that gives the guess does not hold every crest. The guess itself where the ray does not dip within the
    bounds.
    """
    farthest = min(1.25 * guess + 4.0 / inverse_spacing, way_out(bounds, x0, y0, dx, dy))
    met = cross_ground(field, ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, 0.8 * guess, farthest)
    return met if met < math.inf else guess


@njit(cache=True)
def height_range(field: Level) -> tuple[float, float]:
    """Lowest and highest control value of height: bounds of the surface."""
    # row by row, heights and albedos alike: numbers side by side are compared by vector instructions
    flat = field.reshape(field.shape[0], -1)
    low = np.full(flat.shape[1], np.inf, dtype=np.float32)
    high = np.full(flat.shape[1], -np.inf, dtype=np.float32)
    for i in range(flat.shape[0]):
        row = flat[i]
        for j in range(row.size):
            low[j] = min(low[j], row[j])
            high[j] = max(high[j], row[j])
    return float(low[::2].min()), float(high[::2].max())


@njit(cache=True)
def greatest_rises(field: Level, most: float, along_x: float, along_y: float) -> tuple[float, float]:
    """Greatest difference of height between control values side by side, along x and along y; infinite if in vain.

    A spline's slope is a mean of such differences over the spacing, and so is a straight line's between any two places.
    In vain is a sum beyond `most` of both, weighed by `along_x` and `along_y`: the rest of the ground is not looked at.
    """
    side = field.shape[0]
    beside = np.zeros(side, dtype=np.float32)
    before = np.zeros(side, dtype=np.float32)
    rise_x = 0.0
    rise_y = 0.0
    for i in range(side):
        here, above = field[i], field[i - 1]
        beside[0] = max(beside[0], abs(here[0, 0] - here[side - 1, 0]))
        for j in range(1, side):
            beside[j] = max(beside[j], abs(here[j, 0] - here[j - 1, 0]))
        for j in range(side):
            before[j] = max(before[j], abs(here[j, 0] - above[j, 0]))
        if i % 64 == 63 or i == side - 1:
            rise_x = float(beside.max())
            rise_y = float(before.max())
            if rise_x * along_x + rise_y * along_y > most:
                return math.inf, math.inf
    return rise_x, rise_y


__all__ = [
    "Array",
    "Array32",
    "Bounds",
    "Level",
    "cross_ground",
    "first_ground",
    "greatest_rises",
    "height_range",
    "turned",
    "way_out",
    "world_ray",
]
