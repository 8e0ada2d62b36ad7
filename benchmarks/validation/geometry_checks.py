"""Checks of geometry: markers, world points, and ranges against independent ray casting."""

from __future__ import annotations

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
from benchmarks.validation.raycast import Ground, meet_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import OVERHEAD, PAINT, cameras, descent_view, ground_view, renderer, rock_view
from marsyard.sim.frames import rigid
from marsyard.sim.render import Scene
from marsyard.sim.terrain import Surface

LIBRARIES = {"osmesa": "libOSMesa.so.8", "egl": "libEGL.so.1"}
#: Maximum relative difference of a pixel's range from the mean of its neighbours; larger values mark silhouettes.
#: Smooth ground seen from a mast at 3 deg differs by less.
BEND = 0.003
#: Number of terrain samples per pixel along the line of sight from which the renderer smooths the ground.
FINE_UNTIL = 8.0
#: Maximum range over rough ground, m; beyond it pixels cover metres of ground and contain silhouettes.
FARTHEST_ON_FOOT_M = 40.0


def _available(backend: str) -> bool:
    try:
        ctypes.CDLL(LIBRARIES[backend])
    except OSError:
        return False
    return True


def _marker_errors(backend: str, count: int) -> dict:
    """Errors of the markers, measured in a separate process because a process can use only one backend."""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.validation.markers", backend, str(count)],
        check=True,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def run_markers(quick: bool) -> Iterator[Measure]:
    count = 200 if quick else MARKERS
    for backend in LIBRARIES:
        if not _available(backend):
            continue
        result = _marker_errors(backend, count)
        how = f"{count} markers on rolling ground, {backend}"
        if result["gl"] != renderer().description():
            how += f" ({result['gl']})"
        for camera, error in result["errors"].items():
            for figure in ("rms", "worst"):
                claim = f"markers, {figure}: {camera}"
                yield Measure(f"{claim}, {backend}", error[figure], "px", find_limit(claim), how)


def _tilted_plane(slope: tuple[float, float], side: int, spacing: float) -> Surface:
    """A plane over one period of the surface; its edges are not visible from the centre."""
    row, column = np.mgrid[:side, :side] - side / 2.0
    samples = np.zeros((side, side, 2), dtype=np.float32)
    samples[..., 0] = spacing * (slope[0] * column + slope[1] * row)
    return Surface.from_samples(samples, spacing)


def run_planes(quick: bool) -> Iterator[Measure]:
    slope, side = (0.15, -0.1), 1024
    upward = np.array([-slope[0], -slope[1], 1.0])
    upward /= np.linalg.norm(upward)
    for name, camera in cameras().items():
        turn = Rotation.align_vectors(np.array([[0.15, 0.1, -1.0]]), camera.boresight()[None])[0]
        # points beyond two camera heights are excluded because wide cameras see the horizon
        height, spacing = 500.0, 6.0
        middle = np.array([0.5 * side * spacing, 0.5 * side * spacing, height])
        scene = Scene(_tilted_plane(slope, side, spacing), (middle[0], middle[1]), OVERHEAD, PAINT)
        view = View(scene, camera, rigid(turn, middle))
        frame = render(renderer(), view)
        points = frame.points_world() - [middle[0], middle[1], 0.0]
        near = np.hypot(points[..., 0], points[..., 1]) < 2.0 * height
        error = np.abs(points @ upward / frame.range_m)[near].max()
        how = f"all {int(near.sum())} pixels within two heights of a plane tilted by 10 deg"
        claim = f"world points of a tilted plane: {name}"
        yield Measure(claim, float(error), "of range", find_limit(claim), how)


@dataclass(frozen=True)
class Ranges:
    """Ranges of pixels away from silhouettes: rendered and from independent ray casting."""

    picture: np.ndarray
    cast: np.ndarray
    #: Fractions of pixels near silhouettes, and of pixels with smoothed ground.
    near_silhouettes: float
    smoothed: float

    @property
    def agreeing(self) -> float:
        return float(np.mean(np.abs(self.picture / self.cast - 1.0) < 1e-4))


