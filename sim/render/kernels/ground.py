"""Where a ray meets the ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Extent, GroundLevel, Ray
from marsyard.sim.terrain.kernels import CEILING_BLOCK, Level, sample

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


class Clearance(NamedTuple):
    """How far a ray is above the ground at a distance along it, metres, and how fast that changes with the distance."""

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
    """Distance at which a ray enters the first block of the ground that it may not be clear of, from `start` on.

    At least `farthest` where it is clear of all on its way. The blocks are those of `Surface.ceilings`, traversed one
    by one (Amanatides & Woo 1987).
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
        # selections in place of branches: which side a ray leaves a block by cannot be predicted
        through_side = next_x < next_y
        j += right if through_side else 0
        i += 0 if through_side else up
        next_x = next_x + step_x if through_side else next_x
        next_y = next_y if through_side else next_y + step_y
    return t


@njit(cache=True)
def find_occluding_crest(level: GroundLevel, ray: Ray, near: Clearance, far: Clearance) -> Clearance:
    """Bracket a crest between two places above the ground by tangent intersection.

    The ray approaches the ground at `near` and leaves it at `far`. A crest between stands no higher than where the
    tangents of the clearance meet; while that is below the ground, the place is sampled and replaces that side.
    Returns a place below the crest; its height is 0 where there is none.
    """
    field, per_metre = level.field, level.per_metre
    for _ in range(CREST_LOOKS):
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
def _close_in(level: GroundLevel, ray: Ray, above: Clearance, below: Clearance) -> float:
    """Distance of the crossing between a place above the ground and one below it.

    The root of the cubic of clearance and rate at both ends, then false position (Illinois), to a thousandth of a
    sample; a final step of Newton's method needs no further sample.
    """
    field, per_metre = level.field, level.per_metre
    spacing = 1.0 / per_metre
    before, above_height, above_rate = above.t, above.height, above.rate
    t, below_height, below_rate = below.t, below.height, below.rate
    middle = below
    for look in range(MOST_LOOKS):
        share = above_height / (above_height - below_height)
        kept = 0.5
        if look < CUBIC_LOOKS:
            share = _down_through(
                above_height, above_rate * (t - before), below_height, below_rate * (t - before), share
            )
            kept = 1.0
        middle = clearance_at(field, per_metre, ray, before + (t - before) * share)
        if abs(middle.height) < 1e-3 * spacing * max(-ray.dz, 1e-3) or t - before <= 0.01 * spacing:
            break
        if middle.height < 0.0:
            t, below_height, below_rate = middle.t, middle.height, middle.rate
            above_height *= kept
        else:
            before, above_height, above_rate = middle.t, middle.height, middle.rate
            below_height *= kept
    polished = middle.t - middle.height / middle.rate if middle.rate < CLOSING else middle.t
    return polished if before < polished < t else middle.t


@njit(cache=True)
def cross_ground(level: GroundLevel, ray: Ray, start: float, farthest: float) -> float:
    """Distance at which a ray first dips below the ground between two distances; infinite where it does not.

    The ray is followed by steps of a sample, longer far away. Blocks of ground that it is clear of by their ceilings
    are skipped, or, where no ceilings are known (a single one), longer steps are taken high above the ground. Where it
    approaches the ground at the beginning of a step and leaves it at the end, a crest between is searched for.
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
    return math.inf if here.t == before.t else _close_in(level, ray, before, here)


@njit(cache=True, inline="always")
def way_out(extent: Extent, ray: Ray) -> float:
    """Distance along a ray to where it leaves the ground's extent, in which it begins."""
    along_x = ((extent[1] if ray.dx > 0.0 else extent[0]) - ray.x) / ray.dx if ray.dx != 0.0 else math.inf
    along_y = ((extent[3] if ray.dy > 0.0 else extent[2]) - ray.y) / ray.dy if ray.dy != 0.0 else math.inf
    return min(along_x, along_y)


@njit(cache=True, inline="always")
def way_in(extent: Extent, ray: Ray) -> float:
    """Distance along a ray from which it may meet the ground: where it comes below the highest ground."""
    if ray.z <= extent[4]:
        return 0.0
    return (extent[4] - ray.z) / ray.dz if ray.dz < 0.0 else math.inf


@njit(cache=True)
def first_ground(level: GroundLevel, extent: Extent, ray: Ray, guess: float) -> float:
    """Distance at which a flat ray first dips below the ground, from four fifths of the way to a guess to past it.

    The mesh that gives the guess does not hold every crest. The guess itself where the ray does not dip within the
    extent.
    """
    start = max(0.8 * guess, way_in(extent, ray))
    farthest = min(1.25 * guess + 4.0 / level.per_metre, way_out(extent, ray))
    met = cross_ground(level, ray, start, farthest)
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
