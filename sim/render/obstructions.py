"""Bodies that hide a part of the sky and of the sun's aureole: rocks, as half spheroids, and the body of a rover.

Their vector ``B = 1 / pi int w d(solid angle)`` over the directions w that they cover is known in closed form for a
mound and for a convex body. A surface with the unit normal n loses ``n . B`` of the irradiance (divided by pi) of a
uniform sky. The aureole is a uniform disc around the sun.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray

from marsyard.sim.render.arrays import Values, clip, larger, smaller, to_device, vectors_to_device, where
from marsyard.sim.render.casters import Grids, list_in_grids
from marsyard.sim.render.device import Array2f, Array2f64, Array3f, Array3f64, Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.sky import AUREOLE_RADIUS_RAD, disc_above, disc_overlap

#: Distance from a mound's axis, in radii, beyond which it hides no sky (below 0.5 % of it).
MOUND_RANGE = 4.0
#: Distance from the centre of a shelter, in half diagonals, beyond which it hides no sky (below 1 % of it).
SHELTER_RANGE = 4.0
#: Parts of the hemisphere's vector, and of the aureole, in which those of a mound are counted.
_PARTS = float(2**22)
#: Average number of mounds in a cell of their grid, and maximum number of cells along a side.
_MOUNDS_PER_CELL, _MAX_CELLS = 1.0, 512
#: Faces of a shelter, three corners of each, counter-clockwise seen from outside: bottom with the corners 0 to 3, top
#: with the corner i + 4 above corner i, and the sides i from corner i to corner i + 1.
_FACES = ((0, 3, 2), (4, 5, 6), (0, 1, 5), (1, 2, 6), (2, 3, 7), (3, 0, 4))
_BOTTOM, _TOP, _FIRST_SIDE = 0, 1, 2


@dataclass(eq=False)
class Hidden:
    """What bodies hide from each point: vector of the sky (see above), and fraction of the aureole."""

    sky: Values
    aureole: Values


@dataclass(frozen=True, eq=False)
class Mounds:
    """Bodies on the ground, as half spheroids, in a grid: centre, and radius and height of the top, metres.

    `sun` is the unit vector towards the sun.
    """

    sun: Values
    grid: Grids
    centre: Values
    radius: Values
    top: Values

    @classmethod
    def of(cls, mounds: FloatArray[np.ndarray, "mounds 4"], sun: FloatArray[np.ndarray, "3"]) -> Mounds | None:
        """List mounds, with x, y of the centre, radius and z of the top, in a grid; None without mounds."""
        if len(mounds) == 0:
            return None
        centre, radius, top = mounds[:, :2], mounds[:, 2], mounds[:, 3]
        reach = MOUND_RANGE * radius[:, None]
        bounds = np.zeros((1, 6))
        bounds[0, :2], bounds[0, 3:5] = (centre - reach).min(axis=0), (centre + reach).max(axis=0)
        side = np.clip(np.ceil(np.sqrt([len(mounds) / _MOUNDS_PER_CELL])), 1, _MAX_CELLS).astype(np.int64)
        first, last = (vectors_to_device(Array2f64, centre + sign * reach) for sign in (-1, 1))
        numbers = dr.arange(UInt32, len(mounds))
        grid = list_in_grids(first, last, dr.zeros(UInt32, len(mounds)), bounds, side, numbers)
        centres = vectors_to_device(Array2f64, centre)
        return cls(Array3f(*sun.tolist()), grid, centres, to_device(Float, radius), to_device(Float64, top))

    def hide_light(self, position: Values, active: Values) -> Hidden:
        """Compute the light that mounds hide from positions on the ground.

        A half sphere of the angular radius t on the horizon covers half a cap. Its vector has the horizontal component
        ``sin(t)**2 / 2``, and the vertical component ``(t - sin(t) cos(t)) / pi``: the area of its projection on the
        ground. Both are scaled by the ratio of height to radius. The aureole is hidden where the disc of the half
        sphere overlaps it, after the same scaling of heights. The sum of integers does not depend on the order of the
        mounds, which is not fixed.
        """
        first, end = self.grid.list_range(
            UInt32(0), *self.grid.locate(UInt32(0), position.x, position.y, active), active
        )

        def add_mound(
            k: Values, east: Values, north: Values, up: Values, aureole: Values, is_active: Values
        ) -> tuple[Values, ...]:
            number = dr.gather(UInt32, self.grid.items, k, is_active)
            offset = Array2f(dr.gather(Array2f64, self.centre, number, is_active) - position.xy)
            radius = dr.gather(Float, self.radius, number, is_active)
            top = Float(dr.gather(Float64, self.top, number, is_active) - position.z)
            distance = larger(dr.norm(offset), 1e-6)
            height, sine = clip(top / larger(radius, 1e-6), 0.0, 1.0), smaller(radius / distance, 1.0)
            sine = dr.select(distance < MOUND_RANGE * radius, sine, 0.0)
            height = dr.select(is_active, height * _PARTS, 0.0)
            sideways = 0.5 * height * sine * sine / distance
            east, north = east + Int32(sideways * offset.x), north + Int32(sideways * offset.y)
            angle = dr.asin(sine)
            up += Int32(height * (angle - sine * dr.sqrt(1.0 - sine * sine)) / dr.pi)
            # for a half sphere the sun is nearer to the horizon than for one of lower height
            scaled_up = self.sun.z * _PARTS / larger(height, 1.0)
            horizontal = self.sun.xy
            scaled_norm = dr.sqrt(dr.squared_norm(horizontal) + scaled_up * scaled_up)
            cosine = dr.dot(offset, horizontal) / (distance * scaled_norm)
            overlap = disc_overlap(larger(angle, 1e-3), Float(AUREOLE_RADIUS_RAD), dr.acos(clip(cosine, -1.0, 1.0)))
            aureole += Int32(dr.select((height > 0.0) & (angle > 0.0), _PARTS * overlap, 0.0))
            return k + 1, east, north, up, aureole, is_active & (k + 1 < end)

        state = (UInt32(first), Int32(0), Int32(0), Int32(0), Int32(0), active & (first < end))
        _, *parts, _ = dr.while_loop(state, lambda k, east, north, up, aureole, is_active: is_active, add_mound)
        east, north, up, aureole = (Float(part) / _PARTS for part in parts)
        return Hidden(Array3f(east, north, up), smaller(aureole, 1.0))


@dataclass(frozen=True, eq=False)
class Shelter:
    """A convex body with eight corners above the ground, such as a rover's body: its corners, centre and range.

    `sun` is the unit vector towards the sun.
    """

    sun: Values
    corners: Values
    centre: Values
    reach: Values

    @classmethod
    def of(cls, corners: FloatArray[np.ndarray, "8 3"], sun: FloatArray[np.ndarray, "3"]) -> Shelter:
        """Copy a shelter to the device: corners of the bottom, counter-clockwise from above, then those of the top.

        `sun` is the unit vector towards the sun.
        """
        centre = corners.mean(axis=0)
        reach = SHELTER_RANGE * float(np.linalg.norm(corners - centre, axis=1).max())
        towards_sun = Array3f(*sun.tolist())
        return cls(towards_sun, vectors_to_device(Array3f64, corners), Array3f64(*centre.tolist()), Float(reach))

    def hide_light(self, position: Values, active: Values) -> Hidden:
        """Compute the light that the body hides from positions outside it; none for positions inside.

        The vector of a polygon is the sum over its edges of half the angle of the edge times the unit vector
        perpendicular to the edge and the position (Lambert 1760). The visible faces of a convex body do not overlap;
        their common edges cancel. The rest is the outline; its edges are straight lines across the aureole, each of
        which hides as if it was alone.
        """
        is_near = active & (dr.norm(Array3f(self.centre - position)) < self.reach)
        return where(is_near, lambda: self._trace_outline(position), Hidden(Array3f(0.0), Float(0.0)))

    def _trace_outline(self, position: Values) -> Hidden:
        """Sum the vectors of the outline's edges, and multiply the fractions of the aureole inside of each edge."""
        offsets = [Array3f(dr.gather(Array3f64, self.corners, UInt32(k)) - position) for k in range(8)]
        faces = [
            dr.select(dr.dot(offsets[a], dr.cross(offsets[b] - offsets[a], offsets[c] - offsets[a])) < 0.0, 1.0, 0.0)
            for a, b, c in _FACES
        ]
        units = [dr.normalize(offset) for offset in offsets]
        sides, to_centre = faces[_FIRST_SIDE:], Array3f(self.centre - position)
        sky, aureole, is_outside = Array3f(0.0), Float(1.0), Bool(False)
        for i in range(4):
            for first, second, weight in (
                (i, (i + 1) % 4, sides[i] - faces[_BOTTOM]),
                (4 + i, 4 + (i + 1) % 4, faces[_TOP] - sides[i]),
                (i, 4 + i, sides[i - 1] - sides[i]),
            ):
                cosine = clip(dr.dot(units[first], units[second]), -0.999999, 0.999999)
                length, across = weight * dr.acos(cosine), dr.cross(units[first], units[second])
                across /= dr.sqrt(1.0 - cosine * cosine)
                sky -= length * across
                # the body is on that side of an edge where its centre is
                inwards = dr.select(dr.dot(across, to_centre) < 0.0, -1.0, 1.0)
                angle = dr.asin(clip(inwards * dr.dot(across, self.sun), -1.0, 1.0))
                aureole *= dr.select(weight == 0.0, 1.0, disc_above(angle / AUREOLE_RADIUS_RAD))
                is_outside |= weight != 0.0
        return Hidden(sky / (2.0 * dr.pi), dr.select(is_outside, aureole, 0.0))


@dataclass(frozen=True, eq=False)
class Obstructions:
    """Bodies that hide a part of the sky; None where there are none."""

    mounds: Mounds | None
    shelter: Shelter | None

    def hide_light(self, position: Values, is_ground: Values, is_object: Values) -> Hidden:
        """Compute the hidden light: mounds hide it from the ground only, a shelter from all surfaces."""
        sky, aureole = Array3f(0.0), Float(0.0)
        if self.mounds is not None:
            hidden = self.mounds.hide_light(position, is_ground)
            sky, aureole = sky + hidden.sky, aureole + hidden.aureole
        if self.shelter is not None:
            hidden = self.shelter.hide_light(position, is_ground | is_object)
            sky, aureole = sky + hidden.sky, aureole + hidden.aureole
        return Hidden(sky, smaller(aureole, 1.0))
