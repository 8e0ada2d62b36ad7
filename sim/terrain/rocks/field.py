"""The rocks of a terrain: where they lie, and their triangles around a place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64, Int32, Int64

from marsyard.sim.terrain.rocks.kernels import Placements, assemble, place_discs
from marsyard.sim.terrain.rocks.population import PlacedRock, RockParameters, draw_diameters
from marsyard.sim.terrain.rocks.shapes import (
    COARSE,
    FINEST,
    FORMS,
    SHAPES,
    SHAPES_OF_FORM,
    UNIT_HEIGHT,
    pixels_held,
    rock_shapes,
)
from marsyard.sim.terrain.substreams import substream
from marsyard.sim.terrain.surface import Surface

#: Side of the cells in which placement looks for neighbours, over the mean diameter.
CELL_OVER_DIAMETER = 3.0
#: Random places tried for a rock. Even at k = 0.4 a handful suffice.
MOST_TRIES = 20000


@dataclass(frozen=True)
class RockMesh:
    """Triangles of many rocks in world axes, as plain arrays.

    Attributes
    ----------
    vertices
        World positions, metres.
    vertex_normals
        Outward unit normals of the smooth shapes at the vertices, to be interpolated over a triangle.
    faces
        Vertex numbers of each triangle, counter-clockwise seen from outside.
    rock_of_face
        Number of the rock, in its field, that each triangle belongs to.
    body_of_face
        Which of the bodies in this mesh each triangle belongs to, counted from 0: where the mesh reaches over more than
        the terrain's period, a rock is there as often as it repeats.
    """

    vertices: Float64[np.ndarray, "vertices 3"]
    vertex_normals: Float64[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    rock_of_face: Int32[np.ndarray, "faces"]
    body_of_face: Int32[np.ndarray, "faces"]


@dataclass(frozen=True)
class RockField:
    """Rocks on a periodic terrain. Rock n is row n of every array; placed rocks come first, then the largest.

    Attributes
    ----------
    period_m
        The distance after which rocks and terrain repeat.
    shape
        Number of each rock's shape, see `marsyard.sim.terrain.rocks.shapes`.
    position_m
        World position of each rock's centre on the ground, x and y within one period.
    diameter_m
        Mean of the longest and the shortest diameter seen from above.
    height_m
        Height of the top above the ground.
    yaw_rad
        Turn about the rock's own vertical.
    up
        Unit vector of the rock's own vertical: the ground's normal.
    names
        Number of each named rock.
    """

    period_m: float
    shape: Int32[np.ndarray, "rocks"]
    position_m: Float64[np.ndarray, "rocks 3"]
    diameter_m: Float64[np.ndarray, "rocks"]
    height_m: Float64[np.ndarray, "rocks"]
    yaw_rad: Float64[np.ndarray, "rocks"]
    up: Float64[np.ndarray, "rocks 3"]
    names: Mapping[str, int]

    @classmethod
    def on(cls, surface: Surface, parameters: RockParameters, rng: np.random.Generator) -> RockField:
        """Rocks drawn from this stream, standing on this ground, none overlapping another seen along its vertical.

        Raises ValueError where a rock finds no free place, or a placed rock has no such shape.
        """
        placed = parameters.placed
        drawn = draw_diameters(parameters, surface.period_m**2, substream(rng, "rock sizes"))
        looks = substream(rng, "rock looks")
        ratio = parameters.height_ratio * (1.0 + parameters.height_spread * looks.uniform(-1.0, 1.0, drawn.size))
        first = FORMS.index(parameters.form) * SHAPES_OF_FORM
        told = _PlacedLooks.of(placed, first, substream(rng, "placed rocks"))
        diameter = np.concatenate([[rock.diameter_m for rock in placed], drawn])
        height = np.concatenate([[rock.height_m or 0.5 * rock.diameter_m for rock in placed], ratio * drawn])
        shape = np.concatenate([told.shape, first + looks.integers(0, SHAPES_OF_FORM, drawn.size)]).astype(np.int32)
        yaw = np.concatenate([told.yaw_rad, looks.uniform(-np.pi, np.pi, drawn.size)])
        radius = rock_shapes(COARSE).reach[shape] * diameter
        place = _places(parameters, radius, diameter, surface.period_m, substream(rng, "rock places"))
        return cls._standing(surface, shape, place, diameter, height, yaw, {r.name: n for n, r in enumerate(placed)})

    @classmethod
    def _standing(
        cls,
        surface: Surface,
        shape: Int32[np.ndarray, "rocks"],
        place: Float64[np.ndarray, "rocks 2"],
        diameter: Float64[np.ndarray, "rocks"],
        height: Float64[np.ndarray, "rocks"],
        yaw: Float64[np.ndarray, "rocks"],
        names: Mapping[str, int],
    ) -> RockField:
        position = np.column_stack([place, surface.height(place[:, 0], place[:, 1])])
        # the ground's slope over about the rock's own size
        level = np.clip(np.log2(np.maximum(diameter / surface.spacing_m, 1.0)).astype(int), 0, len(surface.levels) - 1)
        up = np.ones((diameter.size, 3))
        for one in np.unique(level):
            chosen = level == one
            up[chosen, :2] = -surface.gradient(place[chosen, 0], place[chosen, 1], int(one))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        for array in (shape, position, diameter, height, yaw, up):
            array.setflags(write=False)
        return cls(surface.period_m, shape, position, diameter, height, yaw, up, MappingProxyType(dict(names)))

    def __len__(self) -> int:
        return int(self.diameter_m.size)

    def by_name(self, name: str) -> int:
        """Number of the rock of this name. Raises KeyError, naming those there are."""
        if name not in self.names:
            raise KeyError(f"no rock is called '{name}'; named rocks: {', '.join(self.names) or 'none'}")
        return self.names[name]

    def near(
        self,
        x: float,
        y: float,
        radius_m: float,
        smallest_m: float = 0.0,
        *,
        above_m: float = 0.0,
        pixel_rad: float = 1e-3,
        detail: int | None = None,
    ) -> RockMesh:
        """Triangles of the rocks whose centres lie within a radius of a place.

        Parameters
        ----------
        x, y
            World position, metres, in any period: rocks are returned where they lie about it.
        radius_m
            Horizontal radius; beyond half a period a rock appears as often as it repeats.
        smallest_m
            Smallest diameter of interest.
        above_m
            Height of the eye above the ground there, for the choice of detail.
        pixel_rad
            Angle that a pixel takes.
        detail
            Level of detail of all rocks, 0 (80 triangles) to 3 (5120); by default each rock's is the coarsest that
            cannot be told from the finest (`DEVIATION_PX`).
        """
        number, offset = self._images(x, y, radius_m, smallest_m)
        position = self.position_m[number]
        position[:, :2] += offset
        if detail is None:
            distance = np.sqrt((position[:, 0] - x) ** 2 + (position[:, 1] - y) ** 2 + above_m**2)
            # as near as the eye can be to any of it
            nearest = np.maximum(distance - 0.5 * self.diameter_m[number], 0.1 * self.diameter_m[number])
            across_px = self.diameter_m[number] / (nearest * pixel_rad)
            wanted = np.sum(across_px[:, None] > pixels_held()[self.shape[number]], axis=1)
        else:
            wanted = np.full(number.size, detail)
        return self._assembled(number, position, wanted)

    def rock(self, number: int, detail: int = FINEST) -> RockMesh:
        """Triangles of one rock, within the first period."""
        numbers = np.array([number])
        return self._assembled(numbers, self.position_m[numbers], np.array([detail]))

    def _images(
        self, x: float, y: float, radius_m: float, smallest_m: float
    ) -> tuple[Int64[np.ndarray, "found"], Float64[np.ndarray, "found 2"]]:
        """Numbers of the rocks near a place, and the multiples of the period by which they are moved there."""
        large = np.flatnonzero(self.diameter_m >= smallest_m)
        period = self.period_m
        reach = int(np.ceil(radius_m / period))
        home = np.floor(np.array([x, y]) / period)
        numbers, offsets = [], []
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                offset = (home + np.array([j, i])) * period
                dx = self.position_m[large, 0] + (offset[0] - x)
                dy = self.position_m[large, 1] + (offset[1] - y)
                found = large[dx * dx + dy * dy <= radius_m * radius_m]
                numbers.append(found)
                offsets.append(np.broadcast_to(offset, (found.size, 2)))
        return np.concatenate(numbers), np.concatenate(offsets)

    def _assembled(
        self,
        number: Int64[np.ndarray, "found"],
        position: Float64[np.ndarray, "found 3"],
        detail: Int64[np.ndarray, "found"],
    ) -> RockMesh:
        order = np.argsort(detail, kind="stable")
        number, position, detail = number[order], position[order], detail[order]
        diameter = self.diameter_m[number]
        scale = np.column_stack([diameter, diameter, self.height_m[number] / UNIT_HEIGHT])
        vertices, normals = [np.empty((0, 3))], [np.empty((0, 3))]
        faces, start = [np.empty((0, 3), dtype=np.int32)], 0
        for level in np.unique(detail):
            one, shapes = detail == level, rock_shapes(int(level))
            rocks = number[one]
            placements = Placements(self.shape[rocks], position[one], scale[one], self.yaw_rad[rocks], self.up[rocks])
            placed, directions = assemble(placements, shapes.vertices, shapes.normals)
            stop = start + len(placed)
            first = np.arange(start, stop, shapes.vertices.shape[1], dtype=np.int32)
            vertices.append(placed)
            normals.append(directions)
            faces.append((shapes.faces[None] + first[:, None, None]).reshape(-1, 3))
            start = stop
        body_of_face = np.repeat(
            np.arange(number.size, dtype=np.int32), [rock_shapes(int(level)).faces.shape[0] for level in detail]
        )
        return RockMesh(
            np.concatenate(vertices),
            np.concatenate(normals),
            np.concatenate(faces),
            number.astype(np.int32)[body_of_face],
            body_of_face,
        )


@dataclass(frozen=True)
class _PlacedLooks:
    """Shape and turn of the placed rocks; where not told they are drawn, shapes from the `first` of a form on."""

    shape: list[int]
    yaw_rad: list[float]

    @classmethod
    def of(cls, placed: tuple[PlacedRock, ...], first: int, rng: np.random.Generator) -> _PlacedLooks:
        for rock in placed:
            if rock.shape is not None and rock.shape >= SHAPES:
                raise ValueError(f"rock '{rock.name}' has shape {rock.shape}; allowed: 0 to {SHAPES - 1}")
        drawn = [(first + int(rng.integers(0, SHAPES_OF_FORM)), float(rng.uniform(-np.pi, np.pi))) for _ in placed]
        return cls(
            [kind if rock.shape is None else rock.shape for rock, (kind, _) in zip(placed, drawn, strict=True)],
            [
                yaw if rock.yaw_deg is None else float(np.radians(rock.yaw_deg))
                for rock, (_, yaw) in zip(placed, drawn, strict=True)
            ],
        )


def _places(
    parameters: RockParameters,
    radius: Float64[np.ndarray, "rocks"],
    diameter: Float64[np.ndarray, "rocks"],
    period_m: float,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "rocks 2"]:
    """Where the rocks lie: the placed ones as told, the others anywhere they find room, the largest first."""
    told = np.array([(rock.east_m, rock.north_m) for rock in parameters.placed], dtype=np.float64).reshape(-1, 2)
    told %= period_m
    count = told.shape[0]
    if radius.size == count:
        return told
    taken = np.column_stack([told, radius[:count]])
    cell = max(CELL_OVER_DIAMETER * float(diameter[count:].mean()), period_m / 4096)
    found = place_discs(radius[count:], taken, period_m, cell, MOST_TRIES, rng)
    crowded = int(np.count_nonzero(np.isnan(found[:, 0])))
    if crowded:
        raise ValueError(f"{crowded} of {found.shape[0]} rocks find no free place; a smaller rocks.abundance is needed")
    return np.concatenate([told, found])
