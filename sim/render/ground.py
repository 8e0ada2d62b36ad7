"""Intersection of rays with the ground: Newton's method from a guess, or a search along the ray and its refinement.

All distances are along the ray, in metres. A search is needed for rays that graze the ground: the mesh that gives the
guess does not resolve every crest.

The argument `level` of the functions is the terrain level on which a ray is traced: 0 is the finest level of the
pyramid of samples (`spline.Terrain`), and each further level has twice the distance between samples. Each ray has its
own level, which follows from the footprint of its pixel.
"""

from dataclasses import dataclass, replace

import drjit as dr

from marsyard.sim.render.arrays import Values, larger, smaller
from marsyard.sim.render.device import Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.rays import Ray
from marsyard.sim.render.spline import Terrain, evaluate
from marsyard.sim.terrain.kernels import CEILING_BLOCK

#: Maximum number of Newton steps, and the maximum relative change of the first guess.
MAX_STEPS, MAX_CHANGE = 8, 0.05
#: Newton's method is used only where the rate of the clearance is below this, metres per metre.
MAX_NEWTON_RATE = -1e-3
#: Minimum step of the search along a ray, relative to the distance: a quarter of a navcam pixel's footprint at 10 deg,
#: because even low crests hide the ground behind them.
MIN_STEP_FRACTION = 0.00125
#: Limits of the search for a grazing ray, relative to the guess; and samples that are added to the far limit.
GRAZING_START, GRAZING_END, GRAZING_MARGIN_SAMPLES = 0.8, 1.25, 4.0
#: Step of the search without height bounds, divided by the clearance of the ray (assumed).
CLEARANCE_STEP = 1.5
#: Logarithm to the base 2 of the samples along the side of a block of the height bounds.
_LOG2_BLOCK = CEILING_BLOCK.bit_length() - 1
#: Iterations of the search for a crest. Of 51,485 grazing rays in rover images, 4 rays miss a crest with four
#: iterations, and 25 rays with one iteration or without this search (ADR 6).
CREST_ITERATIONS = 4
#: Maximum number of iterations with the cubic (1.1 on average; false position alone takes 3.6), and in total. The
#: remaining iterations use false position, which always converges.
CUBIC_ITERATIONS, MAX_ITERATIONS = 3, 40


@dataclass(eq=False)
class Clearance:
    """Height of a ray above the ground at a distance along it, metres, and its rate of change with the distance."""

    t: Values
    height: Values
    rate: Values


@dataclass(frozen=True, eq=False)
class Extent:
    """Minimum and maximum x, then y, of the ground that is drawn, and its maximum height, metres."""

    west: Values
    east: Values
    south: Values
    north: Values
    highest: Values

    def exit_distance(self, ray: Ray) -> Values:
        """Distance at which a ray that starts inside the extent leaves it."""
        (x, y, _), (dx, dy, _) = ray.origin, ray.direction
        exit_x = dr.select(dx == 0.0, dr.inf, (dr.select(dx > 0.0, self.east, self.west) - x) / dx)
        exit_y = dr.select(dy == 0.0, dr.inf, (dr.select(dy > 0.0, self.north, self.south) - y) / dy)
        return smaller(exit_x, exit_y)

    def entry_distance(self, ray: Ray) -> Values:
        """Distance at which a ray descends below the highest ground."""
        z, dz = ray.origin.z, ray.direction.z
        descent = dr.select(dz < 0.0, (self.highest - z) / dz, dr.inf)
        return dr.select(z <= self.highest, 0.0, descent)


def clearance_at(terrain: Terrain, level: Values, ray: Ray, t: Values, active: Values) -> Clearance:
    """Compute the clearance of a ray above the ground at a distance."""
    x, y, z = ray.origin + t * ray.direction
    ground, (dx, dy, dz) = evaluate(terrain, level, x, y, active), ray.direction
    rate = Float(dz) - ground.slope_x * Float(dx) - ground.slope_y * Float(dy)
    return Clearance(t, z - ground.height, Float64(rate))


