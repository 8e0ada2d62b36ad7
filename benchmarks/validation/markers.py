"""Errors of the positions of rendered markers on undulating ground, relative to the camera model.

Markers are Gaussian spots of albedo on black ground, at the ground intersections of random pixels' rays. The expected
centre of light is computed from the camera model only; perspective moves it by hundredths of a pixel.

As a program, this module measures all cameras with one backend and prints the errors as JSON, because a process can use
only one backend.
"""

import json
import sys
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.validation.raycast import Ground
from benchmarks.validation.scenes import LAMBERTIAN, OVERHEAD_SUN, cameras
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.render import PixelRays, Renderer, Scene
from marsyard.sim.terrain import Surface

#: Side of the periodic terrain, samples.
SIDE = 2048
#: Size of a marker in the image: geometric mean of the standard deviations of its ellipse, pixels.
SPOT_PX = 2.7
#: Half side of the window over which radiance is summed, and minimum distance of markers, pixels.
WINDOW, MIN_DISTANCE = 14, 46
#: Maximum angle between the line of sight and the vertical.
MAX_OBLIQUITY_RAD = np.radians(68.0)
#: Maximum off-nadir angle of a camera's axis.
MAX_TILT_RAD = np.radians(30.0)
#: Number of markers for each camera.
MARKERS = 1000


@dataclass(frozen=True)
class MarkedView:
    """Ground with markers, a camera above it, and the expected pixels of the markers."""

    scene: Scene
    camera: CameraModel
    pose: RigidTransform
    expected: np.ndarray


def _draw_attitude(camera: CameraModel, rng: np.random.Generator) -> Rotation:
    """Draw an attitude with a downward boresight, tilted by up to `MAX_TILT_RAD`."""
    tilt, azimuth, spin = rng.uniform(0.2, 1.0) * MAX_TILT_RAD, *rng.uniform(0.0, 2.0 * np.pi, 2)
    target = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    pointing = Rotation.align_vectors(target[None], camera.boresight()[None])[0]
    return Rotation.from_rotvec(spin * target) * pointing


def _draw_undulating_heights(extent_m: float, rng: np.random.Generator) -> np.ndarray:
    """Draw the heights of a periodic ground with long waves and slopes of a few degrees."""
    phase = np.arange(SIDE) * (2.0 * np.pi / SIDE)
    heights = np.zeros((SIDE, SIDE))
    for _ in range(6):
        # wave numbers in periods per side
        m, n = rng.integers(-5, 6, 2)
        wave_number = max(np.hypot(m, n), 1.0)
        amplitude = 0.05 * extent_m / (2.0 * np.pi * wave_number)
        heights += amplitude * np.cos(n * phase[:, None] + m * phase[None, :] + rng.uniform(0.0, 2.0 * np.pi))
    return heights


def create_marked_view(camera: CameraModel, height_m: float, rng: np.random.Generator) -> MarkedView:
    """Create ground with as many markers as fit into the image."""
    pose = rigid(_draw_attitude(camera, rng), np.array([0.0, 0.0, height_m]))
    world_camera = camera.transform(pose)
    pixels = _scatter_points(camera.size, rng)
    origins, rays = world_camera.rays(pixels)
    is_steep = rays[:, 2] < -np.cos(MAX_OBLIQUITY_RAD)
    pixels, origins, rays = pixels[is_steep], np.array(origins[is_steep]), rays[is_steep]
    half_side = np.abs((origins - rays * (origins[:, 2:] / rays[:, 2:]))[:, :2]).max() * 1.15
    spacing = 2.0 * half_side / SIDE
    samples = np.zeros((SIDE, SIDE, 2), dtype=np.float32)
    samples[..., 0] = _draw_undulating_heights(2.0 * half_side, rng)
    ground = Ground(Surface.from_samples(samples.copy(), spacing))
    distance = ground.cast(origins, rays, 10.0 * height_m, 2.0 * spacing)
    points = origins + distance[:, None] * rays
    sigmas = SPOT_PX / np.sqrt(_image_area(world_camera, ground, points))
    for point, sigma in zip(points, sigmas, strict=True):
        _add_spot(samples[..., 1], point / spacing, sigma / spacing)
    surface = Surface.from_samples(samples, spacing)
    # a sample is a cubic B-spline, which adds the variance spacing^2 / 3 to that of the spot
    expected = np.stack(
        [
            _expected_centre(world_camera, ground, point, np.hypot(sigma, spacing / np.sqrt(3.0)))
            for point, sigma in zip(points, sigmas, strict=True)
        ]
    )
    scene = Scene(
        surface,
        (0.0, 0.0),
        OVERHEAD_SUN,
        LAMBERTIAN,
        ground_shadows=False,
        mesh_finest_m=half_side / 250.0,
        mesh_half_width_m=4.0 * half_side,
    )
    return MarkedView(scene, camera, pose, expected)


