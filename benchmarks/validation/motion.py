"""Measurement of the subpixel motion of rendered images, compared with the motion of the camera; detects aliasing.

The camera moves sideways so that the image centre moves by 0.0, 0.1 ... 1.0 pixel along the columns. The true motion of
each pixel is the projection of its world point by the moved camera. Patches with occluding edges are excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.validation.estimators import HALF, MARGIN, PATCH, SmoothImage, peak_fits, symmetric_shifts
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, PixelRays, Renderer, Scene

#: Motions of the image centre.
STEPS_PX = np.linspace(0.0, 1.0, 11)
#: Maximum relative difference of the motions within a patch; larger values mark an edge.
MAX_MOTION_RANGE = 0.1
#: Body number of patches that show more than one body.
MIXED = -3


@dataclass(frozen=True)
class View:
    """A scene, a camera in the body frame, and the pose of the body.

    `footprint` is the fraction of a pixel over which the renderer averages ground and texture: 1, or almost 0 for
    point samples.
    """

    scene: Scene
    camera: CameraModel
    world_from_body: RigidTransform
    footprint: float = 1.0

    def shift(self, offset_world_m: np.ndarray) -> View:
        """Return the same view from a shifted position."""
        pose = rigid(self.world_from_body.rotation, self.world_from_body.translation + offset_world_m)
        return replace(self, world_from_body=pose)

    def rays(self, camera: CameraModel) -> PixelRays:
        """Return the rays of the camera or of a part of its image."""
        rays = PixelRays.from_camera(camera)
        return replace(rays, pixel_angles=np.float32(self.footprint) * rays.pixel_angles)


@dataclass(frozen=True)
class Motion:
    """Errors of one step, (u, v) of each patch, shape (patches, 2).

    - step_px: motion of the image centre
    - error, parabola, biquadratic: motion by symmetric Gauss-Newton estimation and by fits to the correlation peak,
      minus the true motion
    - body: body of each patch: number of the body, -1 for the ground, or `MIXED`
    """

    step_px: float
    error: np.ndarray
    parabola: np.ndarray
    biquadratic: np.ndarray
    body: np.ndarray


def render(renderer: Renderer, view: View, samples: int = 1) -> Frame:
    """Render the view; with `samples` > 1, the radiance is the mean of samples x samples rays in each pixel."""
    rays = view.rays(view.camera)
    frame = renderer.render(view.scene, rays, view.world_from_body)
    if samples == 1:
        return frame
    return Frame(
        supersample(renderer, view, samples), frame.range_m, frame.body, frame.normal, frame.world_from_body, rays
    )


#: Side of the tiles in which an oversampled image is rendered, samples.
TILE_SIDE = 1024


def supersample(renderer: Renderer, view: View, samples: int) -> np.ndarray:
    """Render the mean of samples x samples rays in each pixel; the footprint of each ray is its part of the pixel."""
    fine = view.camera.scale(samples)
    columns, rows = view.camera.size
    step = TILE_SIDE // samples
    image = np.empty((rows, columns))
    for row in range(0, rows, step):
        for column in range(0, columns, step):
            size = (min(step, columns - column), min(step, rows - row))
            tile = fine.crop(column * samples, row * samples, (size[0] * samples, size[1] * samples))
            radiance = renderer.render(view.scene, view.rays(tile), view.world_from_body).radiance
            blocks = radiance.reshape(size[1], samples, size[0], samples)
            image[row : row + size[1], column : column + size[0]] = blocks.mean(axis=(1, 3), dtype=np.float64)
    return image


def compute_sideways_offset(view: View, frame: Frame) -> np.ndarray:
    """Compute the world offset of the camera that moves the image centre by one pixel along u."""
    rows, columns = frame.range_m.shape
    central_patch = (slice(rows // 2 - HALF, rows // 2 + HALF + 1), slice(columns // 2 - HALF, columns // 2 + HALF + 1))
    distance = float(np.median(frame.range_m[central_patch]))
    right = view.world_from_body.rotation.apply(view.camera.right)
    return -right * distance / view.camera.focal_lengths[0]


def compute_true_motion(frame: Frame, view: View, target: View) -> np.ndarray:
    """Motion (u, v) of every pixel's point between two views; NaN in the sky and for invisible points."""
    points = frame.points_world()
    camera = view.camera.transform(target.world_from_body)
    pixels, _ = camera.project(points)
    # the difference of two projections is more accurate than the pixel position of a ray in single precision (1e-4 px)
    original_pixels, _ = view.camera.transform(view.world_from_body).project(points)
    return pixels - original_pixels


def _extract_patches(values: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Extract the patches around `centres` (u, v), shape (n, PATCH, PATCH, ...)."""
    offsets = np.arange(-HALF, HALF + 1)
    return values[(centres[:, 1, None] + offsets)[:, :, None], (centres[:, 0, None] + offsets)[:, None, :]]


def patch_grid(size: tuple[int, int], stride: int = PATCH) -> np.ndarray:
    """Centres (u, v) of a grid of patches."""
    u = np.arange(MARGIN, size[0] - MARGIN, stride)
    v = np.arange(MARGIN, size[1] - MARGIN, stride)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _select_patches(motion: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Select patches with nearly uniform motion, which contain no occluding edge."""
    patches = _extract_patches(motion, centres)
    motion_range = np.ptp(patches, axis=(1, 2)).max(axis=-1)
    is_uniform = motion_range <= MAX_MOTION_RANGE * np.linalg.norm(patches, axis=-1).max(axis=(1, 2))
    return centres[is_uniform]


def measure(
    renderer: Renderer, view: View, steps: np.ndarray = STEPS_PX, samples: int = 1, stride: int = PATCH
) -> Iterator[Motion]:
    """Yield the errors of the measured motion for each step."""
    first = render(renderer, view, samples)
    offset_per_px_m = compute_sideways_offset(view, first)
    first_smooth = SmoothImage(first.radiance)
    one_pixel = compute_true_motion(first, view, view.shift(offset_per_px_m))
    centres = _select_patches(one_pixel, patch_grid(view.camera.size, stride))
    for step in steps:
        shifted_view = view.shift(step * offset_per_px_m)
        second = render(renderer, shifted_view, samples)
        shifts = symmetric_shifts(first_smooth, SmoothImage(second.radiance), centres)
        # motion relative to the midpoint of both images, as in the estimator
        forward = compute_true_motion(first, view, shifted_view)
        backward = compute_true_motion(second, shifted_view, view)
        is_visible_in_both = ~np.isnan(_extract_patches(forward - backward, centres)).any(axis=(1, 2, 3))
        motion = 0.5 * (_extract_patches(forward, centres) - _extract_patches(backward, centres))
        mean_forward = _extract_patches(forward, centres).mean(axis=(1, 2))
        parabola, biquadratic = peak_fits(first.radiance, second.radiance, centres)
        yield Motion(
            float(step),
            (shifts.motion_px - shifts.expected(motion))[is_visible_in_both],
            (parabola - mean_forward)[is_visible_in_both],
            (biquadratic - mean_forward)[is_visible_in_both],
            _find_patch_bodies(_extract_patches(first.body, centres))[is_visible_in_both],
        )


def _find_patch_bodies(bodies: np.ndarray) -> np.ndarray:
    """Body of each patch, or `MIXED`."""
    lowest, highest = bodies.min(axis=(1, 2)), bodies.max(axis=(1, 2))
    return np.where(lowest == highest, lowest, MIXED)
