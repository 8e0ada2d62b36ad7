"""Things that stand on the ground, as triangles: rocks, rovers, landers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from sim.render.kernels.objects import ObjectArrays

#: Triangle numbers are drawn as colours of 24 bits, of which 0 is the ground.
MOST_TRIANGLES = 2**24 - 2
#: Cells along a side of the grid in which shadows look for things, at the most.
MOST_CELLS = 512


@dataclass(frozen=True)
class Objects:
    """Triangles of bodies in world axes. Triangles of one body follow each other.

    Attributes
    ----------
    triangles, normals
        Corners and their unit normals, shape (triangles, 3 corners, 3), metres.
    body_of_triangle
        Number of the body of each triangle: row of `albedo`.
    first_triangle
        First triangle of each body, and the number of triangles at the end.
    spheres
        Centre and radius of a sphere around each body.
    albedo
        Albedo of each body.
    names
        What each body is: the number given to it by whoever made it (a rock's number in its field).
    """

    triangles: Float64[np.ndarray, "triangles 3 3"]
    normals: Float64[np.ndarray, "triangles 3 3"]
    body_of_triangle: Int32[np.ndarray, "triangles"]
    first_triangle: Int64[np.ndarray, "bodies+1"]
    spheres: Float64[np.ndarray, "bodies 4"]
    albedo: Float64[np.ndarray, "bodies"]
    names: Int64[np.ndarray, "bodies"]

    @classmethod
    def of_mesh(
        cls,
        vertices: Float64[np.ndarray, "vertices 3"],
        vertex_normals: Float64[np.ndarray, "vertices 3"],
        faces: Int32[np.ndarray, "triangles 3"],
        name_of_face: Int32[np.ndarray, "triangles"],
        albedo: float,
    ) -> Objects:
        """Bodies of one albedo from a mesh; faces that follow each other under one name are one body.

        Raises ValueError for more triangles than can be told apart in a picture.
        """
        if len(faces) > MOST_TRIANGLES:
            raise ValueError(f"{len(faces)} triangles; at most {MOST_TRIANGLES} can be drawn at once")
        changes = np.flatnonzero(np.diff(name_of_face)) + 1
        first = np.concatenate([[0], changes, [len(faces)]]).astype(np.int64) if len(faces) else np.zeros(1, np.int64)
        counts = np.diff(first)
        triangles = np.asarray(vertices, dtype=np.float64)[faces]
        return cls(
            triangles=triangles,
            normals=np.asarray(vertex_normals, dtype=np.float64)[faces],
            body_of_triangle=np.repeat(np.arange(counts.size, dtype=np.int32), counts),
            first_triangle=first,
            spheres=_spheres(triangles, first),
            albedo=np.full(counts.size, float(albedo)),
            names=np.asarray(name_of_face, dtype=np.int64)[first[:-1]],
        )

    @classmethod
    def joined(cls, parts: Sequence[Objects]) -> Objects:
        """All bodies of several sets."""
        bodies = np.cumsum([0] + [len(part.albedo) for part in parts])
        starts = np.cumsum([0] + [len(part.triangles) for part in parts])
        first = [part.first_triangle[:-1] + start for part, start in zip(parts, starts, strict=False)]
        numbers = [part.body_of_triangle + np.int32(body) for part, body in zip(parts, bodies, strict=False)]
        if starts[-1] > MOST_TRIANGLES:
            raise ValueError(f"{starts[-1]} triangles; at most {MOST_TRIANGLES} can be drawn at once")
        return cls(
            triangles=np.concatenate([part.triangles for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
            body_of_triangle=np.concatenate(numbers).astype(np.int32),
            first_triangle=np.concatenate([*first, starts[-1:]]).astype(np.int64),
            spheres=np.concatenate([part.spheres for part in parts]),
            albedo=np.concatenate([part.albedo for part in parts]),
            names=np.concatenate([part.names for part in parts]),
        )

    @classmethod
    def none(cls) -> Objects:
        """No bodies at all."""
        return cls.of_mesh(
            np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.int32), albedo=1.0
        )

    def __len__(self) -> int:
        return len(self.albedo)

    def arrays(self) -> ObjectArrays:
        """The arrays that the kernels take, with the grid in which shadows look for bodies."""
        grid, cells_x, start, items = _shadow_grid(self.spheres)
        return (
            self.triangles,
            self.normals,
            self.body_of_triangle,
            self.first_triangle,
            self.spheres,
            self.albedo,
            grid,
            cells_x,
            start,
            items,
        )


def _spheres(
    triangles: Float64[np.ndarray, "triangles 3 3"], first: Int64[np.ndarray, "bodies+1"]
) -> Float64[np.ndarray, "bodies 4"]:
    """Spheres about the middle of each body's bounding box."""
    if first.size == 1:
        return np.empty((0, 4))
    low = np.minimum.reduceat(triangles.min(axis=1), first[:-1])
    high = np.maximum.reduceat(triangles.max(axis=1), first[:-1])
    middle = 0.5 * (low + high)
    away = np.linalg.norm(triangles - np.repeat(middle, np.diff(first), axis=0)[:, None], axis=2).max(axis=1)
    return np.column_stack([middle, np.maximum.reduceat(away, first[:-1])])


def _shadow_grid(
    spheres: Float64[np.ndarray, "bodies 4"],
) -> tuple[Float64[np.ndarray, "4"], int, Int64[np.ndarray, "cells+1"], Int32[np.ndarray, "items"]]:
    """Bodies sorted into square cells of the plan view.

    A body stands in every cell that its disc, widened by three quarters of a cell, touches: a walk in steps of one cell
    then enters a cell of every body that it passes under.
    """
    if len(spheres) == 0:
        return np.array([0.0, 0.0, 1.0, -np.inf]), 1, np.zeros(2, np.int64), np.empty(0, np.int32)
    low = (spheres[:, :2] - spheres[:, 3:]).min(axis=0)
    high = (spheres[:, :2] + spheres[:, 3:]).max(axis=0)
    size = max(2.0 * float(np.median(spheres[:, 3])), float((high - low).max()) / (MOST_CELLS - 4), 1e-3)
    low = low - size
    cells = np.ceil((high - low) / size).astype(int) + 2
    widened = spheres[:, 3] + 0.75 * size
    first = np.clip(np.floor((spheres[:, :2] - widened[:, None] - low) / size).astype(int), 0, cells - 1)
    last = np.clip(np.floor((spheres[:, :2] + widened[:, None] - low) / size).astype(int), 0, cells - 1)
    spans = last - first + 1
    counts = spans.prod(axis=1)
    body = np.repeat(np.arange(len(spheres), dtype=np.int32), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    across = within % spans[body, 0] + first[body, 0]
    along = within // spans[body, 0] + first[body, 1]
    cell = along * cells[0] + across
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(cells[0] * cells[1] + 1)).astype(np.int64)
    top = float((spheres[:, 2] + spheres[:, 3]).max())
    return np.array([low[0], low[1], size, top]), int(cells[0]), start, body[order]