def _scatter_points(size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Draw random pixels with a minimum distance, on a jittered grid."""
    cell = MIN_DISTANCE + 12  # at least 12 pixels of jitter
    columns, rows = (side // cell for side in size)
    corners = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    scale = np.array(size) / [columns, rows]
    jitter = scale - MIN_DISTANCE
    pixels = (corners + 0.5) * scale - 0.5 + rng.uniform(-0.5, 0.5, corners.shape) * jitter
    inside = (pixels > WINDOW + 2).all(axis=1) & (pixels < np.array(size) - WINDOW - 3).all(axis=1)
    return pixels[inside]


def _image_area(camera: CameraModel, ground: Ground, points: np.ndarray) -> np.ndarray:
    """Image area of one square metre of horizontal ground, pixels."""
    jacobian = camera.projection_jacobian(points)
    gradient = ground.gradient(points[..., 0], points[..., 1])
    ground_jacobian = jacobian[..., :2] + jacobian[..., 2:] * gradient[..., None, :]
    return np.abs(np.linalg.det(ground_jacobian))


def _add_spot(albedo: np.ndarray, position: np.ndarray, sigma: float) -> None:
    """Add a Gaussian spot to a periodic grid; position and sigma in samples."""
    half_width = int(np.ceil(6.0 * sigma))
    columns, rows = (round(float(centre)) + np.arange(-half_width, half_width + 1) for centre in position[:2])
    spot = np.exp(-((rows[:, None] - position[1]) ** 2 + (columns[None, :] - position[0]) ** 2) / (2.0 * sigma**2))
    albedo[np.ix_(rows % SIDE, columns % SIDE)] += (0.5 * spot).astype(np.float32)


def _expected_centre(camera: CameraModel, ground: Ground, marker: np.ndarray, sigma: float) -> np.ndarray:
    """Centroid of a marker in pixels, weighted by brightness under the overhead sun and by image area."""
    offset = sigma * np.linspace(-5.5, 5.5, 45)
    dx, dy = np.meshgrid(offset, offset)
    x, y = marker[0] + dx, marker[1] + dy
    points = np.stack([x, y, ground.height(x, y)], axis=-1)
    gradient = ground.gradient(x, y)
    cos_i = 1.0 / np.sqrt(1.0 + np.sum(gradient**2, axis=-1))
    weight = cos_i * _image_area(camera, ground, points) * np.exp(-(dx**2 + dy**2) / (2.0 * sigma**2))
    pixels, visible = camera.project(points)
    in_window = visible & (np.abs(pixels - np.rint(camera.project(marker)[0])) < WINDOW + 0.5).all(axis=-1)
    return (weight[in_window, None] * pixels[in_window]).sum(axis=0) / weight[in_window].sum()


def _locate_marker(radiance: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Centroid of the radiance in the window around the expected pixel."""
    u0, v0 = np.rint(expected).astype(int)
    v, u = np.mgrid[v0 - WINDOW : v0 + WINDOW + 1, u0 - WINDOW : u0 + WINDOW + 1]
    weights = radiance[v, u].astype(np.float64)
    return np.array([(weights * u).sum(), (weights * v).sum()]) / weights.sum()


def measure_marker_errors(renderer: Renderer, camera: CameraModel, seed: int, count: int = MARKERS) -> np.ndarray:
    """Measure the errors (u, v) of `count` markers from several poses, pixels, shape (count, 2)."""
    rng = np.random.default_rng(seed)
    rays = PixelRays.from_camera(camera)
    errors: list[np.ndarray] = []
    while len(errors) < count:
        # heights from a mast (1.6 m) to a parachute descent (2 km)
        view = create_marked_view(camera, float(10.0 ** rng.uniform(0.2, 3.3)), rng)
        radiance = renderer.render(view.scene, rays, view.pose).radiance
        errors += [_locate_marker(radiance, expected) - expected for expected in view.expected]
    return np.stack(errors[:count])


def main() -> None:
    """Measure the markers of all cameras; the arguments are the backend and the number of markers."""
    backend, count = sys.argv[1], int(sys.argv[2])
    renderer = Renderer(backend)  # type: ignore[arg-type]
    errors = {}
    for seed, (name, camera) in enumerate(cameras().items()):
        errors_px = np.linalg.norm(measure_marker_errors(renderer, camera, seed, count), axis=1)
        errors[name] = {"rms": float(np.sqrt(np.mean(errors_px**2))), "worst": float(errors_px.max())}
    print(json.dumps({"gl": renderer.description(), "errors": errors}))


if __name__ == "__main__":
    main()
