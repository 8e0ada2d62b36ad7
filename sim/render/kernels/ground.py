"""Intersection of rays with the ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Extent, GroundLevel, Ray
from marsyard.sim.terrain.kernels import CEILING_BLOCK, Level, sample

#: Shortest step of the search along a ray, relative to the distance: a quarter of a navcam pixel's footprint at 10 deg,
#: because even low crests hide the ground behind them.
FINEST_STEP = 0.00125
#: Iterations of the search for a crest. Of 51,485 grazing rays of a rover's pictures 4 then pass through one; with one
#: iteration, and by steps alone, 25 did (ADR 34).
CREST_ITERATIONS = 4
#: Iterations of the search for a crossing by the cubic (1.1 are needed on average, 3.6 by false position), and in all;
#: the later ones are false position, which never fails.
CUBIC_ITERATIONS, MAX_ITERATIONS = 3, 40
#: Rate of clearance above which Newton's method is not used.
CLOSING = -1e-3


class Clearance(NamedTuple):
    """Height of a ray above the ground at a distance along it, metres, and its rate of change with the distance."""

    t: float
    height: float
    rate: float


@njit(cache=True, inline="always")
def clearance_at(field: Level, per_metre: float, ray: Ray, t: float) -> Clearance:
    """Clearance of a ray over a level of the ground at a distance."""
    height, slope_x, slope_y, _albedo = sample(field, per_metre, ray.x + t * ray.dx, ray.y + t * ray.dy)
    return Clearance(t, ray.z + t * ray.dz - height, ray.dz - slope_x * ray.dx - slope_y * ray.dy)


@njit(cache=True)
def skip_empty_blocks(level: GroundLevel, ray: Ray, start: float, farthest: float) -> float:
    """Distance from `start` on at which a ray enters the first block that it may not be clear of; else >= `farthest`.

    The blocks are those of `Surface.ceilings`, traversed one by one (Amanatides & Woo 1987).
    """
    per_metre = level.per_metre / CEILING_BLOCK
    ceiling = level.ceiling
    mask = ceiling.shape[0] - 1
    gx, gy = (ray.x + start * ray.dx) * per_metre, (ray.y + start * ray.dy) * per_metre
    j, i = math.floor(gx), math.floor(gy)
    across, along = ray.dx * per_metre, ray.dy * per_metre
    step_x = 1.0 / abs(across) if across != 0.0 else math.inf
    step_y = 1.0 / abs(along) if along != 0.0 else math.inf
    next_x = start + ((j + 1 - gx) if across > 0.0 else (gx - j)) * step_x if across != 0.0 else math.inf
    next_y = start + ((i + 1 - gy) if along > 0.0 else (gy - i)) * step_y if along != 0.0 else math.inf
    right, up = 1 if across > 0.0 else -1, 1 if along > 0.0 else -1
    t = start
    while t < farthest:
        out = min(next_x, next_y)
        lowest = ray.z + (out if ray.dz < 0.0 else t) * ray.dz
        if lowest <= ceiling[i & mask, j & mask]:
            break
        t = out
        # selections instead of branches: the side by which a ray leaves a block cannot be predicted
        through_side = next_x < next_y
        j += right if through_side else 0
        i += 0 if through_side else up
        next_x = next_x + step_x if through_side else next_x
        next_y = next_y if through_side else next_y + step_y
    return t


@njit(cache=True)
def find_occluding_crest(level: GroundLevel, ray: Ray, near: Clearance, far: Clearance) -> Clearance:
    """Bracket a crest between two positions above the ground by tangent intersection.

    The ray approaches the ground at `near` and leaves it at `far`. A crest between is no higher than the intersection
    of the tangents of the clearance; while that is below the ground, the clearance there is sampled and replaces one
    side. Returns a position below the crest; its height is 0 where there is none.
    """
    field, per_metre = level.field, level.per_metre
    for _ in range(CREST_ITERATIONS):
        step = (far.rate * (far.t - near.t) - far.height + near.height) / (far.rate - near.rate)
        if near.height + near.rate * step >= 0.0:
            break
        here: Clearance = clearance_at(field, per_metre, ray, near.t + step)
        if here.height < 0.0:
            return here
        if here.rate < 0.0:
            near = here
        else:
            far = here
    return Clearance(far.t, 0.0, 0.0)


@njit(cache=True, inline="always")
def _cubic_crossing(above: float, rate_above: float, below: float, rate_below: float, guess: float) -> float:
    """Fraction of the way at which the cubic of a value above 0, one below it, and both rates crosses 0.

    Three steps of Newton's method from a guess; the guess itself where they diverge.
    """
    second = 3.0 * (below - above) - 2.0 * rate_above - rate_below
    third = 2.0 * (above - below) + rate_above + rate_below
    fraction = guess
    for _ in range(3):
        value = above + fraction * (rate_above + fraction * (second + fraction * third))
        slope = rate_above + fraction * (2.0 * second + fraction * 3.0 * third)
        fraction -= value / slope if slope < 0.0 else 0.0
    return fraction if 0.0 < fraction < 1.0 else guess


@njit(cache=True)
def _bracketed_crossing(level: GroundLevel, ray: Ray, above: Clearance, below: Clearance) -> float:
    """Distance of the crossing between a position above the ground and one below it.

    The root of the cubic of clearance and rate at both ends, then false position (Illinois), to a thousandth of a
    sample; a final step of Newton's method needs no further sample.
    """
    field, per_metre = level.field, level.per_metre
    spacing = 1.0 / per_metre
    before, above_height, above_rate = above.t, above.height, above.rate
    t, below_height, below_rate = below.t, below.height, below.rate
    middle = below
    for iteration in range(MAX_ITERATIONS):
        fraction = above_height / (above_height - below_height)
        weight = 0.5
        if iteration < CUBIC_ITERATIONS:
            fraction = _cubic_crossing(
                above_height, above_rate * (t - before), below_height, below_rate * (t - before), fraction
            )
            weight = 1.0
        middle = clearance_at(field, per_metre, ray, before + (t - before) * fraction)
        if abs(middle.height) < 1e-3 * spacing * max(-ray.dz, 1e-3) or t - before <= 0.01 * spacing:
            break
        if middle.height < 0.0:
            t, below_height, below_rate = middle.t, middle.height, middle.rate
            above_height *= weight
        else:
            before, above_height, above_rate = middle.t, middle.height, middle.rate
            below_height *= weight
    polished = middle.t - middle.height / middle.rate if middle.rate < CLOSING else middle.t
    return polished if before < polished < t else middle.t


@njit(cache=True)
def cross_ground(level: GroundLevel, ray: Ray, start: float, farthest: float) -> float:
    """Distance at which a ray first dips below the ground between two distances; infinite where it does not.

    Steps are a sample long, longer far away. Blocks whose ceilings the ray clears are skipped; without ceilings (a
    single one) steps are longer high above the ground. Where the ray approaches the ground at the beginning of a step
    and leaves it at the end, a crest between is searched for.
    """
    if start >= farthest:
        return math.inf
    field, per_metre = level.field, level.per_metre
    spacing = 1.0 / per_metre
    bounded = level.ceiling.shape[0] > 1
    t = start
    if bounded:
        t = skip_empty_blocks(level, ray, start, farthest)
        if t >= farthest:
            return math.inf
    before = Clearance(t, 0.0, 0.0)
    skipped = True
    while True:
        here = clearance_at(field, per_metre, ray, t)
        if here.height < 0.0:
            break
        if not skipped and before.rate < 0.0 and here.rate > 0.0:
            crest = find_occluding_crest(level, ray, before, here)
            if crest.height < 0.0:
                here = crest
                break
        if t >= farthest:
            return math.inf
        before = here
        skipped = False
        step = max(spacing, FINEST_STEP * t)
        if not bounded:
            step = max(step, 1.5 * here.height)
        elif here.height > spacing:
            clear = skip_empty_blocks(level, ray, t, farthest)
            if clear >= farthest:
                return math.inf
            if clear > t + step:
                step = clear - t
                skipped = True
        t = min(t + step, farthest)
    return math.inf if here.t == before.t else _bracketed_crossing(level, ray, before, here)


@njit(cache=True, inline="always")
def exit_distance(extent: Extent, ray: Ray) -> float:
    """Distance along a ray to where it leaves the ground's extent, in which it begins."""
    along_x = ((extent[1] if ray.dx > 0.0 else extent[0]) - ray.x) / ray.dx if ray.dx != 0.0 else math.inf
    along_y = ((extent[3] if ray.dy > 0.0 else extent[2]) - ray.y) / ray.dy if ray.dy != 0.0 else math.inf
    return min(along_x, along_y)