def cast_ranges(view: View, count: int, farthest: float, step: float) -> Ranges:
    """Ranges at random pixels nearer than `farthest`.

    The independent ray casting also detects silhouettes: the ranges of a pixel and of opposite neighbours are not
    collinear, or some rays hit an object and some the ground. Oblique pixels that cover many terrain samples are
    excluded, because the renderer smooths the ground there.
    """
    frame = render(renderer(), view)
    columns, rows = view.camera.size
    rng = np.random.default_rng(5)
    pixels = np.stack([rng.integers(1, columns - 1, count), rng.integers(1, rows - 1, count)], axis=-1)
    picture = frame.range_m[pixels[:, 1], pixels[:, 0]]
    pixels, picture = pixels[picture < farthest], picture[picture < farthest]
    camera, ground = view.camera.transform(view.world_from_body), Ground(view.scene.surface)

    def cast(right: float, down: float) -> tuple[np.ndarray, np.ndarray]:
        """Ranges at shifted pixels, and whether the ray hits an object."""
        origins, directions = camera.rays(pixels + np.array([right, down]))
        origins = np.array(origins)
        hits = ground.cast(origins, directions, 1.3 * farthest, step)
        objects = meet_triangles(view.scene.objects, origins, directions)
        return np.minimum(hits, objects), objects < hits

    here, is_object = cast(0.0, 0.0)
    away = np.ones(len(here), dtype=bool)
    for right, down in ((1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, -0.5)):
        (ahead, object_ahead), (back, object_back) = cast(right, down), cast(-right, -down)
        with np.errstate(invalid="ignore"):
            away &= np.abs(ahead + back - 2.0 * here) < BEND * here
        away &= (object_ahead == is_object) & (object_back == is_object)
    descending = -camera.rays(pixels.astype(np.float64))[1][:, 2]
    angle = 1.0 / np.sqrt(np.prod(view.camera.focal_lengths))
    fine = picture * angle / np.maximum(descending, 0.01) < FINE_UNTIL * view.scene.surface.spacing_m
    return Ranges(picture[away & fine], here[away & fine], 1.0 - away.mean(), 1.0 - fine.mean())


def _range_row(name: str, view: View, count: int, farthest: float, step: float) -> Measure:
    ranges = cast_ranges(view, count, farthest, step)
    how = (
        f"{ranges.cast.size} random pixels; left out: {ranges.near_silhouettes:.1%} near silhouettes, "
        f"{ranges.smoothed:.1%} that cover several samples"
    )
    return Measure(
        f"ranges within 1e-4 of an independent ray cast: {name}", ranges.agreeing, "", 0.999, how, "at least"
    )


def run_ranges(quick: bool) -> Iterator[Measure]:
    count = 1000 if quick else 10000
    yield _range_row("pisgah from 2 km, with rocks", descent_view("pisgah", 2000.0, (1024, 1024)), count, 1e5, 0.4)
    yield _range_row("kelso's dunes from 1 km", descent_view("kelso", 1000.0, (1024, 1024)), count, 1e5, 0.4)
    ground, rocks = ground_view("gusev"), rock_view("gusev", 5.0)
    for nearest, farthest, share in ((10.0, "10 m", 2), (FARTHEST_ON_FOOT_M, "40 m", 4)):
        yield _range_row(f"rippled ground from a mast, up to {farthest}", ground, count // share, nearest, 0.006)
        yield _range_row(f"rocks on it from a mast, up to {farthest}", rocks, count // (2 * share), nearest, 0.006)


CHECKS = (
    Check("markers", "Geometry", run_markers),
    Check("planes", "Geometry", run_planes),
    Check("ranges", "Geometry", run_ranges),
)
