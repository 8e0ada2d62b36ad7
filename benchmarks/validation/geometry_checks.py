"""Checks of geometry: markers, world points, and ranges against independent ray casting."""

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.validation.limits import find_limit
from benchmarks.validation.markers import MARKERS
from benchmarks.validation.motion import View, render
from benchmarks.validation.raycast import Ground, cast_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import (
    CAMERA_CONDITIONS,
    LAMBERTIAN,
    MAST,
    OVERHEAD_SUN,
    cameras,
    descent_conditions,
    descent_view,
    ground_view,
    renderer,
    rock_view,
)
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.frames import rigid
from marsyard.sim.render import Scene
from marsyard.sim.terrain import Surface

#: Shared libraries of the OpenGL backends.
LIBRARIES = {"osmesa": "libOSMesa.so.8", "egl": "libEGL.so.1"}
#: Maximum second difference of the ranges of a pixel and two opposite neighbours, divided by the range. Larger values
#: mark silhouettes; smooth ground seen from a mast at 3 deg above the surface has smaller values.
MAX_RANGE_CURVATURE = 0.003
#: Maximum number of terrain samples per pixel along the line of sight; above it the renderer smooths the ground.
MAX_SAMPLES_PER_PIXEL = 8.0
#: Maximum range from a mast over rough ground, m; beyond it pixels cover metres of ground and contain silhouettes.
MAX_MAST_RANGE_M = 40.0


def _is_available(backend: str) -> bool:
    """Whether the library of an OpenGL backend can be loaded."""
    try:
        ctypes.CDLL(LIBRARIES[backend])
    except OSError:
        return False
    return True