@njit(cache=True, inline="always")
def entry_distance(extent: Extent, ray: Ray) -> float:
    """Distance along a ray to where it comes below the highest ground."""
    if ray.z <= extent[4]:
        return 0.0
    return (extent[4] - ray.z) / ray.dz if ray.dz < 0.0 else math.inf


@njit(cache=True)
def first_ground(level: GroundLevel, extent: Extent, ray: Ray, guess: float) -> float:
    """Distance at which a grazing ray first dips below the ground, from four fifths of a guess to past it; else the
    guess.

    The mesh that gives the guess does not resolve every crest.
    """
    start = max(0.8 * guess, entry_distance(extent, ray))
    farthest = min(1.25 * guess + 4.0 / level.per_metre, exit_distance(extent, ray))
    met = cross_ground(level, ray, start, farthest)
    return met if met < math.inf else guess


@njit(cache=True)
def height_range(field: Level) -> tuple[float, float]:
    """Lowest and highest control value of height: bounds of the surface."""
    # heights and albedos alike: adjacent numbers are compared by vector instructions
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
def max_rises(field: Level, bound: float, along_x: float, along_y: float) -> tuple[float, float]:
    """Maximum height step between adjacent control values, along x and y; infinite as soon as a bound is exceeded.

    It bounds the spline's slope times the spacing, and that of any straight line between two points. The bound is on
    the sum of both, weighted by `along_x` and `along_y`.
    """
    side = field.shape[0]
    step_x = np.zeros(side, dtype=np.float32)
    step_y = np.zeros(side, dtype=np.float32)
    rise_x, rise_y = 0.0, 0.0
    for i in range(side):
        here, above = field[i], field[i - 1]
        step_x[0] = max(step_x[0], abs(here[0, 0] - here[side - 1, 0]))
        for j in range(1, side):
            step_x[j] = max(step_x[j], abs(here[j, 0] - here[j - 1, 0]))
        for j in range(side):
            step_y[j] = max(step_y[j], abs(here[j, 0] - above[j, 0]))
        if i % 64 == 63 or i == side - 1:
            rise_x = float(step_x.max())
            rise_y = float(step_y.max())
            if rise_x * along_x + rise_y * along_y > bound:
                return math.inf, math.inf
    return rise_x, rise_y
