"""Irregular rock shapes from seeds, at several levels of detail: blocks, clinker, vesicular, slabs, ventifacts."""

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
from scipy.spatial import ConvexHull

from marsyard.sim.array_cache import load_array, save_array
from marsyard.sim.cache import cache_directory, evict_files, touch
from marsyard.sim.kernel_cache import processor_features

_SEED = 0x70C6  #: Root seed of all shapes.
SHAPES_OF_FORM = 16  #: Number of shapes of each form, from angular to rounded.


@dataclass(frozen=True)
class RockForm:
    """Distributions of the shapes of one form.

    - cuts, cut_distances: ranges of the number of planes that cut an ellipsoid, and of their distances from its centre
    - sharpness: exponents of the first and the last shape in the norm that combines the cuts and rounds their edges.
      The radius of an edge is about the rock's radius divided by the exponent: abrasion rounds all edges, by 1 to 20 %
      of the radius (assumed)
    - bumps: RMS height of bumps divided by the radius, in each wavenumber band
    - short_axis_ratios: range of shortest / longest axis; middle / longest axis is 0.65 to 0.95
    - buried_fractions: range of the fraction of the height that is below the ground: 20 to 60 % (assumed). Overhangs
      are buried too, up to `MAX_BURIED_FRACTION`
    - flatness: factor of the ratio of height to diameter of a terrain's rocks
    - folded: whether bumps form sharp ridges
    - bedding: whether two of the cuts are almost horizontal, and the others steep
    - pits: number of vesicles, open at the surface
    """

    cuts: tuple[int, int] = (8, 16)
    cut_distances: tuple[float, float] = (0.45, 0.85)
    sharpness: tuple[float, float] = (50.0, 5.0)
    bumps: tuple[float, float, float, float] = (0.03, 0.015, 0.008, 0.004)
    short_axis_ratios: tuple[float, float] = (0.6, 0.85)
    buried_fractions: tuple[float, float] = (0.2, 0.6)
    flatness: float = 1.0
    folded: bool = False
    bedding: bool = False
    pits: int = 0


