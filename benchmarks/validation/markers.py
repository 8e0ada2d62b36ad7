"""Positions of rendered markers on undulating ground, compared with the camera model.

Markers are Gaussian spots of albedo on black ground, at the ground intersections of random pixels' rays. The expected
centre of light is computed from the camera model only; perspective moves it by hundredths of a pixel.

As a program, this module measures all cameras with one backend and prints the errors as JSON, because a process can use
only one backend.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.validation.raycast import Ground
from benchmarks.validation.scenes import OVERHEAD, PAINT, cameras
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.render import PixelRays, Renderer, Scene
from marsyard.sim.terrain import Surface

SIDE = 2048
#: Size of a marker in the image: geometric mean of the standard deviations of its ellipse, pixels.
SPOT_PX = 2.7
#: Half side of the window in which the light is summed, and minimum distance of markers, pixels.
WINDOW, APART = 14, 46
#: Maximum angle between the line of sight and the vertical.
MAX_OBLIQUITY_RAD = np.radians(68.0)
#: Maximum off-nadir angle of a camera's axis.
MAX_TILT_RAD = np.radians(30.0)
MARKERS = 1000


@dataclass(frozen=True)
class Marked:
    """Ground with markers, a camera above it, and the expected pixels of the markers."""

    scene: Scene
    camera: CameraModel
    pose: RigidTransform
    expected: np.ndarray


def _looking_down(camera: CameraModel, rng: np.random.Generator) -> Rotation:
    """Draw an attitude with a downward boresight, tilted by up to `MAX_TILT_RAD`."""
    tilt, about, spin = rng.uniform(0.2, 1.0) * MAX_TILT_RAD, *rng.uniform(0.0, 2.0 * np.pi, 2)
    target = np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), -np.cos(tilt)])
    turned = Rotation.align_vectors(target[None], camera.boresight()[None])[0]
    return Rotation.from_rotvec(spin * target) * turned


def _rolling(extent_m: float, rng: np.random.Generator) -> np.ndarray:
    """Heights of a periodic ground of long waves with slopes of a few degrees."""
    phase = np.arange(SIDE) * (2.0 * np.pi / SIDE)
    heights = np.zeros((SIDE, SIDE))
    for _ in range(6):
        m, n = rng.integers(-5, 6, 2)
        k = max(np.hypot(m, n), 1.0)
        amplitude = 0.05 * extent_m / (2.0 * np.pi * k)
        heights += amplitude * np.cos(n * phase[:, None] + m * phase[None, :] + rng.uniform(0.0, 2.0 * np.pi))
    return heights


def mark_view(camera: CameraModel, height_m: float, rng: np.random.Generator) -> Marked:
    """Create ground with as many markers as fit into the image."""
    pose = rigid(_looking_down(camera, rng), np.array([0.0, 0.0, height_m]))
    world_camera = camera.transform(pose)
    pixels = _scatter_points(camera.size, rng)
    origins, rays = world_camera.rays(pixels)
    steep = rays[:, 2] < -np.cos(MAX_OBLIQUITY_RAD)
    pixels, origins, rays = pixels[steep], np.array(origins[steep]), rays[steep]
    reach = np.abs((origins - rays * (origins[:, 2:] / rays[:, 2:]))[:, :2]).max() * 1.15
    spacing = 2.0 * reach / SIDE
    samples = np.zeros((SIDE, SIDE, 2), dtype=np.float32)
    samples[..., 0] = _rolling(2.0 * reach, rng)
    bare = Ground(Surface.from_samples(samples.copy(), spacing))
    distance = bare.cast(origins, rays, 10.0 * height_m, 2.0 * spacing)
    points = origins + distance[:, None] * rays
    sigma = SPOT_PX / np.sqrt(_picture_area(world_camera, bare, points))
    for point, one in zip(points, sigma, strict=True):
        _paint(samples[..., 1], point / spacing, one / spacing)
    surface = Surface.from_samples(samples, spacing)
    expected = np.stack(
        [
            _centre_of_light(world_camera, bare, point, np.hypot(one, spacing / np.sqrt(3.0)))
            for point, one in zip(points, sigma, strict=True)
        ]
    )
    scene = Scene(
        surface,
        (0.0, 0.0),
        OVERHEAD,
        PAINT,
        ground_shadows=False,
        mesh_finest_m=reach / 250.0,
        mesh_reach_m=4.0 * reach,
    )
    return Marked(scene, camera, pose, expected)


def _scatter_points(size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Random pixels with a minimum distance: a jittered grid."""
    cell = APART + 12
    across, down = (side // cell for side in size)
    corners = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2)
    scale = np.array(size) / [across, down]
    free = scale - APART
    pixels = (corners + 0.5) * scale - 0.5 + rng.uniform(-0.5, 0.5, corners.shape) * free
    inside = (pixels > WINDOW + 2).all(axis=1) & (pixels < np.array(size) - WINDOW - 3).all(axis=1)
    return pixels[inside]


