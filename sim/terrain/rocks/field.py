"""The rocks of a terrain: positions, sizes, and their triangles around a position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64, Int32, Int64

from marsyard.sim.terrain.random_fields import substream
from marsyard.sim.terrain.rocks.kernels import Placements, assemble, place_discs
from marsyard.sim.terrain.rocks.population import PlacedRock, RockParameters, draw_diameters
from marsyard.sim.terrain.rocks.shapes import (
    COARSE,
    FINEST,
    FORMS,
    SHAPES,
    SHAPES_OF_FORM,
    UNIT_HEIGHT,
    max_pixels,
    rock_shapes,
)
from marsyard.sim.terrain.surface import Surface

#: Side of the cells in which placement searches for neighbours, over the mean diameter.
CELL_OVER_DIAMETER = 3.0
#: Random positions tried for a rock; even at k = 0.4 a handful suffices.
MAX_TRIES = 20000


@dataclass(frozen=True)
class RockMesh:
    """Triangles of many rocks in world axes.

    - vertices: world positions, metres
    - vertex_normals: outward unit normals of the smooth shapes, to be interpolated over a triangle
    - faces: vertex numbers of each triangle, counter-clockwise seen from outside
    - rock_of_face: number of each triangle's rock in its field
    - body_of_face: number of each triangle's body in this mesh, from 0: where the mesh is wider than the terrain's
      period, a rock appears as often as it repeats
    """

    vertices: Float64[np.ndarray, "vertices 3"]
    vertex_normals: Float64[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    rock_of_face: Int32[np.ndarray, "faces"]
    body_of_face: Int32[np.ndarray, "faces"]


@dataclass(frozen=True)
class RockField:
    """Rocks on a periodic terrain. Rock n is row n of every array; placed rocks come first, then the largest.

    - shape: number of each rock's shape, see `marsyard.sim.terrain.rocks.shapes`
    - position_m: world position of each rock's centre on the ground, x and y within one period
    - diameter_m: mean of the longest and the shortest diameter seen from above
    - height_m: height of the top above the ground
    - yaw_rad: rotation about the rock's own vertical
    - up: unit vector of the rock's own vertical: the ground's normal
    - names: number of each named rock
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
        """Draw rocks on this ground that do not overlap, seen along their verticals.

        Raises ValueError where a rock finds no free position, or a placed rock has no such shape.
        """
        placed = parameters.placed
        drawn = draw_diameters(parameters, surface.period_m**2, substream(rng, "rock sizes"))
        looks = substream(rng, "rock looks")
        ratio = parameters.height_ratio * (1.0 + parameters.height_spread * looks.uniform(-1.0, 1.0, drawn.size))
        first = FORMS.index(parameters.form) * SHAPES_OF_FORM
        placed_shape, placed_yaw = _placed_shapes(placed, first, substream(rng, "placed rocks"))
        diameter = np.concatenate([[rock.diameter_m for rock in placed], drawn])
        height = np.concatenate([[rock.height_m or 0.5 * rock.diameter_m for rock in placed], ratio * drawn])
        shape = np.concatenate([placed_shape, first + looks.integers(0, SHAPES_OF_FORM, drawn.size)]).astype(np.int32)
        yaw = np.concatenate([placed_yaw, looks.uniform(-np.pi, np.pi, drawn.size)])
        radius = rock_shapes(COARSE).reach[shape] * diameter
        xy = _positions(parameters, radius, diameter, surface.period_m, substream(rng, "rock places"))
        position = np.column_stack([xy, surface.height(xy[:, 0], xy[:, 1])])
        # the ground's slope over about the rock's own size
        level = np.clip(np.log2(np.maximum(diameter / surface.spacing_m, 1.0)).astype(int), 0, len(surface.levels) - 1)
        up = np.ones((diameter.size, 3))
        for one in np.unique(level):
            rows = level == one
            up[rows, :2] = -surface.gradient(xy[rows, 0], xy[rows, 1], int(one))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        for array in (shape, position, diameter, height, yaw, up):
            array.setflags(write=False)
        names = MappingProxyType({rock.name: number for number, rock in enumerate(placed)})
        return cls(surface.period_m, shape, position, diameter, height, yaw, up, names)

    def __len__(self) -> int:
        return int(self.diameter_m.size)

    def by_name(self, name: str) -> int:
        """Return the number of a named rock. Raises KeyError, naming the existing ones."""
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
        """Return the triangles of the rocks whose centres lie within a horizontal radius of a position.

        - x, y: world position in any period; beyond half a period a rock appears as often as it repeats
        - smallest_m: smallest diameter of interest
        - above_m, pixel_rad: height of the eye above the ground there, and angle that a pixel subtends
        - detail: level of detail of all rocks, 0 (80 triangles) to 3 (5120); by default each rock's is the coarsest
          that looks like the finest (`DEVIATION_PX`)
        """
        number, offset = self._images(x, y, radius_m, smallest_m)
        position = self.position_m[number]
        position[:, :2] += offset
        if detail is None:
            distance = np.sqrt((position[:, 0] - x) ** 2 + (position[:, 1] - y) ** 2 + above_m**2)
            # the shortest possible distance from the eye to any of its surface
            nearest = np.maximum(distance - 0.5 * self.diameter_m[number], 0.1 * self.diameter_m[number])
            across_px = self.diameter_m[number] / (nearest * pixel_rad)
            details = np.sum(across_px[:, None] > max_pixels()[self.shape[number]], axis=1)
        else:
            details = np.full(number.size, detail)
        return self._assemble(number, position, details)

    def rock(self, number: int, detail: int = FINEST) -> RockMesh:
        """Return the triangles of one rock, within the first period."""
        numbers = np.array([number])
        return self._assemble(numbers, self.position_m[numbers], np.array([detail]))

    def _images(
        self, x: float, y: float, radius_m: float, smallest_m: float
    ) -> tuple[Int64[np.ndarray, "found"], Float64[np.ndarray, "found 2"]]:
        """Numbers of the rocks near a position, and the multiples of the period by which they are moved there."""
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

    def _assemble(
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
        faces, counts, start = [np.empty((0, 3), dtype=np.int32)], [np.empty(0, dtype=np.int64)], 0
        for level in np.unique(detail):
            one, shapes = detail == level, rock_shapes(int(level))
            rocks = number[one]
            placements = Placements(self.shape[rocks], position[one], scale[one], self.yaw_rad[rocks], self.up[rocks])
            level_vertices, level_normals = assemble(placements, shapes.vertices, shapes.normals)
            stop = start + len(level_vertices)
            first = np.arange(start, stop, shapes.vertices.shape[1], dtype=np.int32)
            vertices.append(level_vertices)
            normals.append(level_normals)
            faces.append((shapes.faces[None] + first[:, None, None]).reshape(-1, 3))
            counts.append(np.full(rocks.size, len(shapes.faces)))
            start = stop
        body_of_face = np.repeat(np.arange(number.size, dtype=np.int32), np.concatenate(counts))
        rock_of_face = number.astype(np.int32)[body_of_face]
        return RockMesh(
            np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces), rock_of_face, body_of_face
        )