#: Forms in the order of their shape numbers: blocks, rough clinker of a'a lava, vesicular basalt, slabs of bedrock and
#: wind-faceted ventifacts (all in images of Spirit and Opportunity: Grotzinger et al. 2005, Greeley et al. 2006).
FORMS = {
    "block": RockForm(),
    "clinker": RockForm(bumps=(0.1, 0.045, 0.022, 0.0), buried_fractions=(0.3, 0.5), folded=True),
    "vesicular": RockForm(cuts=(10, 18), sharpness=(40.0, 6.0), bumps=(0.03, 0.02, 0.012, 0.006), pits=90),
    "slab": RockForm(
        cuts=(8, 12),
        cut_distances=(0.55, 0.95),
        sharpness=(80.0, 14.0),
        short_axis_ratios=(0.9, 1.0),
        buried_fractions=(0.3, 0.7),
        flatness=0.35,
        bedding=True,
    ),
    "ventifact": RockForm(
        cuts=(5, 9), cut_distances=(0.4, 0.75), sharpness=(100.0, 25.0), bumps=(0.012, 0.008, 0.004, 0.002)
    ),
}
SHAPES = SHAPES_OF_FORM * len(FORMS)
MAX_BURIED_FRACTION = 0.7  #: Maximum fraction of the height that is below the ground.
_FILLED_OUTLINE = 0.8  #: Fraction of the outline that is below the ground, at least (assumed).
#: Range of the angular radii of vesicles, radians, and ratio of their depth to their radius.
_PIT_RADII, _PIT_DEPTH = (0.07, 0.2), 0.5
#: Range of the half thickness of slabs in their own axes, and maximum tilt of their bedding planes, radians.
_SLAB_HALF_THICKNESS, _BED_TILT = (0.35, 0.55), 0.1
#: Subdivisions of the icosahedron at each level of detail: 20, 80, 320, 1280 and 5120 triangles.
SUBDIVISIONS = (0, 1, 2, 3, 4)
COARSEST, COARSE, MEDIUM, FINE, FINEST = range(5)
DEVIATION_PX = 0.25  #: Allowed RMS deviation of a rock's image from its finest shape, pixels.
UNIT_HEIGHT = 0.5  #: Ratio of height above ground to diameter of the unit shapes; each rock is scaled to its own.
#: Wavenumbers of the bands of bumps, radians per radius, and number of waves in each band.
_BUMP_WAVENUMBERS, _BUMP_WAVES = (3.0, 6.5, 13.0, 24.0), (10, 16, 24, 32)
Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class ShapeSet:
    """All shapes at one level of detail: displaced icospheres with the same triangles.

    The ground is the plane z = 0; part of a unit shape is below it. In top view the mean of the longest and the
    shortest diameter is 1. The height above ground is `UNIT_HEIGHT`.

    - normals: normals of the smooth shape at the vertices
    - faces: vertex numbers of each triangle, counter-clockwise seen from outside
    - max_radius: largest horizontal distance of each shape's surface above the ground from its origin
    """

    vertices: Float64[np.ndarray, "shapes vertices 3"]
    normals: Float64[np.ndarray, "shapes vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    max_radius: Float64[np.ndarray, "shapes"]


@cache
def rock_shapes(detail: int) -> ShapeSet:
    """Return the shapes at a level of detail, 0 (`COARSEST`) to 4 (`FINEST`); other levels are fitted to the finest."""
    directions, faces = _icosphere(detail)
    normals = _load_or_build(
        f"normals-{detail}", lambda: np.stack([shape.normals(directions) for shape in _all_shapes()])
    )
    return ShapeSet(_vertices(detail), normals, faces, _compute_max_radius())


@cache
def max_pixels(bound_px: float = DEVIATION_PX) -> Float64[np.ndarray, "shapes levels"]:
    """Compute the maximum size in pixels up to which each level except the finest is accurate, for each shape.

    The deviation is the distance from the finest shape along its normals, RMS over the part above the ground. It must
    not exceed `bound_px`.
    """
    return bound_px * _load_or_build("pixels", _max_pixels_per_deviation)


def _max_pixels_per_deviation() -> Float64[np.ndarray, "shapes levels"]:
    """Compute the rock diameter in pixels at which a level deviates by one pixel: the diameter of a unit shape is 1."""
    shapes = rock_shapes(FINEST)
    limits = np.empty((SHAPES, FINEST))
    for number, shape in enumerate(_all_shapes()):
        finest, normals = shapes.vertices[number], shapes.normals[number]
        for detail in range(FINEST):
            inverse_radii = _corner_weights(detail) @ _fitted_inverse_radii(number, detail)
            facet_points = shape.to_unit_shape(_icosphere(FINEST)[0] / inverse_radii[:, None])
            deviation = np.sum((facet_points - finest) * normals, axis=1)[finest[:, 2] > 0.0]
            limits[number, detail] = 1.0 / np.sqrt(np.mean(deviation**2))
    return limits


@cache
def _icosphere(detail: int) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "faces 3"]]:
    """Return unit vectors to the vertices of a subdivided icosahedron, and its triangles."""
    import trimesh  # imported late, because the import is slow

    sphere = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS[detail])
    vertices = np.array(sphere.vertices, dtype=np.float64)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), np.ascontiguousarray(sphere.faces, np.int32)


def _load_or_build(name: str, build: Callable[[], Float64[np.ndarray, "..."]]) -> Float64[np.ndarray, "..."]:
    """Load an array from the terrain cache, or build and store it: building all shapes takes seconds per process."""
    identity = f"{Path(__file__).read_text()} {np.__version__} {processor_features()}"
    version = hashlib.sha256(identity.encode()).hexdigest()[:16]
    with suppress(OSError):
        path = cache_directory("terrain") / f"rocks-{name}-{version}.npy"
        cached_array = load_array(path)
        if cached_array is None:
            array = build()
            evict_files(path.parent, array.nbytes)
            return save_array(path, array)
        touch(path)
        return cached_array
    array = build()
    array.setflags(write=False)
    return array


@cache
def _vertices(detail: int) -> Float64[np.ndarray, "shapes vertices 3"]:
    return _load_or_build(f"vertices-{detail}", lambda: _build_vertices(detail))


def _build_vertices(detail: int) -> Float64[np.ndarray, "shapes vertices 3"]:
    directions, _ = _icosphere(detail)
    vertices: Float64[np.ndarray, "shapes vertices 3"] = np.empty((SHAPES, *directions.shape))
    for number, shape in enumerate(_all_shapes()):
        if detail == FINEST:
            points = directions * shape.radius(directions)[:, None]
        else:
            points = directions / _fitted_inverse_radii(number, detail)[:, None]
        vertices[number] = shape.to_unit_shape(points)
    return vertices


