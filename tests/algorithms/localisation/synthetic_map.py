"""Synthetic map, terrain and descent images for the tests of map-relative localisation: a ray-traced height field.

The appearance (brightness) of the terrain has a finer grid than the map; a map pixel is the mean over a square of fine
pixels. Images are traced from pixels to the ground with super-sampling, on the finer grid and with more iterations than
in the algorithm.
"""

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from scipy import fft
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.sim.camera import Cahv, Cahvore, CameraModel
from marsyard.sim.frames import rigid

MAP_PIXEL_M = 6.0


@dataclass(frozen=True)
class Scene:
    """True terrain: appearance on a grid of `fine` pixels per map pixel, elevation on the map's grid; and its map."""

    fine_appearance: np.ndarray
    fine: int
    map_product: MapProduct


def random_field(size: int, slope: float, rng: np.random.Generator, low_cycles: float, high: float = 0.4) -> np.ndarray:
    """Draw a random field with amplitudes proportional to frequency**-slope and standard deviation 1.

    - size: pixels along each side
    - low_cycles, high: lowest frequency, cycles per side, and highest frequency, cycles per pixel
    """
    n = fft.next_fast_len(size, real=True)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(n), fft.rfftfreq(n), indexing="ij")).astype(np.float32)
    amplitude = np.zeros_like(frequency)
    band = (frequency >= low_cycles / n) & (frequency < high)
    amplitude[band] = frequency[band] ** np.float32(-slope)
    noise = rng.standard_normal((n, n), dtype=np.float32)
    values = fft.irfft2(amplitude * fft.rfft2(noise), (n, n))[:size, :size]
    return np.asarray(values / values.std(), dtype=np.float32)


def map_from_fine(fine_appearance: np.ndarray, fine: int, elevation: np.ndarray) -> MapProduct:
    """Average the appearance over `fine` x `fine` pixels; return an exact map with its centre at (0, 0)."""
    size = fine_appearance.shape[0] // fine
    appearance = cv2.resize(fine_appearance, (size, size), interpolation=cv2.INTER_AREA)
    origin = -0.5 * (size - 1) * MAP_PIXEL_M
    return MapProduct(appearance, elevation, np.array([origin, origin]), MAP_PIXEL_M, 0.0, 0.0, 0.0)


@cache
def make_scene(seed: int = 1, size: int = 1536, relief_m: float = 80.0, contrast: float = 0.12, fine: int = 2) -> Scene:
    """Create terrain with texture of all scales down to 7.5 m, and relief of `relief_m` (standard deviation)."""
    rng = np.random.default_rng(seed)
    texture = random_field(fine * size, 1.2, rng, 8.0)
    elevation = relief_m * random_field(size, 2.5, rng, 2.0, high=0.04)
    appearance = (1.0 + contrast * texture).astype(np.float32)
    return Scene(appearance, fine, map_from_fine(appearance, fine, elevation))


def make_camera(pixels: int) -> Cahvore:
    """Create a fisheye camera of 94 deg (1.6 mrad per pixel at 1024 pixels), 0.1 m off the body origin."""
    focal = pixels / 1024.0 / 1.6e-3
    pinhole = Cahv.from_axes(
        (focal, 1.002 * focal),
        (pixels, pixels),
        axis=(0.0, 0.0, -1.0),
        right=(1.0, 0.0, 0.0),
        centre=(0.1, -0.05, -0.02),
        image_centre=(0.5 * pixels + 3.0, 0.5 * pixels - 5.0),
    )
    return Cahvore.from_cahv(pinhole, (0.0, 0.01, -0.005), (0.001, 0.0, 0.0), linearity=0.0)


def _refine(size: tuple[int, int], samples: int) -> np.ndarray:
    """Compute the centres (u, v) of `samples` x `samples` squares in each pixel."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    columns, rows = size
    u, v = np.arange(columns)[:, None] + offsets, np.arange(rows)[:, None] + offsets
    return np.stack(np.meshgrid(u.ravel(), v.ravel()), axis=-1)


def trace_image(
    scene: Scene, camera: CameraModel, position: np.ndarray, attitude: Rotation, samples: int = 2
) -> np.ndarray:
    """Compute the image of a camera (body frame) at a pose: mean radiance over `samples` x `samples` rays per pixel."""
    world = camera.transform(rigid(attitude, position))
    columns, rows = camera.size
    # rays are smooth functions of the pixel: interpolated from every fourth pixel by a cubic spline to below 1e-6
    step = 4
    u, v = np.arange(-step, columns + 2 * step, step, dtype=float), np.arange(-step, rows + 2 * step, step, dtype=float)
    nodes = np.stack(np.meshgrid(u, v), axis=-1)
    origins, directions = world.rays(nodes)
    subpixels = _refine(camera.size, samples)
    node_rows, node_columns = (subpixels[:, 0, 1] + step) / step, (subpixels[0, :, 0] + step) / step
    slopes = np.stack([_interpolate(directions[..., k] / directions[..., 2], node_rows, node_columns) for k in (0, 1)])
    origin = origins.reshape(-1, 3).mean(axis=0)  # the pupil moves by millimetres
    product = scene.map_product
    elevation = np.zeros(slopes.shape[1:], np.float32)
    for _ in range(20):
        x = (origin[0] + (elevation - origin[2]) * slopes[0] - product.origin_m[0]) / MAP_PIXEL_M
        y = (origin[1] + (elevation - origin[2]) * slopes[1] - product.origin_m[1]) / MAP_PIXEL_M
        previous, elevation = elevation, _sample(product.elevation_m, x, y)
        if np.abs(elevation - previous).max() < 2e-3:
            break
    f = scene.fine
    values = _sample(scene.fine_appearance, (x + 0.5) * f - 0.5, (y + 0.5) * f - 0.5)
    return np.asarray(cv2.resize(values, camera.size, interpolation=cv2.INTER_AREA))


def _interpolate(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Interpolate a grid at all combinations of rows and columns by a cubic spline."""
    spline = RectBivariateSpline(np.arange(values.shape[0]), np.arange(values.shape[1]), values)
    return np.asarray(spline(rows, columns))


def _sample(raster: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate a raster bilinearly at columns x and rows y."""
    return cv2.remap(
        raster, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def make_image(
    scene: Scene,
    camera: CameraModel,
    position: np.ndarray,
    attitude: Rotation,
    position_error: np.ndarray | None = None,
    attitude_error_rad: np.ndarray | None = None,
    time_s: float = 0.0,
) -> PosedImage:
    """Create an image of the scene with an estimated pose: the true pose with errors of position and attitude added."""
    radiance = trace_image(scene, camera, position, attitude)
    estimate = position if position_error is None else position + position_error
    turn = Rotation.identity() if attitude_error_rad is None else Rotation.from_rotvec(attitude_error_rad)
    return PosedImage(radiance, camera, estimate, turn * attitude, time_s)


def solve_position(image: PosedImage, points: np.ndarray, measured_px: np.ndarray, steps: int = 4) -> np.ndarray:
    """Estimate the position from landmarks by least squares (Gauss-Newton); the attitude must be exact."""
    for _ in range(steps):
        camera = image.world_camera
        pixels, _ = camera.project(points)
        jacobian = -camera.projection_jacobian(points).reshape(-1, 3)
        step = np.linalg.lstsq(jacobian, (measured_px - pixels).ravel(), rcond=None)[0]
        image = replace(image, position_m=image.position_m + step)
    return image.position_m
