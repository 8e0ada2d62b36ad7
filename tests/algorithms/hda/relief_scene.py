"""Synthetic landing images for hazard-detection tests: textured relief seen by a CAHVOR camera at two poses.

The ray of each pixel is intersected with an analytic height function. No epipolar geometry is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import fft, ndimage
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorCalibration, DetectorImage, LandingMeasurements, PoseMeasurement

#: Height of the ground, metres, at world positions x and y, metres.
Height = Callable[[np.ndarray, np.ndarray], np.ndarray]

TEXEL_M = 0.01  #: Size of a texture cell, metres.
TEXELS = 2048  #: Cells along each side of the texture.


@cache
def make_camera(columns: int = 320) -> Cahvor:
    """Create a camera 0.3 m in front of the body origin that looks straight down; image right is body right (-y).

    It has the field of view of the XC-55 (6 mm, 640 x 480 pixels of 7.4 um), and a barrel distortion of several pixels
    in the corners.
    """
    size = (columns, columns * 3 // 4)
    linear = Cahv.from_focal_length(
        0.006, 7.4e-6 * 640 / columns, size, axis=(0.0, 0.0, -1.0), right=(0.0, -1.0, 0.0), centre=(0.3, 0.0, -0.1)
    )
    return Cahvor.from_cahv(linear, r=(0.0, -0.05, 0.01))


@cache
def make_texture() -> np.ndarray:
    """Create the spline coefficients of a periodic texture of mean 1, with details of 3 cm to metres.

    A pixel of the images is 2.5 cm on the ground.
    """
    rng = np.random.default_rng(7)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(TEXELS), fft.rfftfreq(TEXELS), indexing="ij"))
    frequency[0, 0] = np.inf
    amplitude = frequency**-1.0 * np.exp(-((frequency / 0.12) ** 2))
    values = fft.irfft2(amplitude * fft.rfft2(rng.standard_normal((TEXELS, TEXELS))), (TEXELS, TEXELS))
    return ndimage.spline_filter(1.0 + 0.2 * values / values.std(), order=3, mode="grid-wrap")


def brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Evaluate the texture at world positions, metres."""
    positions = np.stack([y.ravel(), x.ravel()]) / TEXEL_M
    return ndimage.map_coordinates(make_texture(), positions, order=3, mode="grid-wrap", prefilter=False).reshape(
        x.shape
    )


def make_plane(slope_x: float = 0.0, slope_y: float = 0.0) -> Height:
    """Create the height function of a plane through the origin."""
    return lambda x, y: slope_x * x + slope_y * y


def make_bumps(*bumps: tuple[float, float, float, float], base: Height | None = None) -> Height:
    """Create the height function of Gaussian bumps (x, y, height, standard deviation) on a base, metres."""
    base_height = make_plane() if base is None else base

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        z = base_height(x, y)
        for cx, cy, top, radius in bumps:
            z = z + top * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * radius**2))
        return z

    return height