@cache
def _compute_max_radius() -> Float64[np.ndarray, "shapes"]:
    """Compute the maximum horizontal distance from the origin, of the part above ground, over all levels."""
    radius: Float64[np.ndarray, "shapes"] = np.zeros(SHAPES)
    for vertices in map(_vertices, range(len(SUBDIVISIONS))):
        distance = np.hypot(vertices[..., 0], vertices[..., 1])
        radius = np.maximum(radius, np.where(vertices[..., 2] >= 0.0, distance, 0.0).max(axis=1))
    radius.setflags(write=False)
    return radius


@dataclass(frozen=True)
class _RockShape:
    """A star-shaped body: an ellipsoid cut by planes, with rounded edges and a bumpy surface.

    In the shape's axes, before stretching, the distance of the surface from the centre along the unit vector d is
    ``(1 + sum((n_i . d / c_i)**p))**(-1/p) (1 + bumps(d))``, with the normals n_i and distances c_i of the cuts and the
    sharpness p. For large p this is the minimum distance of the sphere and all cuts. Bumps are waves. The waves of
    clinker are folded: their absolute values form sharp ridges. Vesicles are paraboloids below the surface.
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
    pit_directions: Float64[np.ndarray, "pits 3"]
    pit_radii: Float64[np.ndarray, "pits"]

    @classmethod
    def draw(cls, number: int) -> _RockShape:
        """Draw the shape with this number from the root seed."""
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(_SEED, spawn_key=(number,))))
        form = list(FORMS.values())[number // SHAPES_OF_FORM]
        roundness = number % SHAPES_OF_FORM / (SHAPES_OF_FORM - 1)
        cuts = int(rng.integers(*form.cuts))
        normals = rng.standard_normal((cuts, 3))
        if form.bedding:
            normals[:, 2] *= 0.25
            normals[:2] = _BED_TILT * normals[:2] + np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        waves = rng.standard_normal((sum(_BUMP_WAVES), 3))
        waves *= (np.repeat(_BUMP_WAVENUMBERS, _BUMP_WAVES) / np.linalg.norm(waves, axis=1))[:, None]
        # n waves of amplitude a have the RMS a sqrt(n / 2)
        bumps = np.repeat(np.array(form.bumps) * np.sqrt(2.0 / np.array(_BUMP_WAVES)), _BUMP_WAVES)
        distances = rng.uniform(*form.cut_distances, cuts)
        if form.bedding:
            distances[:2] = rng.uniform(*_SLAB_HALF_THICKNESS, 2)
        sharpest, roundest = form.sharpness
        phases = rng.uniform(0.0, 2.0 * np.pi, sum(_BUMP_WAVES))
        axes = np.array([1.0, rng.uniform(0.65, 0.95), rng.uniform(*form.short_axis_ratios)])
        buried_fraction = float(rng.uniform(*form.buried_fractions))
        pits = rng.standard_normal((form.pits, 3))
        return cls(
            cut_normals=normals,
            cut_distances=distances,
            sharpness=float(sharpest * (roundest / sharpest) ** roundness),
            waves=waves,
            wave_phases=phases,
            wave_heights=bumps,
            folded=form.folded,
            axes=axes,
            buried_fraction=buried_fraction,
            pit_directions=pits / np.linalg.norm(pits, axis=1, keepdims=True),
            pit_radii=rng.uniform(*_PIT_RADII, form.pits),
        )

    def to_unit_shape(self, points: Points) -> Points:
        """Convert points in the shape's own axes, before stretching, to points of the unit shape."""
        shift, stretch = self.frame
        return np.asarray((points * self.axes - shift) * stretch)

    def normals(self, directions: Points) -> Points:
        """Compute outward unit normals by finite differences of the implicit surface ``|x| - r(x / |x|)``."""

        def surface_function(points: Points) -> Float64[np.ndarray, "n"]:
            length = np.linalg.norm(points, axis=1)
            return np.asarray(length - self.radius(points / length[:, None]))

        # `* axes / axes` does not move the points, but determines the last bit of the normals
        surface_points = directions * self.radius(directions)[:, None] * self.axes / self.axes
        step = 1e-4
        differences = [
            surface_function(surface_points + offset) - surface_function(surface_points - offset)
            for offset in step * np.eye(3)
        ]
        _, stretch = self.frame
        gradient = np.stack(differences, axis=1) / (2.0 * step) / (self.axes * stretch)
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def radius(self, d: Points) -> Float64[np.ndarray, "n"]:
        """Compute the distance of the surface along unit vectors d, in the shape's own axes."""
        inverse_distance = np.maximum(_dot_products(d, self.cut_normals), 0.0) / self.cut_distances
        radius = (1.0 + np.sum(inverse_distance**self.sharpness, axis=1)) ** (-1.0 / self.sharpness)
        phase = _dot_products(d, self.waves) + self.wave_phases
        wave = np.cos(phase)
        if self.folded:
            # ridges point outwards; like a cosine, the wave has the mean 0 and the mean square 1/2
            wave = (2.0 / np.pi - np.abs(wave)) / np.sqrt(1.0 - 8.0 / np.pi**2)
        radius *= 1.0 + np.sum(self.wave_heights * wave, axis=1)
        if self.pit_radii.size:
            # 2 (1 - cos(angle)) is about angle**2; where vesicles overlap, the deepest one counts
            ratio2 = 2.0 * (1.0 - _dot_products(d, self.pit_directions)) / self.pit_radii**2
            radius *= 1.0 - np.max(_PIT_DEPTH * self.pit_radii * np.maximum(1.0 - ratio2, 0.0), axis=1)
        return np.asarray(radius)

    @cached_property
    def finest_radius(self) -> Float64[np.ndarray, "n"]:
        """Radii along the directions of the finest shapes."""
        return self.radius(_icosphere(FINEST)[0])

    @cached_property
    def frame(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Origin on the ground plane, and scale along each axis, that convert this shape to a unit shape."""
        points = _icosphere(FINEST)[0] * self.finest_radius[:, None] * self.axes
        lowest, highest = points[:, 2].min(), points[:, 2].max()
        ground = lowest + self.buried_fraction * (highest - lowest)
        # sand and dust collect below overhangs: most of the outline seen from above is below the ground
        outline = points[ConvexHull(points[:, :2]).vertices, 2]
        filled = float(np.quantile(outline, _FILLED_OUTLINE))
        ground = min(max(ground, filled), lowest + MAX_BURIED_FRACTION * (highest - lowest))
        visible = points[points[:, 2] >= ground, :2]
        # diameters in steps of one degree
        azimuth = np.linspace(0.0, np.pi, 180, endpoint=False)
        projections = visible[:, :1] * np.cos(azimuth) + visible[:, 1:] * np.sin(azimuth)
        diameters = np.ptp(projections, axis=0)
        middle = 0.5 * (visible.max(axis=0) + visible.min(axis=0))
        horizontal_scale = 2.0 / (diameters.max() + diameters.min())
        return np.array([*middle, ground]), np.array(
            [horizontal_scale, horizontal_scale, UNIT_HEIGHT / (highest - ground)]
        )


def _dot_products(d: Points, vectors: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "n m"]:
    """Compute all scalar products without BLAS, whose order of summation differs between machines."""
    x, y, z = (d[:, axis, None] * vectors[:, axis] for axis in range(3))
    return np.asarray(x + y + z)


@cache
def _all_shapes() -> tuple[_RockShape, ...]:
    """Draw all shapes in the order of their numbers."""
    return tuple(_RockShape.draw(number) for number in range(SHAPES))


@cache
def _fitted_inverse_radii(number: int, detail: int) -> Float64[np.ndarray, "corners"]:
    """Fit the inverse radii of a level's corners, so that its triangles approximate the finest shape (least squares).

    Along the direction sum(c d) of three corners with directions d and radii r, the distance of the triangle is
    1 / sum(c / r). The inverse distance is therefore linear in the inverse radii of the corners. Weights r**4 convert
    squared errors of the inverse distance, d(1 / r) = -dr / r**2, to squared errors of the distance.
    """
    corners, radius = _corner_weights(detail), _all_shapes()[number].finest_radius
    weighted_corners = corners.multiply(radius[:, None] ** 4).tocsc()
    return np.asarray(splu((corners.T @ weighted_corners).tocsc()).solve(weighted_corners.T @ (1.0 / radius)))


@cache
def _corner_weights(detail: int) -> csc_matrix:
    """Compute the weights of the corners of a level's triangles whose sum is each direction of the finest shapes."""
    directions, faces = _icosphere(detail)
    finest = _icosphere(FINEST)[0]
    centroids = directions[faces].sum(axis=1)
    # the triangle that contains a direction is among the four triangles with the nearest centroids
    candidates = np.argsort(-(finest @ centroids.T), axis=1, kind="stable")[:, :4]
    inverses = np.linalg.inv(directions[faces].transpose(0, 2, 1))
    weights = np.einsum("nkij,nj->nki", inverses[candidates], finest)
    rows = np.arange(len(finest))
    triangle = np.argmax(weights.min(axis=2), axis=1)
    corners = faces[candidates[rows, triangle]]
    entries = (np.repeat(rows, 3), corners.ravel())
    return csc_matrix((weights[rows, triangle].ravel(), entries), (len(finest), len(directions)))
