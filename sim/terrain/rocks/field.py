"""Rocks of a terrain: parameters, size-frequency distribution, positions, and triangles near a position."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64, Int32, Int64
from numpy.random import Generator
from pydantic import Field, model_validator

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive
from marsyard.sim.streams import substream
from marsyard.sim.terrain.rocks import shapes
from marsyard.sim.terrain.rocks.kernels import Placements, assemble, place_discs
from marsyard.sim.terrain.rocks.shapes import FINEST, SHAPES_OF_FORM, max_pixels, rock_shapes
from marsyard.sim.terrain.rocks.tails import WindTails
from marsyard.sim.terrain.surface import ROCKS, Surface

MAX_ROCKS = 2_000_000  #: Maximum number of rocks on one terrain.
CELL_OVER_DIAMETER = 3.0  #: Side of the cells of the neighbour search, divided by the mean diameter.
MAX_TRIES = 20000  #: Maximum number of random positions that are tried for a rock.
_INTERVALS = 2000  #: Intervals of the diameter over which the number of rocks is integrated.
#: Arrays of a `RockField` with one row per rock.
ROCK_ARRAYS = ("shape", "position_m", "diameter_m", "height_m", "yaw_rad", "up", "albedo")
Positions = Float64[np.ndarray, "selected 3"]
PerRock = Float64[np.ndarray, "rocks"]
Numbers = Int64[np.ndarray, "selected"]
Form = Literal["block", "clinker", "vesicular", "slab", "ventifact"]


class PlacedRock(Parameters):
    """A rock at a given position, such as a rover's target or a landing hazard."""

    name: Annotated[str, Field(min_length=1, description="name in scenarios; unique on its terrain")]
    east_m: Annotated[float, Field(description="x of its centre, m, on the periodic terrain")]
    north_m: Annotated[float, Field(description="y of its centre, m, on the periodic terrain")]
    diameter_m: Annotated[float, Field(gt=0.0, le=50.0, description="mean of longest and shortest diameter, m")]
    height_m: Annotated[Positive | None, Field(description="above the ground, m; default: half the diameter")] = None
    shape: Annotated[int | None, Field(ge=0, description="0-15 blocks, then 16 of each further form")] = None
    yaw_deg: Annotated[float | None, Field(description="rotation about the vertical, deg; random if omitted")] = None


class RockForms(Parameters):
    """Relative numbers of rocks of each form."""

    block: NonNegative = 0.0
    clinker: NonNegative = 0.0
    vesicular: NonNegative = 0.0
    slab: NonNegative = 0.0
    ventifact: NonNegative = 0.0

    @model_validator(mode="after")
    def _check_sum(self) -> RockForms:
        if sum(self.weights()) == 0.0:
            raise ValueError("all forms have the number 0; at least one must be greater than 0")
        return self

    def weights(self) -> tuple[float, ...]:
        """Return the numbers in the order of `marsyard.sim.terrain.rocks.shapes.FORMS`."""
        return self.block, self.clinker, self.vesicular, self.slab, self.ventifact


class RockParameters(Parameters):
    """Rocks of a terrain: the size-frequency distribution of Golombek & Rapp (1997), and rocks at given positions.

    The fraction of the ground that is covered by rocks with a diameter of at least D is ``F_k(D) = k exp(-q D)``,
    ``q = 1.79 + 0.152 / k`` (D in metres), fitted to the Viking landing sites.
    The number of rocks per area and diameter follows: ``n(D) = -dF/dD / (pi D**2 / 4)``.
    """

    abundance: Annotated[float, Field(ge=0.0, le=0.4, description="fraction of the ground covered by rocks, k")] = 0.05
    smallest_m: Annotated[Positive, Field(description="minimum diameter of rocks, m")] = 0.05
    largest_m: Annotated[Positive, Field(description="maximum diameter of rocks, m")] = 3.0
    height_ratio: Annotated[float, Field(gt=0.0, le=1.0, description="mean height/diameter (Golombek & Rapp)")] = 0.5
    height_spread: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="half width of the uniform distribution of height/diameter, relative to its mean",
        ),
    ] = 0.3
    form: Annotated[Form, Field(description="form of all rocks, if `forms` is omitted")] = "block"
    forms: Annotated[RockForms | None, Field(description="relative numbers of several forms")] = None
    albedo_spread: Annotated[NonNegative, Field(description="standard deviation of the logarithm of rocks' albedo")] = (
        0.0
    )
    fragments: Annotated[Fraction, Field(description="fraction of the rocks that lies next to a larger one")] = 0.0
    placed: Annotated[tuple[PlacedRock, ...], Field(description="rocks at given positions")] = ()
    tails: Annotated[WindTails | None, Field(description="wind tails of rocks")] = None

    @model_validator(mode="after")
    def _check_consistency(self) -> RockParameters:
        if self.largest_m <= self.smallest_m:
            raise ValueError(f"largest_m is {self.largest_m:g}; it must be larger than smallest_m, {self.smallest_m:g}")
        duplicates = sorted(name for name, count in Counter(rock.name for rock in self.placed).items() if count > 1)
        if duplicates:
            raise ValueError(f"more than one placed rock is called {', '.join(duplicates)}; names must be unique")
        return self