def intersect_relief(height: Height, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Intersect rays with the relief: march to the first step below ground, then refine.

    Return points with the shape of `rays`. The distances first, last, low, high and distance are along the rays, in
    metres. The relief must be between the heights -2 m and 3 m.
    """
    last = (origin[2] + 2.0) / -rays[..., 2]
    first = np.maximum((origin[2] - 3.0) / -rays[..., 2], 0.0)
    steps = 24
    low, high = first.copy(), last.copy()
    has_hit = np.zeros(first.shape, dtype=bool)
    for n in range(1, steps + 1):
        distance = first + (last - first) * n / steps
        points = origin + distance[..., None] * rays
        is_below = ~has_hit & (points[..., 2] <= height(points[..., 0], points[..., 1]))
        low = np.where(is_below, distance - (last - first) / steps, low)
        high = np.where(is_below, distance, high)
        has_hit |= is_below
    # Regula falsi converges fast on smooth relief; every third step is a bisection.
    for n in range(30):
        low_points = origin + low[..., None] * rays
        high_points = origin + high[..., None] * rays
        low_residual = low_points[..., 2] - height(low_points[..., 0], low_points[..., 1])
        high_residual = high_points[..., 2] - height(high_points[..., 0], high_points[..., 1])
        if n % 3 == 2 or np.any(low_residual == high_residual):
            distance = 0.5 * (low + high)
        else:
            distance = low + (high - low) * np.clip(low_residual / (low_residual - high_residual), 0.0, 1.0)
        points = origin + distance[..., None] * rays
        is_above = points[..., 2] > height(points[..., 0], points[..., 1])
        low, high = np.where(is_above, distance, low), np.where(is_above, high, distance)
        if n > 6 and float(np.max(np.abs(points[..., 2] - height(points[..., 0], points[..., 1])))) < 1e-7:
            break
    return np.asarray(origin + distance[..., None] * rays)


@dataclass(frozen=True)
class Pass:
    """A pass of the lander over relief: true poses of the body at two images.

    - height: height function of the ground
    - columns: width of the images, pixels
    """

    height: Height
    poses: tuple[RigidTransform, RigidTransform]
    columns: int = 320

    def camera(self, index: int) -> Cahvor:
        """Return the camera in world axes."""
        return make_camera(self.columns).transform(self.poses[index])

    def ground(self, index: int, pixels: np.ndarray) -> np.ndarray:
        """Compute the points of the relief at pixels of an image, world axes."""
        model = self.camera(index)
        _, rays = model.rays(pixels)
        return intersect_relief(self.height, np.array(model.c), rays)

    @property
    def slant_range_m(self) -> float:
        """Distance to the ground from the first camera along its optical axis."""
        model = self.camera(0)
        point = intersect_relief(self.height, np.array(model.c), np.array(model.a)[None])[0]
        return float(np.linalg.norm(point - model.c))

    @property
    def second_from_first(self) -> RigidTransform:
        """True motion between the camera frames (z along A, x along columns)."""
        first, second = (rigid(_camera_rotation(self.camera(i)), np.array(self.camera(i).c)) for i in (0, 1))
        return second.inv() * first


def _camera_rotation(model: Cahvor) -> Rotation:
    """Return the rotation from camera axes (x along columns, z along A) to world axes."""
    return Rotation.from_matrix(np.column_stack([model.right, np.cross(model.a, model.right), model.a]))


def make_pose(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> RigidTransform:
    """Create the pose of a body from its position, metres, and angles, degrees."""
    return rigid(Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True), np.array([x, y, z]))


def render_image(
    scene: Pass, index: int, noise: np.random.Generator | None = None, albedo: Callable[..., np.ndarray] = brightness
) -> DetectorImage:
    """Render image 0 or 1, 12 bits: 1500 counts for brightness 1, with optional noise of 8 counts (1 sigma)."""
    points = scene.ground(index, make_camera(scene.columns).pixel_grid())
    counts = 1500.0 * albedo(points[..., 0], points[..., 1])
    if noise is not None:
        counts = counts + noise.normal(0.0, 8.0, counts.shape)
    calibration = DetectorCalibration(np.ones(counts.shape), 0.001, 0.0, 0.0, 1, 0.0, 4095)
    rounded = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
    return DetectorImage(rounded, float(index), make_camera(scene.columns), calibration)


def measure_pass(scene: Pass, noise: np.random.Generator | None = None) -> LandingMeasurements:
    """Create exact measurements of a pass; the a-priori site is the ground below the first pose."""
    site = np.array(scene.poses[0].translation)
    site[2] = float(scene.height(site[0], site[1]))
    return LandingMeasurements(
        images=(render_image(scene, 0, noise), render_image(scene, 1, noise)),
        poses=(PoseMeasurement(scene.poses[0], 0.0), PoseMeasurement(scene.poses[1], 1.0)),
        slant_range_m=scene.slant_range_m,
        up_body=scene.poses[0].rotation.inv().apply([0.0, 0.0, 1.0]),
        apriori_site_world=site,
    )