def _placed_shapes(
    placed: tuple[PlacedRock, ...], first: int, rng: np.random.Generator
) -> tuple[list[int], list[float]]:
    """Shapes and yaws of the placed rocks: drawn where not stated, shapes from the form's `first` on."""
    shapes, yaws = [], []
    for rock in placed:
        if rock.shape is not None and rock.shape >= SHAPES:
            raise ValueError(f"rock '{rock.name}' has shape {rock.shape}; allowed: 0 to {SHAPES - 1}")
        shape, yaw = first + int(rng.integers(0, SHAPES_OF_FORM)), float(rng.uniform(-np.pi, np.pi))
        shapes.append(shape if rock.shape is None else rock.shape)
        yaws.append(yaw if rock.yaw_deg is None else float(np.radians(rock.yaw_deg)))
    return shapes, yaws


def _positions(
    parameters: RockParameters,
    radius: Float64[np.ndarray, "rocks"],
    diameter: Float64[np.ndarray, "rocks"],
    period_m: float,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "rocks 2"]:
    """Positions of the placed rocks as stated, and of the others where they do not overlap, the largest first."""
    placed = np.array([(rock.east_m, rock.north_m) for rock in parameters.placed], dtype=np.float64).reshape(-1, 2)
    placed %= period_m
    count = placed.shape[0]
    if radius.size == count:
        return placed
    occupied = np.column_stack([placed, radius[:count]])
    cell = max(CELL_OVER_DIAMETER * float(diameter[count:].mean()), period_m / 4096)
    drawn = place_discs(radius[count:], occupied, period_m, cell, MAX_TRIES, rng)
    crowded = int(np.count_nonzero(np.isnan(drawn[:, 0])))
    if crowded:
        raise ValueError(f"{crowded} of {drawn.shape[0]} rocks find no free place; a smaller rocks.abundance is needed")
    return np.concatenate([placed, drawn])