def decay_per_m(abundance: float) -> float:
    """Compute q(k) of Golombek & Rapp (1997), 1/m."""
    return 1.79 + 0.152 / abundance


def draw_diameters(parameters: RockParameters, area_m2: float, rng: Generator) -> Float64[np.ndarray, "n"]:
    """Draw the diameters of the rocks on an area, metres, in decreasing order; their number has a Poisson distribution.

    Raises ValueError if the expected number exceeds `MAX_ROCKS`.
    """
    p, q = parameters, decay_per_m(parameters.abundance or 1.0)

    def density_per_log(d: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        # D n(D): number of rocks per area and natural logarithm of diameter
        return np.asarray(p.abundance * q * np.exp(-q * d) / (np.pi * d / 4.0))

    # cumulative number of rocks per square metre up to each diameter, by Simpson's rule in the logarithm of diameter
    diameter = np.geomspace(p.smallest_m, p.largest_m, _INTERVALS + 1)
    step = np.log(p.largest_m / p.smallest_m) / _INTERVALS
    middle = np.sqrt(diameter[1:] * diameter[:-1])
    interval_counts = (
        step / 6.0 * (density_per_log(diameter[:-1]) + 4.0 * density_per_log(middle) + density_per_log(diameter[1:]))
    )
    cumulative_count = np.concatenate([[0.0], np.cumsum(interval_counts)])
    expected = cumulative_count[-1] * area_m2
    if expected > MAX_ROCKS:
        raise ValueError(
            f"{expected:.3g} rocks of at least {p.smallest_m:g} m on {area_m2:.3g} m2; at most "
            f"{MAX_ROCKS:g} are allowed: choose a larger rocks.smallest_m"
        )
    quantile = rng.random(int(rng.poisson(expected)))
    diameters = np.exp(np.interp(quantile * cumulative_count[-1], cumulative_count, np.log(diameter)))
    return np.asarray(np.sort(diameters)[::-1])


@dataclass(frozen=True)
class RockMesh:
    """Triangles of many rocks in world axes.

    - vertices: world positions, metres
    - vertex_normals: outward unit normals of the smooth shapes, to be interpolated over a triangle
    - faces: vertex numbers of each triangle, counter-clockwise seen from outside
    - rock_of_face: number of each triangle's rock in its field
    - body_of_face: number of each triangle's body in this mesh, from 0. If the mesh is wider than the period of the
      terrain, each copy of a rock is a separate body
    """

    vertices: Float64[np.ndarray, "vertices 3"]
    vertex_normals: Float64[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    rock_of_face: Int32[np.ndarray, "faces"]
    body_of_face: Int32[np.ndarray, "faces"]


@dataclass(frozen=True)
class RockField:
    """Rocks on a periodic terrain. Rock n is row n of each array: placed rocks first, then rocks by decreasing size.

    - shape: shape number of each rock, see `marsyard.sim.terrain.rocks.shapes`
    - position_m: world position of each rock's centre on the ground, x and y within one period
    - diameter_m: mean of the longest and the shortest horizontal diameter
    - height_m: height of the top above the ground
    - yaw_rad: rotation about the rock's own vertical
    - up: unit vector of the rock's own vertical: the ground's normal
    - albedo: albedo of each rock divided by the site's rock albedo
    - names: number of each named rock
    """

    period_m: float
    shape: Int32[np.ndarray, "rocks"]
    position_m: Float64[np.ndarray, "rocks 3"]
    diameter_m: PerRock
    height_m: PerRock
    yaw_rad: PerRock
    up: Float64[np.ndarray, "rocks 3"]
    albedo: PerRock
    names: Mapping[str, int]

    @classmethod
    def draw(cls, surface: Surface, parameters: RockParameters, rng: Generator) -> RockField:
        """Draw rocks that do not overlap on a surface, with the relative density of the surface (`Surface.factors`).

        Raises ValueError if there is no free position for a rock, or if the shape of a placed rock does not exist.
        """
        placed = parameters.placed
        random_diameter = draw_diameters(parameters, surface.period_m**2, substream(rng, "rock sizes"))
        appearance_rng = substream(rng, "rock looks")
        ratio = parameters.height_ratio * (
            1.0 + parameters.height_spread * appearance_rng.uniform(-1.0, 1.0, random_diameter.size)
        )
        first_shape = list(shapes.FORMS).index(parameters.form) * SHAPES_OF_FORM
        placed_shape, placed_yaw, placed_rng = [], [], substream(rng, "placed rocks")
        for rock in placed:
            if rock.shape is not None and rock.shape >= shapes.SHAPES:
                allowed = f"0 to {shapes.SHAPES - 1}"
                raise ValueError(f"rock '{rock.name}' has shape {rock.shape}; allowed: {allowed}")
            default_shape = first_shape + int(placed_rng.integers(0, SHAPES_OF_FORM))
            default_yaw_rad = float(placed_rng.uniform(-np.pi, np.pi))
            placed_shape.append(default_shape if rock.shape is None else rock.shape)
            placed_yaw.append(default_yaw_rad if rock.yaw_deg is None else float(np.radians(rock.yaw_deg)))
        diameter = np.concatenate([[rock.diameter_m for rock in placed], random_diameter])
        random_shape = first_shape + appearance_rng.integers(0, SHAPES_OF_FORM, random_diameter.size)
        if parameters.forms is not None:
            weights = np.array(parameters.forms.weights())
            form = substream(rng, "rock forms").choice(weights.size, random_diameter.size, p=weights / weights.sum())
            random_shape = form * SHAPES_OF_FORM + random_shape % SHAPES_OF_FORM
            ratio *= np.array([definition.flatness for definition in shapes.FORMS.values()])[form]
        height = np.concatenate([[rock.height_m or 0.5 * rock.diameter_m for rock in placed], ratio * random_diameter])
        log_albedo = parameters.albedo_spread * substream(rng, "rock albedo").standard_normal(random_diameter.size)
        albedo = np.concatenate([np.ones(len(placed)), np.exp(log_albedo - 0.5 * parameters.albedo_spread**2)])
        shape = np.concatenate([placed_shape, random_shape]).astype(np.int32)
        yaw = np.concatenate([placed_yaw, appearance_rng.uniform(-np.pi, np.pi, random_diameter.size)])
        radius = rock_shapes(shapes.COARSEST).max_radius[shape] * diameter
        xy = _draw_positions(parameters, radius, diameter, surface, substream(rng, "rock places"))
        ground_m, slope_x, slope_y, _ = surface.evaluate(xy[:, 0], xy[:, 1]).T
        position = np.column_stack([xy, ground_m])
        # normal of the ground, averaged over about the size of the rock
        level = np.clip(np.log2(np.maximum(diameter / surface.spacing_m, 1.0)).astype(int), 0, len(surface.levels) - 1)
        up = np.ones((diameter.size, 3))
        up[:, :2] = -np.column_stack([slope_x, slope_y])
        for number in np.unique(level[level > 0]):
            has_level = level == number
            up[has_level, :2] = -surface.gradient(xy[has_level, 0], xy[has_level, 1], int(number))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        for array in (shape, position, diameter, height, yaw, up, albedo):
            array.setflags(write=False)
        names = MappingProxyType({rock.name: number for number, rock in enumerate(placed)})
        return cls(surface.period_m, shape, position, diameter, height, yaw, up, albedo, names)

    def __len__(self) -> int:
        return int(self.diameter_m.size)

    def by_name(self, name: str) -> int:
        """Return the number of a named rock. Raises KeyError with the existing names."""
        if name not in self.names:
            raise KeyError(f"no rock is called '{name}'; named rocks: {', '.join(self.names) or 'none'}")
        return self.names[name]

    def near(
        self,
        x: float,
        y: float,
        radius_m: float | PerRock,
        smallest_m: float = 0.0,
        *,
        above_m: float = 0.0,
        pixel_rad: float = 1e-3,
        detail: int | None = None,
    ) -> RockMesh:
        """Return the triangles of the rocks whose centres lie within a horizontal radius of a position.

        - x, y: world position in any period; within more than half a period a rock can occur several times
        - radius_m: one radius, or one per rock
        - smallest_m: minimum diameter
        - above_m, pixel_rad: height of the camera above the ground at this position, and angle of a pixel
        - detail: level of detail of all rocks, 0 (20 triangles) to 4 (5120); by default the coarsest level of each rock
          whose deviation from the finest is not visible (`DEVIATION_PX`)
        """
        large = np.flatnonzero(self.diameter_m >= smallest_m)
        radii = np.broadcast_to(radius_m, self.diameter_m.shape)[large]
        numbers, positions = [large[:0]], [self.position_m[:0]]
        for offset in find_periods(x, y, float(radii.max(initial=0.0)), self.period_m):
            dx = self.position_m[large, 0] + (offset[0] - x)
            dy = self.position_m[large, 1] + (offset[1] - y)
            numbers.append(large[dx * dx + dy * dy <= radii * radii])
            positions.append(self.position_m[numbers[-1]] + np.append(offset, 0.0))
        number, position = np.concatenate(numbers), np.concatenate(positions)
        if detail is None:
            distance = np.sqrt((position[:, 0] - x) ** 2 + (position[:, 1] - y) ** 2 + above_m**2)
            # minimum distance from the camera to the surface of the rock
            nearest = np.maximum(distance - 0.5 * self.diameter_m[number], 0.1 * self.diameter_m[number])
            size_px = self.diameter_m[number] / (nearest * pixel_rad)
            details = np.sum(size_px[:, None] > max_pixels()[self.shape[number]], axis=1)
        else:
            details = np.full(number.size, detail)
        return self._assemble(number, position, details)

    def rock(self, number: int, detail: int = FINEST) -> RockMesh:
        """Return the triangles of one rock in the first period."""
        numbers = np.array([number])
        return self._assemble(numbers, self.position_m[numbers], np.array([detail]))

    def _assemble(self, number: Numbers, position: Positions, detail: Numbers) -> RockMesh:
        """Create the mesh of rocks at positions, ordered by level of detail."""
        order = np.argsort(detail, kind="stable")
        number, position, detail = number[order], position[order], detail[order]
        diameter = self.diameter_m[number]
        scale = np.column_stack([diameter, diameter, self.height_m[number] / shapes.UNIT_HEIGHT])
        vertices, normals = [np.empty((0, 3))], [np.empty((0, 3))]
        faces, counts, start = [np.empty((0, 3), dtype=np.int32)], [np.empty(0, dtype=np.int64)], 0
        for level in np.unique(detail):
            selected, unit = detail == level, rock_shapes(int(level))
            rocks = number[selected]
            placements = Placements(
                self.shape[rocks], position[selected], scale[selected], self.yaw_rad[rocks], self.up[rocks]
            )
            level_vertices, level_normals = assemble(placements, unit.vertices, unit.normals)
            stop = start + len(level_vertices)
            first_vertex = np.arange(start, stop, unit.vertices.shape[1], dtype=np.int32)
            vertices.append(level_vertices)
            normals.append(level_normals)
            faces.append((unit.faces[None] + first_vertex[:, None, None]).reshape(-1, 3))
            counts.append(np.full(rocks.size, len(unit.faces)))
            start = stop
        body_of_face = np.repeat(np.arange(number.size, dtype=np.int32), np.concatenate(counts))
        mesh_arrays = (np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces))
        return RockMesh(*mesh_arrays, number.astype(np.int32)[body_of_face], body_of_face)


def find_periods(x: float, y: float, radius_m: float, period_m: float) -> list[Float64[np.ndarray, "2"]]:
    """Return the minimum x and y of the periods of a periodic field that a circle around (x, y) touches, row by row."""
    first_column, first_row = (math.floor((centre - radius_m) / period_m) for centre in (x, y))
    last_column, last_row = (math.floor((centre + radius_m) / period_m) for centre in (x, y))
    corners = []
    for row, column in product(range(first_row, last_row + 1), range(first_column, last_column + 1)):
        west, south = column * period_m, row * period_m
        nearest = max(west - x, 0.0, x - west - period_m), max(south - y, 0.0, y - south - period_m)
        # with a margin for rounding
        if math.hypot(*nearest) <= radius_m + 1e-9 * period_m:
            corners.append(np.array([west, south]))
    return corners


def _draw_positions(
    parameters: RockParameters, radius: PerRock, diameter: PerRock, surface: Surface, rng: Generator
) -> Float64[np.ndarray, "rocks 2"]:
    """Return the positions of placed rocks, and draw positions without overlap for the others by decreasing size."""
    period_m, density = surface.period_m, np.ascontiguousarray(surface.factors[..., ROCKS])
    coordinates = [(rock.east_m, rock.north_m) for rock in parameters.placed]
    placed_positions = np.array(coordinates, dtype=np.float64).reshape(-1, 2)
    placed_positions %= period_m
    count = placed_positions.shape[0]
    if radius.size == count:
        return placed_positions
    occupied = np.column_stack([placed_positions, radius[:count]])
    cell = max(CELL_OVER_DIAMETER * float(diameter[count:].mean()), period_m / 4096)
    random_positions = place_discs(
        radius[count:], occupied, density, period_m, cell, MAX_TRIES, parameters.fragments, rng
    )
    n_unplaced = int(np.count_nonzero(np.isnan(random_positions[:, 0])))
    if n_unplaced:
        total = len(random_positions)
        raise ValueError(f"{n_unplaced} of {total} rocks have no free position; a smaller rocks.abundance is needed")
    return np.concatenate([placed_positions, random_positions])