def refine(terrain: Terrain, level: Values, ray: Ray, guess: Values, max_change: float, active: Values) -> Values:
    """Intersect rays with the ground by Newton's method; infinite where it fails or departs from the guess."""
    dx, dy, _ = ray.direction
    tolerance = 2e-6 * guess * terrain.spacing_at(level)

    def take_step(t: Values, is_active: Values, steps: Values) -> tuple[Values, Values, Values]:
        clearance = clearance_at(terrain, level, ray, t, is_active)
        step = clearance.height / clearance.rate
        has_failed = (clearance.rate > MAX_NEWTON_RATE) | (dr.abs(t - step - guess) > max_change * guess)
        # after a shorter horizontal step the error is below 1e-6 of the distance: curvature is at most 1 / spacing
        is_far = step * step * (dx * dx + dy * dy) >= tolerance
        t = dr.select(has_failed, dr.inf, t - step)
        return t, is_active & is_far & ~has_failed & (steps < MAX_STEPS - 1), steps + 1

    return dr.while_loop((Float64(guess), Bool(active), UInt32(0)), lambda t, is_active, steps: is_active, take_step)[0]


def skip_empty_blocks(
    terrain: Terrain, level: Values, ray: Ray, start: Values, farthest: Values, active: Values
) -> Values:
    """Distance, at least `start`, at which a ray enters the first block that it may hit; >= `farthest` if none.

    The blocks of `Surface.ceilings` are traversed in order (Amanatides & Woo 1987).
    """
    block = terrain.spacing_at(level) * float(CEILING_BLOCK)
    log2_side = dr.gather(UInt32, terrain.log2_side, UInt32(level), active) - _LOG2_BLOCK
    first, last = dr.gather(UInt32, terrain.first_ceiling, UInt32(level), active), Int32((UInt32(1) << log2_side) - 1)
    x, y, _ = (ray.origin + start * ray.direction) / block
    rate_x, rate_y, _ = ray.direction / block
    floor_x, floor_y = dr.floor(x), dr.floor(y)
    step_x, step_y = 1.0 / dr.abs(rate_x), 1.0 / dr.abs(rate_y)
    first_x = start + dr.select(rate_x > 0.0, floor_x + 1.0 - x, x - floor_x) * step_x
    first_y = start + dr.select(rate_y > 0.0, floor_y + 1.0 - y, y - floor_y) * step_y
    next_x, next_y = dr.select(rate_x == 0.0, dr.inf, first_x), dr.select(rate_y == 0.0, dr.inf, first_y)
    step_j, step_i = dr.select(rate_x > 0.0, Int32(1), -1), dr.select(rate_y > 0.0, Int32(1), -1)

    def cross_block(
        t: Values, next_x: Values, next_y: Values, j: Values, i: Values, is_active: Values
    ) -> tuple[Values, ...]:
        exit_t = smaller(next_x, next_y)
        lowest = ray.origin.z + dr.select(ray.direction.z < 0.0, exit_t, t) * ray.direction.z
        index = first + (UInt32(i & last) << log2_side) + UInt32(j & last)
        is_empty = is_active & (lowest > Float64(dr.gather(Float, terrain.ceilings, index, is_active)))
        leaves_along_x, t = next_x < next_y, dr.select(is_empty, exit_t, t)
        return (
            t,
            dr.select(leaves_along_x, next_x + step_x, next_x),
            dr.select(leaves_along_x, next_y, next_y + step_y),
            dr.select(leaves_along_x, j + step_j, j),
            dr.select(leaves_along_x, i, i + step_i),
            is_empty & (t < farthest),
        )

    state = (Float64(start), next_x, next_y, Int32(floor_x), Int32(floor_y), active & (start < farthest))
    return dr.while_loop(state, lambda t, next_x, next_y, j, i, is_active: is_active, cross_block)[0]


