"""Irregular rock shapes from seeds, at several levels of detail: blocks cut by planes, and jagged clinker."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from marsyard.sim.cache import cache_directory, evict_files, load_array, save_array, touch
from marsyard.sim.kernel_cache import processor_features

SHAPES_OF_FORM = 16  #: Shapes of each form; the first blocks are angular, the last rounded.
#: Forms in the order of their shapes' numbers: blocks, and the rough clinker of a'a.
FORMS = ("block", "clinker")
SHAPES = SHAPES_OF_FORM * len(FORMS)
#: Subdivisions of the icosahedron at each level of detail: 80, 320, 1280 and 5120 triangles.
SUBDIVISIONS = (1, 2, 3, 4)
COARSE, MEDIUM, FINE, FINEST = range(4)
DEVIATION_PX = 0.25  #: Allowed RMS deviation of a rock's image from its finest shape, pixels.
UNIT_HEIGHT = 0.5  #: Height above the ground over diameter of the unit shapes. Each rock is stretched to its own.
#: Exponents of the cuts' union, which rounds their edges, from the most angular to the most rounded.
_SHARPEST, _ROUNDEST = 200.0, 10.0
#: Range of the fraction of a form's height that is under the ground.
_BURIED = {"block": (0.15, 0.4), "clinker": (0.3, 0.5)}
#: Bumps in bands of wavenumber (radians per radius): number of waves, and each form's RMS height over the radius.
_BUMP_WAVENUMBERS, _BUMP_WAVES = (3.0, 6.5, 13.0, 24.0), (10, 16, 24, 32)
_BUMP_RMS = {"block": (0.03, 0.015, 0.008, 0.004), "clinker": (0.1, 0.045, 0.022, 0.0)}
Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class ShapeSet:
    """All shapes at one level of detail; each is a displaced icosphere, so all have the same triangles.

    A unit shape stands on the ground plane z = 0, part of it below; seen from above, the mean of its longest and its
    shortest diameter is 1, and it is `UNIT_HEIGHT` high.

    - normals: those of the smooth shape, not of the triangles
    - faces: vertex numbers of each triangle, counter-clockwise seen from outside
    - reach: largest horizontal distance of each shape's surface from its origin
    """

    vertices: Float64[np.ndarray, "shapes vertices 3"]
    normals: Float64[np.ndarray, "shapes vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    reach: Float64[np.ndarray, "shapes"]


@cache
def rock_shapes(detail: int) -> ShapeSet:
    """Return the shapes at a level of detail, 0 (`COARSE`) to 3 (`FINEST`); coarser ones are fitted to the finest."""
    directions, faces = _icosphere(detail)
    normals = _load_or_build(f"normals-{detail}", lambda: np.stack([block.normals(directions) for block in _blocks()]))
    return ShapeSet(_vertices(detail), normals, faces, _reach())


@cache
def max_pixels(bound_px: float = DEVIATION_PX) -> Float64[np.ndarray, "shapes levels"]:
    """Largest size in pixels at which each shape may be drawn at each level except the finest.

    The deviation is the distance from the finest shape along its normals, RMS over the part above the ground.
    """
    return bound_px * _load_or_build("pixels", _max_pixels_per_deviation)


def _max_pixels_per_deviation() -> Float64[np.ndarray, "shapes levels"]:
    shapes = rock_shapes(FINEST)
    limits = np.empty((SHAPES, FINEST))
    for number, block in enumerate(_blocks()):
        finest, normals = shapes.vertices[number], shapes.normals[number]
        for detail in range(FINEST):
            inverse = _corner_weights(detail) @ _fitted_inverse_radii(number, detail)
            flat = block.to_unit_shape(_icosphere(FINEST)[0] / inverse[:, None])
            deviation = np.sum((flat - finest) * normals, axis=1)[finest[:, 2] > 0.0]
            limits[number, detail] = 1.0 / np.sqrt(np.mean(deviation**2))
    return limits


@cache
def _icosphere(detail: int) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "faces 3"]]:
    import trimesh  # here, as it is slow to import

    sphere = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS[detail])
    vertices = np.array(sphere.vertices, dtype=np.float64)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), np.ascontiguousarray(sphere.faces, np.int32)


def _load_or_build(name: str, build: Callable[[], Float64[np.ndarray, "..."]]) -> Float64[np.ndarray, "..."]:
    """An array from the cache of terrains, built where it is missing: all shapes take seconds in every process."""
    identity = f"{Path(__file__).read_text()} {np.__version__} {processor_features()}"
    version = hashlib.sha256(identity.encode()).hexdigest()[:16]
    with suppress(OSError):
        path = cache_directory("terrain") / f"rocks-{name}-{version}.npy"
        stored = load_array(path)
        if stored is None:
            built = build()
            evict_files(path.parent, built.nbytes)
            return save_array(path, built)
        touch(path)
        return stored
    built = build()
    built.setflags(write=False)
    return built


@cache
def _vertices(detail: int) -> Float64[np.ndarray, "shapes vertices 3"]:
    return _load_or_build(f"vertices-{detail}", lambda: _build_vertices(detail))


def _build_vertices(detail: int) -> Float64[np.ndarray, "shapes vertices 3"]:
    directions, _ = _icosphere(detail)
    vertices: Float64[np.ndarray, "shapes vertices 3"] = np.empty((SHAPES, *directions.shape))
    for number, block in enumerate(_blocks()):
        if detail == FINEST:
            points = directions * block.radius(directions)[:, None]
        else:
            points = directions / _fitted_inverse_radii(number, detail)[:, None]
        vertices[number] = block.to_unit_shape(points)
    return vertices


@cache
def _reach() -> Float64[np.ndarray, "shapes"]:
    """Largest horizontal distance from the origin, over all levels of detail: fitted corners may stick out."""
    levels = [np.hypot(_vertices(k)[..., 0], _vertices(k)[..., 1]).max(axis=1) for k in range(len(SUBDIVISIONS))]
    reach: Float64[np.ndarray, "shapes"] = np.max(levels, axis=0)
    reach.setflags(write=False)
    return reach


@dataclass(frozen=True)
class _Block:
    """A star-shaped body: an ellipsoid cut by planes whose edges are rounded, with a bumpy surface.

    In its own axes the distance of the surface from the centre along direction d is
    ``(|d|**-p + sum((n_i . d / c_i)**p))**(-1/p) (1 + bumps(d))``: for large p the smallest of all cuts. The bumps are
    waves; clinker's are folded, so that they meet in sharp ridges.
    """

    cut_normals: Float64[np.ndarray, "cuts 3"]
    cut_distances: Float64[np.ndarray, "cuts"]
    sharpness: float
    waves: Float64[np.ndarray, "waves 3"]
    wave_phases: Float64[np.ndarray, "waves"]
    wave_heights: Float64[np.ndarray, "waves"]
    folded: bool
    axes: Float64[np.ndarray, "3"]
    buried_fraction: float

    @classmethod
    def draw(cls, number: int) -> _Block:
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(0x70C6, spawn_key=(number,))))
        form = FORMS[number // SHAPES_OF_FORM]
        roundness = number % SHAPES_OF_FORM / (SHAPES_OF_FORM - 1)
        cuts = int(rng.integers(8, 16))
        normals = rng.standard_normal((cuts, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        waves = rng.standard_normal((sum(_BUMP_WAVES), 3))
        waves *= (np.repeat(_BUMP_WAVENUMBERS, _BUMP_WAVES) / np.linalg.norm(waves, axis=1))[:, None]
        bumps = np.repeat(np.array(_BUMP_RMS[form]) * np.sqrt(2.0 / np.array(_BUMP_WAVES)), _BUMP_WAVES)
        return cls(
            cut_normals=normals,
            cut_distances=rng.uniform(0.45, 0.85, cuts),
            sharpness=float(_SHARPEST * (_ROUNDEST / _SHARPEST) ** roundness),
            waves=waves,
            wave_phases=rng.uniform(0.0, 2.0 * np.pi, sum(_BUMP_WAVES)),
            wave_heights=bumps,
            folded=form == "clinker",
            axes=np.array([1.0, rng.uniform(0.65, 0.95), rng.uniform(0.6, 0.85)]),
            buried_fraction=float(rng.uniform(*_BURIED[form])),
        )

    def to_unit_shape(self, own: Points) -> Points:
        """Points of the unit shape from points in the block's own axes before stretching."""
        shift, stretch = self.frame
        return np.asarray((own * self.axes - shift) * stretch)

    def normals(self, directions: Points) -> Points:
        """Outward unit normals along directions, by differences of the implicit surface ``|x| - r(x / |x|)``."""

        def implicit(points: Points) -> Float64[np.ndarray, "n"]:
            length = np.linalg.norm(points, axis=1)
            return np.asarray(length - self.radius(points / length[:, None]))

        own = directions * self.radius(directions)[:, None] * self.axes / self.axes
        step = 1e-4
        differences = [implicit(own + offset) - implicit(own - offset) for offset in step * np.eye(3)]
        gradient = np.stack(differences, axis=1) / (2.0 * step) / (self.axes * self.frame[1])
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def radius(self, d: Points) -> Float64[np.ndarray, "n"]:
        """Distance of the surface along directions, in the block's own axes."""
        towards = np.maximum(_dot_products(d, self.cut_normals), 0.0) / self.cut_distances
        radius = (1.0 + np.sum(towards**self.sharpness, axis=1)) ** (-1.0 / self.sharpness)
        phase = _dot_products(d, self.waves) + self.wave_phases
        wave = np.cos(phase)
        if self.folded:
            # same mean square, 1/2, about the mean 0; cusps outwards
            wave = (2.0 / np.pi - np.abs(wave)) / np.sqrt(1.0 - 8.0 / np.pi**2)
        return np.asarray(radius * (1.0 + np.sum(self.wave_heights * wave, axis=1)))

    @cached_property
    def finest_radius(self) -> Float64[np.ndarray, "n"]:
        """Radii along the finest shapes' directions."""
        return self.radius(_icosphere(FINEST)[0])

    @cached_property
    def frame(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Origin on the ground plane and scale that make the block a unit shape."""
        points = _icosphere(FINEST)[0] * self.finest_radius[:, None] * self.axes
        lowest, highest = points[:, 2].min(), points[:, 2].max()
        ground = lowest + self.buried_fraction * (highest - lowest)
        visible = points[points[:, 2] >= ground, :2]
        azimuth = np.linspace(0.0, np.pi, 180, endpoint=False)
        along = visible[:, :1] * np.cos(azimuth) + visible[:, 1:] * np.sin(azimuth)
        diameters = np.ptp(along, axis=0)
        middle = 0.5 * (visible.max(axis=0) + visible.min(axis=0))
        across = 2.0 / (diameters.max() + diameters.min())
        return np.array([*middle, ground]), np.array([across, across, UNIT_HEIGHT / (highest - ground)])


def _dot_products(d: Points, vectors: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "n m"]:
    """All scalar products, written out because the order of summation of BLAS differs between machines."""
    x, y, z = (d[:, axis, None] * vectors[:, axis] for axis in range(3))
    return np.asarray(x + y + z)


@cache
def _blocks() -> tuple[_Block, ...]:
    return tuple(_Block.draw(number) for number in range(SHAPES))


@cache
def _fitted_inverse_radii(number: int, detail: int) -> Float64[np.ndarray, "corners"]:
    """Inverse radii of a level's corners whose flat triangles deviate least, in mean square, from the finest shape.

    Along a direction that is a sum of three corners' directions with weights c, a triangle lies at the distance
    1 / sum(c / r): its inverse is linear in the inverse radii of its corners.
    """
    corners, radius = _corner_weights(detail), _blocks()[number].finest_radius
    weighted = corners.multiply(radius[:, None] ** 4).tocsc()
    return np.asarray(splu((corners.T @ weighted).tocsc()).solve(weighted.T @ (1.0 / radius)))


@cache
def _corner_weights(detail: int) -> csc_matrix:
    """Weights that express each direction of the finest shapes by the corners of a level's triangle there."""
    directions, faces = _icosphere(detail)
    finest = _icosphere(FINEST)[0]
    middles = directions[faces].sum(axis=1)
    # the triangle that holds a direction is among those whose middles are nearest
    near = np.argsort(-(finest @ middles.T), axis=1, kind="stable")[:, :4]
    solved = np.linalg.inv(directions[faces].transpose(0, 2, 1))
    weights = np.einsum("nkij,nj->nki", solved[near], finest)
    rows = np.arange(len(finest))
    best = np.argmax(weights.min(axis=2), axis=1)
    corners = faces[near[rows, best]]
    entries = (np.repeat(rows, 3), corners.ravel())
    return csc_matrix((weights[rows, best].ravel(), entries), (len(finest), len(directions)))
