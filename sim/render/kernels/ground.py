"""Intersection of rays with the ground: search along the ray, then root finding in the interval with a crossing.

The ground is a B-spline surface, sampled from one level of the terrain. All distances are along the ray, in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Extent, GroundLevel, Ray
from marsyard.sim.terrain.kernels import CEILING_BLOCK, Level, sample

#: Minimum step of the search along a ray, relative to the distance: a quarter of a navcam pixel's footprint at 10 deg,
#: because even low crests hide the ground behind them.
MIN_STEP_FRACTION = 0.00125
#: Iterations of the search for a crest. Of 51,485 grazing rays in rover images, 4 rays miss a crest with four
#: iterations, and 25 rays with one iteration or without this search (ADR 6).
CREST_ITERATIONS = 4
#: Maximum number of iterations with the cubic (1.1 on average; false position alone takes 3.6), and in total. The
#: remaining iterations use false position, which always converges.
CUBIC_ITERATIONS, MAX_ITERATIONS = 3, 40
#: Newton's method is used only where the rate of the clearance is below this, metres per metre.
MAX_NEWTON_RATE = -1e-3


class Clearance(NamedTuple):
    """Height of a ray above the ground at a distance along it, metres, and its rate of change with the distance."""

    t: float
    height: float
    rate: float


@njit(cache=True, inline="always")
def clearance_at(field: Level, per_metre: float, ray: Ray, t: float) -> Clearance:
    """Compute the clearance of a ray above one level of the ground at a distance."""
    height, slope_x, slope_y, _albedo = sample(field, per_metre, ray.x + t * ray.dx, ray.y + t * ray.dy)
    return Clearance(t, ray.z + t * ray.dz - height, ray.dz - slope_x * ray.dx - slope_y * ray.dy)


@njit(cache=True)
def skip_empty_blocks(level: GroundLevel, ray: Ray, start: float, farthest: float) -> float:
    """Distance, at least `start`, at which a ray enters the first block that it may hit; >= `farthest` if none.

    The blocks of `Surface.ceilings` are traversed in order (Amanatides & Woo 1987).
    """
    per_metre = level.per_metre / CEILING_BLOCK
    ceiling = level.ceiling
    mask = ceiling.shape[0] - 1
    gx, gy = (ray.x + start * ray.dx) * per_metre, (ray.y + start * ray.dy) * per_metre
    j, i = math.floor(gx), math.floor(gy)
    rate_x, rate_y = ray.dx * per_metre, ray.dy * per_metre
    step_x = 1.0 / abs(rate_x) if rate_x != 0.0 else math.inf
    step_y = 1.0 / abs(rate_y) if rate_y != 0.0 else math.inf
    next_x = start + ((j + 1 - gx) if rate_x > 0.0 else (gx - j)) * step_x if rate_x != 0.0 else math.inf
    next_y = start + ((i + 1 - gy) if rate_y > 0.0 else (gy - i)) * step_y if rate_y != 0.0 else math.inf
    step_j, step_i = 1 if rate_x > 0.0 else -1, 1 if rate_y > 0.0 else -1
    t = start
    while t < farthest:
        exit_t = min(next_x, next_y)
        lowest = ray.z + (exit_t if ray.dz < 0.0 else t) * ray.dz
        if lowest <= ceiling[i & mask, j & mask]:
            break
        t = exit_t
        # selections instead of branches: the processor cannot predict through which side a ray leaves a block
        leaves_along_x = next_x < next_y
        j += step_j if leaves_along_x else 0
        i += 0 if leaves_along_x else step_i
        next_x = next_x + step_x if leaves_along_x else next_x
        next_y = next_y if leaves_along_x else next_y + step_y
    return t


@njit(cache=True)
def find_occluding_crest(level: GroundLevel, ray: Ray, near: Clearance, far: Clearance) -> Clearance:
    """Bracket a crest between two positions above the ground by tangent intersection.

    The ray approaches the ground at `near` and departs from it at `far`. The tangents of the clearance at both
    positions intersect at a lower bound of the clearance. If this bound is negative, the clearance is sampled at that
    distance and replaces one side. Returns a position where the ray is below the crest; its height is 0 if none.
    """
    field, per_metre = level.field, level.per_metre
    for _ in range(CREST_ITERATIONS):
        step = (far.rate * (far.t - near.t) - far.height + near.height) / (far.rate - near.rate)
        if near.height + near.rate * step >= 0.0:
            break
        middle: Clearance = clearance_at(field, per_metre, ray, near.t + step)
        if middle.height < 0.0:
            return middle
        if middle.rate < 0.0:
            near = middle
        else:
            far = middle
    return Clearance(far.t, 0.0, 0.0)


@njit(cache=True, inline="always")
def _cubic_crossing(above: float, rate_above: float, below: float, rate_below: float, guess: float) -> float:
    """Root, as a fraction of the interval, of the Hermite cubic through a positive and a negative value.

    Takes three steps of Newton's method from a guess; returns the guess if they diverge.
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
    """Distance of the intersection between a position above the ground and a position below it.

    Uses the root of the Hermite cubic, then false position (Illinois method), to a thousandth of the sample spacing,
    and a final step of Newton's method without a new sample.
    """
    field, per_metre = level.field, level.per_metre
    spacing = 1.0 / per_metre
    above_t, above_height, above_rate = above.t, above.height, above.rate
    below_t, below_height, below_rate = below.t, below.height, below.rate
    candidate = below
    for iteration in range(MAX_ITERATIONS):
        fraction = above_height / (above_height - below_height)
        weight = 0.5
        if iteration < CUBIC_ITERATIONS:
            fraction = _cubic_crossing(
                above_height, above_rate * (below_t - above_t), below_height, below_rate * (below_t - above_t), fraction
            )
            weight = 1.0
        candidate = clearance_at(field, per_metre, ray, above_t + (below_t - above_t) * fraction)
        if abs(candidate.height) < 1e-3 * spacing * max(-ray.dz, 1e-3) or below_t - above_t <= 0.01 * spacing:
            break
        # the Illinois method halves the height of the other end
        if candidate.height < 0.0:
            below_t, below_height, below_rate = candidate.t, candidate.height, candidate.rate
            above_height *= weight
        else:
            above_t, above_height, above_rate = candidate.t, candidate.height, candidate.rate
            below_height *= weight
    t = candidate.t - candidate.height / candidate.rate if candidate.rate < MAX_NEWTON_RATE else candidate.t
    return t if above_t < t < below_t else candidate.t


