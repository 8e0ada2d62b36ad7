"""Where a ray meets the ground."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import CEILING_BLOCK, Array, Level, sample

Array32 = NDArray[np.float32]
#: Least and greatest x, least and greatest y, metres.
Bounds = tuple[float, float, float, float]
#: Where the ground that is drawn ends: these, and greatest z.
Extent = tuple[float, float, float, float, float]
#: Shortest step along a ray that looks for the ground, as a share of the distance: a quarter of what a navcam's pixel
#: takes in at 10 deg, for crests hide what is behind them however little they stand out.
FINEST_STEP = 0.00125
#: How often a crest between two places is looked for, ever closer to its top. Of 51,485 flat rays of a rover's pictures
#: 4 then go through one; with one look, and by steps alone, 25 did (ADR 34).
CREST_LOOKS = 4
#: How often a crossing is looked for where values and slopes at both ends say, which nearly always finds it at once
#: (1.1 looks, of 3.6 by false position); and in all, for after that it is false position, which never fails.
CUBIC_LOOKS, MOST_LOOKS = 3, 40
#: Slowest closing of a ray with the ground, metres a metre, at which Newton's method is trusted.
CLOSING = -1e-3


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
    right, up = 1 if across > 0.0 else -1, 1 if along > 0.0 else -1
    t = start
    while t < farthest:
        out = min(next_x, next_y)
        lowest = z0 + (out if dz < 0.0 else t) * dz
        if lowest <= ceiling[i & mask, j & mask]:
            break
        t = out
        # chosen, not branched to: which side a ray leaves a block by cannot be foretold
        beside = next_x < next_y
        j += right if beside else 0
        i += 0 if beside else up
        next_x = next_x + step_x if beside else next_x
        next_y = next_y if beside else next_y + step_y
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
) -> tuple[float, float, float]:
    """A place below a crest between two that are above the ground, its clearance, 0 where there is none, and its rate.

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
        rate = dz - slope_x * dx - slope_y * dy
        if clearance < 0.0:
            return t, clearance, rate
        if rate < 0.0:
            near, above_near, rate_near = t, clearance, rate
        else:
            far, above_far, rate_far = t, clearance, rate
    return far, 0.0, 0.0


@njit(cache=True, inline="always")
def _down_through(above: float, rate_above: float, below: float, rate_below: float, guess: float) -> float:
    """The share of the way from a value above 0 to one below it at which the cubic of these values and rates is 0.

    By three steps of Newton's method from a guess; the guess where they lead astray.
    """
    second = 3.0 * (below - above) - 2.0 * rate_above - rate_below
    third = 2.0 * (above - below) + rate_above + rate_below
    share = guess
    for _ in range(3):
        value = above + share * (rate_above + share * (second + share * third))
        slope = rate_above + share * (2.0 * second + share * 3.0 * third)
        share -= value / slope if slope < 0.0 else 0.0
    return share if 0.0 < share < 1.0 else guess


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
    crossing is closed in on where the cubic of clearance and closing at both ends is 0, then by false position
    (Illinois), to a thousandth of a sample; a step of Newton's method, which needs no further look, ends it.
    """
    if start >= farthest:
        return math.inf
    spacing = 1.0 / inverse_spacing
    bounded = ceiling.shape[0] > 1
    t = start
    if bounded:
        t = pass_over(ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, start, farthest)
        if t >= farthest:
            return math.inf
    before = t
    above = 0.0
    below = 0.0
    rate_before = 0.0
    rate = 0.0
    leapt = True
    while True:
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, x0 + t * dx, y0 + t * dy)
        below = z0 + t * dz - height
        rate = dz - slope_x * dx - slope_y * dy
        if below < 0.0:
            break
        if not leapt and rate_before < 0.0 and rate > 0.0:
            crest, under, rate_under = _crest_over(
                field, inverse_spacing, x0, y0, z0, dx, dy, dz, before, above, rate_before, t, below, rate
            )
            if under < 0.0:
                t = crest
                below = under
                rate = rate_under
                break
        if t >= farthest:
            return math.inf
        before = t
        above = below
        rate_before = rate
        leapt = False
        step = max(spacing, FINEST_STEP * t)
        if not bounded:
            step = max(step, 1.5 * above)
        elif above > spacing:
            clear = pass_over(ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, t, farthest)
            if clear >= farthest:
                return math.inf
            if clear > t + step:
                step = clear - t
                leapt = True
        t = min(t + step, farthest)
    if t == before:
        return math.inf
    middle = t
    clearance = below
    closing = 0.0
    for look in range(MOST_LOOKS):
        share = above / (above - below)
        kept = 0.5
        if look < CUBIC_LOOKS:
            share = _down_through(above, rate_before * (t - before), below, rate * (t - before), share)
            kept = 1.0
        middle = before + (t - before) * share
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, x0 + middle * dx, y0 + middle * dy)
        clearance = z0 + middle * dz - height
        closing = dz - slope_x * dx - slope_y * dy
        if abs(clearance) < 1e-3 * spacing * max(-dz, 1e-3) or t - before <= 0.01 * spacing:
            break
        if clearance < 0.0:
            t = middle
            below = clearance
            rate = closing
            above *= kept
        else:
            before = middle
            above = clearance
            rate_before = closing
            below *= kept
    polished = middle - clearance / closing if closing < CLOSING else middle
    return polished if before < polished < t else middle


@njit(cache=True, inline="always")
def way_out(extent: Extent, x: float, y: float, dx: float, dy: float) -> float:
    """Distance along a ray to where it leaves the ground's extent, in which it begins."""
    along_x = ((extent[1] if dx > 0.0 else extent[0]) - x) / dx if dx != 0.0 else math.inf
    along_y = ((extent[3] if dy > 0.0 else extent[2]) - y) / dy if dy != 0.0 else math.inf
    return min(along_x, along_y)


@njit(cache=True, inline="always")
def way_in(extent: Extent, z: float, dz: float) -> float:
    """Distance along a ray from which it may meet the ground: where it comes below all that stands highest."""
    if z <= extent[4]:
        return 0.0
    return (extent[4] - z) / dz if dz < 0.0 else math.inf


@njit(cache=True)
def first_ground(
    field: Level,
    ceiling: Array32,
    inverse_spacing: float,
    extent: Extent,
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
    extent.
    """
    start = max(0.8 * guess, way_in(extent, z0, dz))
    farthest = min(1.25 * guess + 4.0 / inverse_spacing, way_out(extent, x0, y0, dx, dy))
    met = cross_ground(field, ceiling, inverse_spacing, x0, y0, z0, dx, dy, dz, start, farthest)
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
    "Extent",
    "Level",
    "cross_ground",
    "first_ground",
    "greatest_rises",
    "height_range",
    "turned",
    "way_in",
    "way_out",
    "world_ray",
]