def _picture_area(camera: CameraModel, ground: Ground, points: np.ndarray) -> np.ndarray:
    """Image area of one square metre of horizontal ground, pixels."""
    jacobian = camera.projection_jacobian(points)
    gradient = ground.gradient(points[..., 0], points[..., 1])
    by_plan = jacobian[..., :2] + jacobian[..., 2:] * gradient[..., None, :]
    return np.abs(np.linalg.det(by_plan))


def _paint(albedo: np.ndarray, place: np.ndarray, sigma: float) -> None:
    """Add a Gaussian spot to a periodic grid; position and sigma in samples."""
    reach = int(np.ceil(6.0 * sigma))
    columns, rows = (round(float(one)) + np.arange(-reach, reach + 1) for one in place[:2])
    spot = np.exp(-((rows[:, None] - place[1]) ** 2 + (columns[None, :] - place[0]) ** 2) / (2.0 * sigma**2))
    albedo[np.ix_(rows % SIDE, columns % SIDE)] += (0.5 * spot).astype(np.float32)


def _centre_of_light(camera: CameraModel, ground: Ground, marker: np.ndarray, sigma: float) -> np.ndarray:
    """Mean pixel of a marker, weighted by brightness under the overhead sun and by image area."""
    offset = sigma * np.linspace(-5.5, 5.5, 45)
    dx, dy = np.meshgrid(offset, offset)
    x, y = marker[0] + dx, marker[1] + dy
    points = np.stack([x, y, ground.height(x, y)], axis=-1)
    gradient = ground.gradient(x, y)
    cos_i = 1.0 / np.sqrt(1.0 + np.sum(gradient**2, axis=-1))
    weight = cos_i * _picture_area(camera, ground, points) * np.exp(-(dx**2 + dy**2) / (2.0 * sigma**2))
    pixels, visible = camera.project(points)
    near = visible & (np.abs(pixels - np.rint(camera.project(marker)[0])) < WINDOW + 0.5).all(axis=-1)
    return (weight[near, None] * pixels[near]).sum(axis=0) / weight[near].sum()


def _locate_marker(radiance: np.ndarray, near: np.ndarray) -> np.ndarray:
    u0, v0 = np.rint(near).astype(int)
    v, u = np.mgrid[v0 - WINDOW : v0 + WINDOW + 1, u0 - WINDOW : u0 + WINDOW + 1]
    light = radiance[v, u].astype(np.float64)
    return np.array([(light * u).sum(), (light * v).sum()]) / light.sum()


def marker_errors(renderer: Renderer, camera: CameraModel, seed: int, count: int = MARKERS) -> np.ndarray:
    """Errors (u, v) of `count` markers over several poses, shape (count, 2)."""
    rng = np.random.default_rng(seed)
    rays = PixelRays.of(camera)
    errors: list[np.ndarray] = []
    while len(errors) < count:
        # from the height of a mast to that of a parachute descent
        marked = mark_view(camera, float(10.0 ** rng.uniform(0.2, 3.3)), rng)
        radiance = renderer.render(marked.scene, rays, marked.pose).radiance
        errors += [_locate_marker(radiance, near) - near for near in marked.expected]
    return np.stack(errors[:count])


def main() -> None:
    backend, count = sys.argv[1], int(sys.argv[2])
    renderer = Renderer(backend)  # type: ignore[arg-type]
    errors = {}
    for seed, (name, camera) in enumerate(cameras().items()):
        away = np.linalg.norm(marker_errors(renderer, camera, seed, count), axis=1)
        errors[name] = {"rms": float(np.sqrt(np.mean(away**2))), "worst": float(away.max())}
    print(json.dumps({"gl": renderer.description(), "errors": errors}))


if __name__ == "__main__":
    main()
