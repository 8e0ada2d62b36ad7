"""Textured relief seen through CAHVOR cameras: the ray of each pixel is intersected with the ground. The formula of
the relief gives the ground; no epipolar geometry is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import fft, ndimage
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorCalibration, DetectorImage, LandingMeasurements, PoseMeasurement

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]

#: The XC-55's angle of view (6 mm, 640 x 480 pixels of 7.4 um) with barrel distortion of several pixels in the corners.
TEXEL_M = 0.01
TEXELS = 2048


@cache
def camera(columns: int = 320) -> Cahvor:
    """Camera 0.3 m in front of the origin of the body that looks straight down; image right is body right (-y)."""
    size = (columns, columns * 3 // 4)
    linear = Cahv.from_focal_length(
        0.006, 7.4e-6 * 640 / columns, size, axis=(0.0, 0.0, -1.0), right=(0.0, -1.0, 0.0), centre=(0.3, 0.0, -0.1)
    )
    return Cahvor.from_cahv(linear, r=(0.0, -0.05, 0.01))


@cache
def texture() -> np.ndarray:
    """Spline coefficients of a periodic texture of mean 1: detail from 3 cm (below a pixel's 2.5 cm pair) to metres."""
    rng = np.random.default_rng(7)
    frequency = np.hypot(*np.meshgrid(fft.fftfreq(TEXELS), fft.rfftfreq(TEXELS), indexing="ij"))
    frequency[0, 0] = np.inf
    shape = frequency**-1.0 * np.exp(-((frequency / 0.12) ** 2))
    values = fft.irfft2(shape * fft.rfft2(rng.standard_normal((TEXELS, TEXELS))), (TEXELS, TEXELS))
    return ndimage.spline_filter(1.0 + 0.2 * values / values.std(), order=3, mode="grid-wrap")


def brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    positions = np.stack([y.ravel(), x.ravel()]) / TEXEL_M
    return ndimage.map_coordinates(texture(), positions, order=3, mode="grid-wrap", prefilter=False).reshape(x.shape)


def plane(slope_x: float = 0.0, slope_y: float = 0.0) -> Height:
    return lambda x, y: slope_x * x + slope_y * y


def make_bumps(*each: tuple[float, float, float, float], base: Height | None = None) -> Height:
    """Smooth bumps (x, y, height, radius) on a base: Gaussians of this standard deviation."""
    under = plane() if base is None else base

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        z = under(x, y)
        for cx, cy, top, radius in each:
            z = z + top * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * radius**2))
        return z

    return height


def ground_along(height: Height, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Intersections of rays with the relief, by marching to within one step and bisection; shape of the rays."""
    far = (origin[2] + 2.0) / -rays[..., 2]
    near = np.maximum((origin[2] - 3.0) / -rays[..., 2], 0.0)
    steps = 24
    low, high = near.copy(), far.copy()
    result = np.zeros(near.shape, dtype=bool)
    for n in range(1, steps + 1):
        s = near + (far - near) * n / steps
        p = origin + s[..., None] * rays
        under = ~result & (p[..., 2] <= height(p[..., 0], p[..., 1]))
        low = np.where(under, s - (far - near) / steps, low)
        high = np.where(under, s, high)
        result |= under
    # Regula falsi converges fast on smooth relief; bisection guards it.
    for n in range(30):
        a = origin + low[..., None] * rays
        b = origin + high[..., None] * rays
        fa = a[..., 2] - height(a[..., 0], a[..., 1])
        fb = b[..., 2] - height(b[..., 0], b[..., 1])
        if n % 3 == 2 or np.any(fa == fb):
            s = 0.5 * (low + high)
        else:
            s = low + (high - low) * np.clip(fa / (fa - fb), 0.0, 1.0)
        p = origin + s[..., None] * rays
        above = p[..., 2] > height(p[..., 0], p[..., 1])
        low, high = np.where(above, s, low), np.where(above, high, s)
        if n > 6 and float(np.max(np.abs(p[..., 2] - height(p[..., 0], p[..., 1])))) < 1e-7:
            break
    return np.asarray(origin + s[..., None] * rays)


@dataclass(frozen=True)
class Pass:
    """Two true poses of the body over a relief."""

    height: Height
    poses: tuple[RigidTransform, RigidTransform]
    columns: int = 320

    def camera(self, which: int) -> Cahvor:
        """The camera in the world."""
        return camera(self.columns).transform(self.poses[which])

    def ground(self, which: int, pixels: np.ndarray) -> np.ndarray:
        """Points of the relief at pixels."""
        one = self.camera(which)
        _, rays = one.rays(pixels)
        return ground_along(self.height, np.array(one.c), rays)

    @property
    def slant_range_m(self) -> float:
        """Distance to the ground from the first camera along its optical axis."""
        one = self.camera(0)
        point = ground_along(self.height, np.array(one.c), np.array(one.a)[None])[0]
        return float(np.linalg.norm(point - one.c))

    @property
    def second_from_first(self) -> RigidTransform:
        """True motion between the camera frames (z along A, x along columns)."""
        first, second = (rigid(_axes(self.camera(i)), np.array(self.camera(i).c)) for i in (0, 1))
        return second.inv() * first


def _axes(one: Cahvor) -> Rotation:
    return Rotation.from_matrix(np.column_stack([one.right, np.cross(one.a, one.right), one.a]))


def pose(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> RigidTransform:
    """Pose of a body, angles in degrees."""
    return rigid(Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True), np.array([x, y, z]))


def render_image(
    flown: Pass, which: int, noise: np.random.Generator | None = None, paint: Callable[..., np.ndarray] = brightness
) -> DetectorImage:
    """A 12-bit picture, 1500 counts for brightness 1; noise of 8 counts."""
    points = flown.ground(which, camera(flown.columns).pixel_grid())
    counts = 1500.0 * paint(points[..., 0], points[..., 1])
    if noise is not None:
        counts = counts + noise.normal(0.0, 8.0, counts.shape)
    known = DetectorCalibration(np.ones(counts.shape), 0.001, 0.0, 0.0, 1, 0.0, 4095)
    delivered = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
    return DetectorImage(delivered, float(which), camera(flown.columns), known)


def measure_pass(flown: Pass, noise: np.random.Generator | None = None) -> LandingMeasurements:
    """Exact measurements of a pass; the a-priori site is the ground below the first pose."""
    below = np.array(flown.poses[0].translation)
    below[2] = float(flown.height(below[0], below[1]))
    return LandingMeasurements(
        images=(render_image(flown, 0, noise), render_image(flown, 1, noise)),
        poses=(PoseMeasurement(flown.poses[0], 0.0), PoseMeasurement(flown.poses[1], 1.0)),
        slant_range_m=flown.slant_range_m,
        up_body=flown.poses[0].rotation.inv().apply([0.0, 0.0, 1.0]),
        apriori_site_world=below,
    )