def find_occluding_crest(
    terrain: Terrain, level: Values, ray: Ray, near: Clearance, far: Clearance, active: Values
) -> Clearance:
    """Bracket a crest between two positions above the ground by tangent intersection.

    The ray approaches the ground at `near` and departs from it at `far`. The tangents of the clearance at both
    positions intersect at a lower bound of the clearance. If this bound is negative, the clearance is sampled at that
    distance and replaces one side. Returns a position where the ray is below the crest; its height is 0 if none.
    """

    def narrow(
        near: Clearance, far: Clearance, crest: Clearance, is_active: Values, iteration: Values
    ) -> tuple[Clearance, Clearance, Clearance, Values, Values]:
        step = (far.rate * (far.t - near.t) - far.height + near.height) / (far.rate - near.rate)
        is_active &= near.height + near.rate * step < 0.0
        middle = clearance_at(terrain, level, ray, near.t + step, is_active)
        is_below, is_approaching = is_active & (middle.height < 0.0), middle.rate < 0.0
        crest = dr.select(is_below, middle, crest)
        near, far = dr.select(is_approaching, middle, near), dr.select(is_approaching, far, middle)
        return near, far, crest, is_active & ~is_below & (iteration < CREST_ITERATIONS - 1), iteration + 1

    state = (near, far, Clearance(far.t, Float64(0.0), Float64(0.0)), Bool(active), UInt32(0))
    return dr.while_loop(state, lambda near, far, crest, is_active, iteration: is_active, narrow)[2]


def _cubic_crossing(above: Values, rate_above: Values, below: Values, rate_below: Values, guess: Values) -> Values:
    """Root, as a fraction of the interval, of the Hermite cubic through a positive and a negative value.

    Takes three steps of Newton's method from a guess; returns the guess if they diverge.
    """
    second = 3.0 * (below - above) - 2.0 * rate_above - rate_below
    third = 2.0 * (above - below) + rate_above + rate_below
    fraction = guess
    for _ in range(3):
        value = above + fraction * (rate_above + fraction * (second + fraction * third))
        slope = rate_above + fraction * (2.0 * second + fraction * 3.0 * third)
        fraction = dr.select(slope < 0.0, fraction - value / slope, fraction)
    return dr.select((fraction > 0.0) & (fraction < 1.0), fraction, guess)


def _bracketed_crossing(
    terrain: Terrain, level: Values, ray: Ray, above: Clearance, below: Clearance, active: Values
) -> Values:
    """Distance of the intersection between a position above the ground and a position below it.

    Uses the root of the Hermite cubic, then false position (Illinois method), to a thousandth of the sample spacing,
    and a final step of Newton's method without a new sample.
    """
    spacing = terrain.spacing_at(level)
    tolerance = 1e-3 * spacing * larger(-ray.direction.z, 1e-3)

    def narrow(
        above: Clearance, below: Clearance, candidate: Clearance, is_active: Values, iteration: Values
    ) -> tuple[Clearance, Clearance, Clearance, Values, Values]:
        width, is_cubic = below.t - above.t, iteration < CUBIC_ITERATIONS
        linear = above.height / (above.height - below.height)
        cubic = _cubic_crossing(above.height, above.rate * width, below.height, below.rate * width, linear)
        fraction = dr.select(is_cubic, cubic, linear)
        candidate = clearance_at(terrain, level, ray, above.t + width * fraction, is_active)
        is_active &= (dr.abs(candidate.height) >= tolerance) & (width > 0.01 * spacing)
        # the Illinois method halves the height of the other end
        weight, is_below = dr.select(is_cubic, Float64(1.0), 0.5), candidate.height < 0.0
        weighted_above, weighted_below = (Clearance(end.t, end.height * weight, end.rate) for end in (above, below))
        above = dr.select(is_active, dr.select(is_below, weighted_above, candidate), above)
        below = dr.select(is_active, dr.select(is_below, candidate, weighted_below), below)
        return above, below, candidate, is_active & (iteration < MAX_ITERATIONS - 1), iteration + 1

    above, below, candidate, _, _ = dr.while_loop(
        (above, below, replace(below), Bool(active), UInt32(0)),
        lambda above, below, candidate, is_active, iteration: is_active,
        narrow,
    )
    t = dr.select(candidate.rate < MAX_NEWTON_RATE, candidate.t - candidate.height / candidate.rate, candidate.t)
    return dr.select((above.t < t) & (t < below.t), t, candidate.t)