def _measure_marker_errors(backend: str, count: int) -> dict:
    """Measure the errors of the markers in a separate process, because a process can use only one backend."""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    result = subprocess.run(
        [sys.executable, "-m", "benchmarks.validation.markers", backend, str(count)],
        check=True,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(result.stdout.splitlines()[-1])


def run_markers(quick: bool) -> Iterator[Measure]:
    """Measure the errors of rendered markers for all cameras and both OpenGL backends."""
    count = 200 if quick else MARKERS
    for backend in LIBRARIES:
        if not _is_available(backend):
            continue
        result = _measure_marker_errors(backend, count)
        how = f"{count} markers on undulating ground, {backend}"
        if result["gl"] != renderer().description():
            how += f" ({result['gl']})"
        for camera, error in result["errors"].items():
            for statistic in ("rms", "worst"):
                claim = f"markers, {statistic}: {camera}"
                yield Measure(f"{claim}, {backend}", error[statistic], "px", find_limit(claim), how)


def _tilted_plane(slope: tuple[float, float], side: int, spacing: float) -> Surface:
    """Create a plane over one period of the surface; its edges are not visible from the centre."""
    row, column = np.mgrid[:side, :side] - side / 2.0
    samples = np.zeros((side, side, 2), dtype=np.float32)
    samples[..., 0] = spacing * (slope[0] * column + slope[1] * row)
    return Surface.from_samples(samples, spacing)


def run_planes(quick: bool) -> Iterator[Measure]:
    """Compare the world points of a tilted plane with its equation, for all cameras."""
    slope, side = (0.15, -0.1), 1024
    normal = np.array([-slope[0], -slope[1], 1.0])
    normal /= np.linalg.norm(normal)
    for name, camera in cameras().items():
        attitude = Rotation.align_vectors(np.array([[0.15, 0.1, -1.0]]), camera.boresight()[None])[0]
        # points beyond two camera heights are excluded because wide cameras see the horizon
        height, spacing = 500.0, 6.0
        position = np.array([0.5 * side * spacing, 0.5 * side * spacing, height])
        scene = Scene(_tilted_plane(slope, side, spacing), (position[0], position[1]), OVERHEAD_SUN, LAMBERTIAN)
        view = View(scene, camera, rigid(attitude, position))
        frame = render(renderer(), view)
        points = frame.points_world() - [position[0], position[1], 0.0]
        is_near = np.hypot(points[..., 0], points[..., 1]) < 2.0 * height
        error = np.abs(points @ normal / frame.range_m)[is_near].max()
        how = f"all {int(is_near.sum())} pixels within two heights of a plane tilted by 10 deg"
        claim = f"world points of a tilted plane: {name}"
        yield Measure(claim, float(error), "of range", find_limit(claim), how)


@dataclass(frozen=True)
class Ranges:
    """Ranges of pixels away from silhouettes, m: rendered and from independent ray casting."""

    rendered_m: np.ndarray
    reference_m: np.ndarray
    #: Fractions of pixels near silhouettes, and of pixels with smoothed ground.
    silhouette_fraction: float
    smoothed_fraction: float

    @property
    def agreement(self) -> float:
        """Fraction of ranges within 1e-4 of the independent ray casting."""
        return float(np.mean(np.abs(self.rendered_m / self.reference_m - 1.0) < 1e-4))


def cast_ranges(view: View, count: int, max_range_m: float, step: float) -> Ranges:
    """Compute the ranges at `count` random pixels, up to the range `max_range_m`; `step` is that of `Ground.cast`, m.

    The independent ray casting also detects silhouettes: the ranges of a pixel and of opposite neighbours are not
    collinear, or some rays hit an object and some the ground. Oblique pixels that cover many terrain samples are
    excluded, because the renderer smooths the ground there.
    """
    frame = render(renderer(), view)
    columns, rows = view.camera.size
    rng = np.random.default_rng(5)
    pixels = np.stack([rng.integers(1, columns - 1, count), rng.integers(1, rows - 1, count)], axis=-1)
    rendered_m = frame.range_m[pixels[:, 1], pixels[:, 0]]
    pixels, rendered_m = pixels[rendered_m < max_range_m], rendered_m[rendered_m < max_range_m]
    camera, ground = view.camera.transform(view.world_from_body), Ground(view.scene.surface)

    def cast(right: float, down: float) -> tuple[np.ndarray, np.ndarray]:
        """Ranges at pixels shifted by `right` and `down` pixels, and whether the ray hits an object."""
        origins, directions = camera.rays(pixels + np.array([right, down]))
        origins = np.array(origins)
        hits = ground.cast(origins, directions, 1.3 * max_range_m, step)
        objects = cast_triangles(view.scene.objects, origins, directions)
        return np.minimum(hits, objects), objects < hits

    ranges, is_object = cast(0.0, 0.0)
    is_smooth = np.ones(len(ranges), dtype=bool)
    for right, down in ((1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, -0.5)):
        (forward, is_object_forward), (backward, is_object_backward) = cast(right, down), cast(-right, -down)
        with np.errstate(invalid="ignore"):
            is_smooth &= np.abs(forward + backward - 2.0 * ranges) < MAX_RANGE_CURVATURE * ranges
        is_smooth &= (is_object_forward == is_object) & (is_object_backward == is_object)
    downward = -camera.rays(pixels.astype(np.float64))[1][:, 2]
    pixel_rad = 1.0 / np.sqrt(np.prod(view.camera.focal_lengths))
    is_resolved = (
        rendered_m * pixel_rad / np.maximum(downward, 0.01) < MAX_SAMPLES_PER_PIXEL * view.scene.surface.spacing_m
    )
    is_compared = is_smooth & is_resolved
    return Ranges(rendered_m[is_compared], ranges[is_compared], 1.0 - is_smooth.mean(), 1.0 - is_resolved.mean())


def _measure_ranges(name: str, view: View, count: int, max_range_m: float, step: float) -> Measure:
    """Measure the agreement of the ranges of `cast_ranges`."""
    ranges = cast_ranges(view, count, max_range_m, step)
    how = (
        f"{ranges.reference_m.size} random pixels; excluded: {ranges.silhouette_fraction:.1%} near silhouettes, "
        f"{ranges.smoothed_fraction:.1%} that cover several samples"
    )
    return Measure(
        f"ranges within 1e-4 of independent ray casting: {name}", ranges.agreement, "", 0.999, how, "at least"
    )


def run_ranges(quick: bool) -> Iterator[Measure]:
    """Compare ranges over terrain and rocks with independent ray casting."""
    count = 1000 if quick else 10000
    yield _measure_ranges("pisgah from 2 km, with rocks", descent_view("pisgah", 2000.0, (1024, 1024)), count, 1e5, 0.4)
    yield _measure_ranges("kelso's dunes from 1 km", descent_view("kelso", 1000.0, (1024, 1024)), count, 1e5, 0.4)
    ground, rocks = ground_view("gusev"), rock_view("gusev", 5.0)
    for range_m, label, divisor in ((10.0, "10 m", 2), (MAX_MAST_RANGE_M, "40 m", 4)):
        yield _measure_ranges(f"rippled ground from a mast, up to {label}", ground, count // divisor, range_m, 0.006)
        yield _measure_ranges(
            f"rocks on rippled ground from a mast, up to {label}", rocks, count // (2 * divisor), range_m, 0.006
        )


CHECKS = (
    Check("markers", "Geometry", run_markers, conditions=CAMERA_CONDITIONS),
    Check("planes", "Geometry", run_planes, conditions=CAMERA_CONDITIONS),
    Check(
        "ranges",
        "Geometry",
        run_ranges,
        conditions=(
            descent_conditions("*pisgah from 2 km*", "pisgah", 2000.0),
            descent_conditions("*kelso's dunes*", "kelso", 1000.0),
            Conditions("*: rippled ground*10 m", MAST, site=("gusev",), camera=("mer-navcam",), range_m=(1.6, 10.0)),
            Conditions("*: rippled ground*40 m", MAST, site=("gusev",), camera=("mer-navcam",), range_m=(1.6, 40.0)),
            Conditions("*: rocks*10 m", MAST, site=("gusev",), camera=("research-pancam",), range_m=(5.0, 10.0)),
            Conditions("*: rocks*40 m", MAST, site=("gusev",), camera=("research-pancam",), range_m=(5.0, 40.0)),
        ),
    ),
)