@njit(cache=True)
def intersect_ground(level: GroundLevel, ray: Ray, start: float, farthest: float) -> float:
    """Distance of a ray's first intersection with the ground between two distances; infinite if there is none.

    The step is one sample, and increases with the distance. Blocks that the ray passes above are skipped. Without
    height bounds per block, the step increases with the clearance. If the ray approaches the ground at the start of a
    step and departs from it at the end, the step is searched for a crest.
    """
    if start >= farthest:
        return math.inf
    field, per_metre = level.field, level.per_metre
    spacing = 1.0 / per_metre
    has_bounds = level.ceiling.shape[0] > 1
    t = start
    if has_bounds:
        t = skip_empty_blocks(level, ray, start, farthest)
        if t >= farthest:
            return math.inf
    previous = Clearance(t, 0.0, 0.0)
    has_skipped = True
    while True:
        current = clearance_at(field, per_metre, ray, t)
        if current.height < 0.0:
            break
        if not has_skipped and previous.rate < 0.0 and current.rate > 0.0:
            crest = find_occluding_crest(level, ray, previous, current)
            if crest.height < 0.0:
                current = crest
                break
        if t >= farthest:
            return math.inf
        previous = current
        has_skipped = False
        step = max(spacing, MIN_STEP_FRACTION * t)
        if not has_bounds:
            step = max(step, 1.5 * current.height)
        elif current.height > spacing:
            block_t = skip_empty_blocks(level, ray, t, farthest)
            if block_t >= farthest:
                return math.inf
            if block_t > t + step:
                step = block_t - t
                has_skipped = True
        t = min(t + step, farthest)
    return math.inf if current.t == previous.t else _bracketed_crossing(level, ray, previous, current)


@njit(cache=True, inline="always")
def exit_distance(extent: Extent, ray: Ray) -> float:
    """Distance at which a ray that starts inside the ground's extent leaves it."""
    exit_x = ((extent[1] if ray.dx > 0.0 else extent[0]) - ray.x) / ray.dx if ray.dx != 0.0 else math.inf
    exit_y = ((extent[3] if ray.dy > 0.0 else extent[2]) - ray.y) / ray.dy if ray.dy != 0.0 else math.inf
    return min(exit_x, exit_y)


@njit(cache=True, inline="always")
def entry_distance(extent: Extent, ray: Ray) -> float:
    """Distance at which a ray descends below the highest ground."""
    if ray.z <= extent[4]:
        return 0.0
    return (extent[4] - ray.z) / ray.dz if ray.dz < 0.0 else math.inf


@njit(cache=True)
def intersect_grazing_ray(level: GroundLevel, extent: Extent, ray: Ray, guess: float) -> float:
    """Distance of a grazing ray's first intersection with the ground; the guess if there is none near it.

    The search covers 0.8 to 1.25 times the guess, because the mesh that gives the guess does not resolve every crest.
    """
    start = max(0.8 * guess, entry_distance(extent, ray))
    farthest = min(1.25 * guess + 4.0 / level.per_metre, exit_distance(extent, ray))
    hit_t = intersect_ground(level, ray, start, farthest)
    return hit_t if hit_t < math.inf else guess


@njit(cache=True)
def height_range(field: Level) -> tuple[float, float]:
    """Minimum and maximum height of the control values, which bound the surface."""
    # interleaved heights and albedos are processed together so that the loop vectorises
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
    """Maximum height step between adjacent control values, along x and y.

    These steps are upper bounds of the surface's slopes times the spacing. Returns infinity as soon as the sum of both,
    weighted by `along_x` and `along_y`, exceeds `bound`.
    """
    side = field.shape[0]
    step_x = np.zeros(side, dtype=np.float32)
    step_y = np.zeros(side, dtype=np.float32)
    rise_x, rise_y = 0.0, 0.0
    for i in range(side):
        row, previous_row = field[i], field[i - 1]
        step_x[0] = max(step_x[0], abs(row[0, 0] - row[side - 1, 0]))
        for j in range(1, side):
            step_x[j] = max(step_x[j], abs(row[j, 0] - row[j - 1, 0]))
        for j in range(side):
            step_y[j] = max(step_y[j], abs(row[j, 0] - previous_row[j, 0]))
        if i % 64 == 63 or i == side - 1:
            rise_x = float(step_x.max())
            rise_y = float(step_y.max())
            if rise_x * along_x + rise_y * along_y > bound:
                return math.inf, math.inf
    return rise_x, rise_y