def first_crossing(
    terrain: Terrain, level: Values, ray: Ray, start: Values, farthest: Values, active: Values
) -> Values:
    """Distance of a ray's first intersection with the ground between two distances; infinite if there is none.

    The step is one sample, and increases with the distance. Blocks that the ray passes above are skipped. Without
    height bounds per block, the step increases with the clearance. If the ray approaches the ground at the start of a
    step and departs from it at the end, the step is searched for a crest.
    """
    spacing = terrain.spacing_at(level)
    active = active & (start < farthest)
    if terrain.ceilings is not None:
        start = skip_empty_blocks(terrain, level, ray, start, farthest, active)
        active &= start < farthest

    def advance(
        previous: Clearance, current: Clearance, t: Values, has_skipped: Values, is_active: Values
    ) -> tuple[Clearance, Clearance, Values, Values, Values]:
        """Take a step of the search.

        - previous, current: clearances at the ends of the last step; 0 at the start of the search. A successful search
          ends with the ray above the ground at `previous` and below it at `current`.
        - t: distance of the sample that this step takes; at the end, that of the last sample
        - has_skipped: whether the step from `current` to `t` passes above whole blocks, which contain no crest
        - is_active: whether the search continues. It ends at a crossing, at `farthest`, or if the ray passes above all
          blocks before `farthest`.
        """
        new = clearance_at(terrain, level, ray, t, is_active)
        may_have_crest = is_active & (new.height >= 0.0) & ~has_skipped & (current.rate < 0.0) & (new.rate > 0.0)
        crest = find_occluding_crest(terrain, level, ray, current, new, may_have_crest)
        new = dr.select(may_have_crest & (crest.height < 0.0), crest, new)
        previous, current = current, new
        is_active &= (new.height >= 0.0) & (t < farthest)
        step = larger(spacing, MIN_STEP_FRACTION * t)
        has_skipped = Bool(False)
        if terrain.ceilings is None:
            step = larger(step, CLEARANCE_STEP * new.height)
        else:
            may_skip = is_active & (new.height > spacing)
            skip_end = skip_empty_blocks(terrain, level, ray, t, farthest, may_skip)
            is_active &= ~may_skip | (skip_end < farthest)
            has_skipped = may_skip & (skip_end > t + step)
            step = dr.select(has_skipped, skip_end - t, step)
        return previous, current, dr.select(is_active, smaller(t + step, farthest), t), has_skipped, is_active

    first = Clearance(start, Float64(0.0), Float64(0.0))
    above, below, _, _, _ = dr.while_loop(
        (first, replace(first), Float64(start), Bool(True), Bool(active)),
        lambda previous, current, t, has_skipped, is_active: is_active,
        advance,
    )
    has_crossed = active & (below.height < 0.0) & (below.t != above.t)
    return dr.select(has_crossed, _bracketed_crossing(terrain, level, ray, above, below, has_crossed), dr.inf)


def search_grazing_ray(
    terrain: Terrain, level: Values, extent: Extent, ray: Ray, guess: Values, active: Values
) -> Values:
    """Distance of a grazing ray's first intersection with the ground near a guess; infinite if there is none."""
    start = larger(GRAZING_START * guess, extent.entry_distance(ray))
    margin = GRAZING_MARGIN_SAMPLES * terrain.spacing_at(level)
    farthest = smaller(GRAZING_END * guess + margin, extent.exit_distance(ray))
    return first_crossing(terrain, level, ray, start, farthest, active)
