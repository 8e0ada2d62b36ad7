"""Subpixel motion of rendered images compared with the motion of the camera; detects aliasing.

The camera moves sideways so that the image centre moves by 0.0, 0.1 ... 1.0 pixel along the columns. The true motion of
each pixel is the projection of its world point by the moved camera. Patches with occluding edges are excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.validation.estimators import HALF, MARGIN, PATCH, SmoothPicture, peak_fits, symmetric_shifts
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, PixelRays, Renderer, Scene

STEPS_PX = np.linspace(0.0, 1.0, 11)
#: Maximum relative difference of the motions within a patch; larger values mark an edge.
MAX_SPREAD = 0.1
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

    def transform(self, offset_world_m: np.ndarray) -> View:
        """The same view from a shifted position."""
        pose = rigid(self.world_from_body.rotation, self.world_from_body.translation + offset_world_m)
        return replace(self, world_from_body=pose)

    def rays(self, camera: CameraModel) -> PixelRays:
        """Rays of the camera or of a part of it."""
        rays = PixelRays.of(camera)
        return replace(rays, pixel_angles=np.float32(self.footprint) * rays.pixel_angles)


@dataclass(frozen=True)
class Motion:
    """Errors of one step, (u, v) of each patch, shape (patches, 2).

    Attributes
    ----------
    step_px
        Motion of the image centre.
    error, parabola, biquadratic
        Motion by symmetric Gauss-Newton estimation and by fits to the correlation peak, minus the true motion.
    body
        Body of each patch: number of the body, -1 for the ground, or `MIXED`.
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


#: Side in samples of the parts in which an oversampled image is rendered.
PIECE = 1024


def supersample(renderer: Renderer, view: View, samples: int) -> np.ndarray:
    """Mean over samples x samples rays in each pixel; the footprint of each ray is its part of the pixel."""
    fine = view.camera.scale(samples)
    columns, rows = view.camera.size
    step = PIECE // samples
    picture = np.empty((rows, columns))
    for row in range(0, rows, step):
        for column in range(0, columns, step):
            size = (min(step, columns - column), min(step, rows - row))
            part = fine.crop(column * samples, row * samples, (size[0] * samples, size[1] * samples))
            radiance = renderer.render(view.scene, view.rays(part), view.world_from_body).radiance
            blocks = radiance.reshape(size[1], samples, size[0], samples)
            picture[row : row + size[1], column : column + size[0]] = blocks.mean(axis=(1, 3), dtype=np.float64)
    return picture


def sideways(view: View, frame: Frame) -> np.ndarray:
    """World offset that moves the image centre by one pixel along the columns."""
    rows, columns = frame.range_m.shape
    middle = (slice(rows // 2 - HALF, rows // 2 + HALF + 1), slice(columns // 2 - HALF, columns // 2 + HALF + 1))
    distance = float(np.median(frame.range_m[middle]))
    right = view.world_from_body.rotation.apply(view.camera.right)
    return -right * distance / view.camera.focal_lengths[0]


def true_motion(frame: Frame, view: View, other: View) -> np.ndarray:
    """Motion (u, v) of every pixel's point between two views; NaN in the sky and for invisible points."""
    points = frame.points_world()
    camera = view.camera.transform(other.world_from_body)
    pixels, _ = camera.project(points)
    # the difference of two projections is more accurate than the pixel position of a ray in single precision (1e-4 px)
    here, _ = view.camera.transform(view.world_from_body).project(points)
    return pixels - here


def _windows(values: np.ndarray, centres: np.ndarray) -> np.ndarray:
    reach = np.arange(-HALF, HALF + 1)
    return values[(centres[:, 1, None] + reach)[:, :, None], (centres[:, 0, None] + reach)[:, None, :]]


def patch_grid(size: tuple[int, int], stride: int = PATCH) -> np.ndarray:
    """Centres (u, v) of a grid of patches."""
    u = np.arange(MARGIN, size[0] - MARGIN, stride)
    v = np.arange(MARGIN, size[1] - MARGIN, stride)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _whole_patches(motion: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Select patches with nearly uniform motion."""
    windows = _windows(motion, centres)
    spread = np.ptp(windows, axis=(1, 2)).max(axis=-1)
    alike = spread <= MAX_SPREAD * np.linalg.norm(windows, axis=-1).max(axis=(1, 2))
    return centres[alike]


def measure(
    renderer: Renderer, view: View, steps: np.ndarray = STEPS_PX, samples: int = 1, stride: int = PATCH
) -> Iterator[Motion]:
    """Yield the errors of the measured motion for each step."""
    first = render(renderer, view, samples)
    unit = sideways(view, first)
    first_smooth = SmoothPicture(first.radiance)
    one_pixel = true_motion(first, view, view.transform(unit))
    centres = _whole_patches(one_pixel, patch_grid(view.camera.size, stride))
    for step in steps:
        other = view.transform(step * unit)
        second = render(renderer, other, samples)
        shifts = symmetric_shifts(first_smooth, SmoothPicture(second.radiance), centres)
        # motion relative to the midpoint of both images, as in the estimator
        ahead, back = true_motion(first, view, other), true_motion(second, other, view)
        seen_from_both = ~np.isnan(_windows(ahead - back, centres)).any(axis=(1, 2, 3))
        motion = 0.5 * (_windows(ahead, centres) - _windows(back, centres))
        mean_ahead = _windows(ahead, centres).mean(axis=(1, 2))
        parabola, biquadratic = peak_fits(first.radiance, second.radiance, centres)
        yield Motion(
            float(step),
            (shifts.found - shifts.expected(motion))[seen_from_both],
            (parabola - mean_ahead)[seen_from_both],
            (biquadratic - mean_ahead)[seen_from_both],
            _shown_requirement(_windows(first.body, centres))[seen_from_both],
        )


def _shown_requirement(bodies: np.ndarray) -> np.ndarray:
    """Body of each patch, or `MIXED`."""
    lowest, highest = bodies.min(axis=(1, 2)), bodies.max(axis=(1, 2))
    return np.where(lowest == highest, lowest, MIXED)
