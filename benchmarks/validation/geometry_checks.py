"""The bars on geometry: markers, world points, ranges against an independent ray cast."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from benchmarks.validation.markers import MARKERS
from benchmarks.validation.motion import View, render
from benchmarks.validation.raycast import Ground, meet_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import (
    OVERHEAD,
    PAINT,
    cameras,
    descent_view,
    ground_view,
    renderer,
    rock_view,
)
from sim.frames import rigid
from sim.render import Frame, Scene
from sim.terrain import Surface

LIBRARIES = {"osmesa": "libOSMesa.so.8", "egl": "libEGL.so.1"}
#: Ranges of neighbouring pixels that differ by more than this share lie to both sides of a silhouette.
SILHOUETTE = 0.1
#: Farther than this over rough ground a pixel covers metres of it, and silhouettes are everywhere.
FARTHEST_ON_FOOT_M = 40.0


def _available(backend: str) -> bool:
    try:
        ctypes.CDLL(LIBRARIES[backend])
    except OSError:
        return False
    return True


def _marker_errors(backend: str, count: int) -> dict:
    """Errors of the markers in a process of its own: a process keeps to one backend."""
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
        how = f"{count} markers on rolling ground, {backend} ({result['gl']})"
        for camera, error in result["errors"].items():
            yield Measure(f"markers, rms: {camera}, {backend}", error["rms"], "px", 0.05, how)
            yield Measure(f"markers, worst: {camera}, {backend}", error["worst"], "px", 0.15, how)


def _tilted_plane(slope: tuple[float, float], side: int, spacing: float) -> Surface:
    """A plane over one period, in whose middle its edges are out of sight."""
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
        # a wide camera sees the horizon: what lies beyond two heights is left out
        height, spacing = 500.0, 6.0
        middle = np.array([0.5 * side * spacing, 0.5 * side * spacing, height])
        scene = Scene(_tilted_plane(slope, side, spacing), (middle[0], middle[1]), OVERHEAD, PAINT)
        view = View(scene, camera, rigid(turn, middle))
        frame = render(renderer(), view)
        points = frame.points_world() - [middle[0], middle[1], 0.0]
        near = np.hypot(points[..., 0], points[..., 1]) < 2.0 * height
        error = np.abs(points @ upward / frame.range_m)[near].max()
        how = f"all {int(near.sum())} pixels within two heights of a plane tilted by 10 deg"
        yield Measure(f"world points of a tilted plane: {name}", float(error), "of range", 1e-5, how)


def _cast_frame(view: View, frame: Frame, count: int, farthest: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Ranges of some pixels away from silhouettes: the picture's, and those of an independent ray cast."""
    seen = np.where(np.isfinite(frame.range_m), frame.range_m, 1e9)
    ratio = maximum_filter(seen, 3) / minimum_filter(seen, 3)
    eligible = np.flatnonzero((ratio < 1.0 + SILHOUETTE) & (frame.range_m < farthest))
    pixels = np.random.default_rng(5).choice(eligible, min(count, eligible.size), replace=False)
    rays = frame.rays
    to_world = view.world_from_body.rotation
    directions = to_world.apply(rays.directions[pixels].astype(np.float64))
    origins = view.world_from_body.apply(rays.centre + rays.origins[pixels].astype(np.float64))
    ground = Ground(view.scene.surface).cast(origins, directions, 1.2 * farthest, step)
    theirs = np.minimum(ground, meet_triangles(view.scene.objects, origins, directions))
    return frame.range_m.ravel()[pixels], theirs


def _range_row(name: str, view: View, count: int, farthest: float, step: float) -> Measure:
    frame = render(renderer(), view)
    ours, theirs = _cast_frame(view, frame, count, farthest, step)
    share = float(np.mean(np.abs(ours / theirs - 1.0) < 1e-4))
    how = f"{ours.size} random pixels; SciPy's B-spline and bisection" + (
        ", brute force over triangles" if len(view.scene.objects) else ""
    )
    return Measure(f"ranges within 1e-4 of an independent ray cast: {name}", share, "", 0.999, how, "at least")


def run_ranges(quick: bool) -> Iterator[Measure]:
    count = 1000 if quick else 10000
    yield _range_row("pisgah from 2 km, with rocks", descent_view("pisgah", 2000.0, (1024, 1024)), count, 1e5, 0.4)
    yield _range_row("kelso's dunes from 1 km", descent_view("kelso", 1000.0, (1024, 1024)), count, 1e5, 0.4)
    ground = ground_view("gusev")
    yield _range_row("rippled ground from a mast", ground, count // 2, FARTHEST_ON_FOOT_M, 0.006)
    rocks = rock_view("gusev", 5.0)
    yield _range_row("rocks on it from a mast", rocks, count // 5, FARTHEST_ON_FOOT_M, 0.006)


CHECKS = (
    Check("markers", "Geometry", run_markers),
    Check("planes", "Geometry", run_planes),
    Check("ranges", "Geometry", run_ranges),
)
