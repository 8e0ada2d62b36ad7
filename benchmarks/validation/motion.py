"""Does a picture move as the camera does? What aliases, pops or swims moves by something else.

The camera is moved sideways so that the picture's middle moves by 0.0, 0.1 ... 1.0 pixel along its columns. Where each
pixel's point should be found is known from the truth: the world point that it sees, projected by the moved camera.
Patches that hold the edge of something before something else are left out: what an edge hides is no motion.
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
#: Motions within a patch may differ by this fraction of the motion; otherwise it contains an edge.
MAX_SPREAD = 0.1
#: Patches that show more than one body.
MIXED = -3


@dataclass(frozen=True)
class View:
    """A scene, a camera in the body frame, and where the body is.

    `footprint` is the part of a pixel over which the renderer averages ground and texture: 1, or almost 0
    for point samples.
    """

    scene: Scene
    camera: CameraModel
    world_from_body: RigidTransform
    footprint: float = 1.0

    def moved(self, offset_world_m: np.ndarray) -> View:
        """The same seen from elsewhere."""
        pose = rigid(self.world_from_body.rotation, self.world_from_body.translation + offset_world_m)
        return replace(self, world_from_body=pose)

    def rays(self, camera: CameraModel) -> PixelRays:
        """Rays of the view's camera, or of a part of it."""
        rays = PixelRays.of(camera)
        return replace(rays, pixel_angles=np.float32(self.footprint) * rays.pixel_angles)


@dataclass(frozen=True)
class Motion:
    """Errors of one step, (u, v) of each patch, shape (patches, 2).

    Attributes
    ----------
    step_px
        By how much the picture's middle moved.
    error, parabola, biquadratic
        Motion found by symmetric Gauss-Newton and by fits to the correlation's peak, less the true motion.
    body
        What each patch shows: a body's number, the ground's (-1), or `MIXED`.
    """

    step_px: float
    error: np.ndarray
    parabola: np.ndarray
    biquadratic: np.ndarray
    body: np.ndarray


def render(renderer: Renderer, view: View, samples: int = 1) -> Frame:
    """The view's picture; with `samples` > 1 only its radiance is the mean of samples x samples in each pixel."""
    rays = view.rays(view.camera)
    frame = renderer.render(view.scene, rays, view.world_from_body)
    if samples == 1:
        return frame
    return Frame(
        supersampled(renderer, view, samples), frame.range_m, frame.body, frame.normal, frame.world_from_body, rays
    )


#: Side in samples of the pieces in which an oversampled picture is rendered.
PIECE = 1024


def supersampled(renderer: Renderer, view: View, samples: int) -> np.ndarray:
    """Mean over samples x samples rays in each pixel, each ray seeing as fine as its own share of the pixel."""
    fine = view.camera.scaled(samples)
    columns, rows = view.camera.size
    step = PIECE // samples
    picture = np.empty((rows, columns))
    for row in range(0, rows, step):
        for column in range(0, columns, step):
            size = (min(step, columns - column), min(step, rows - row))
            part = fine.cropped(column * samples, row * samples, (size[0] * samples, size[1] * samples))
            radiance = renderer.render(view.scene, view.rays(part), view.world_from_body).radiance
            blocks = radiance.reshape(size[1], samples, size[0], samples)
            picture[row : row + size[1], column : column + size[0]] = blocks.mean(axis=(1, 3), dtype=np.float64)
    return picture


def sideways(view: View, frame: Frame) -> np.ndarray:
    """World offset that moves the picture's middle one pixel towards growing columns."""
    rows, columns = frame.range_m.shape
    middle = (slice(rows // 2 - HALF, rows // 2 + HALF + 1), slice(columns // 2 - HALF, columns // 2 + HALF + 1))
    distance = float(np.median(frame.range_m[middle]))
    right = view.world_from_body.rotation.apply(view.camera.right)
    return -right * distance / view.camera.focal_lengths[0]


def true_motion(frame: Frame, view: View, other: View) -> np.ndarray:
    """Motion (u, v) of every pixel's point from one view to another; NaN in the sky and where it is not seen."""
    points = frame.points_world()
    camera = view.camera.moved(other.world_from_body)
    pixels, _ = camera.project(points)
    # a pixel's own ray closes to 1e-4 px in single precision; the difference of two projections is better
    here, _ = view.camera.moved(view.world_from_body).project(points)
    return pixels - here


def _windows(values: np.ndarray, centres: np.ndarray) -> np.ndarray:
    reach = np.arange(-HALF, HALF + 1)
    return values[(centres[:, 1, None] + reach)[:, :, None], (centres[:, 0, None] + reach)[:, None, :]]


def patch_grid(size: tuple[int, int], stride: int = PATCH) -> np.ndarray:
    """Centres (u, v) of patches side by side."""
    u = np.arange(MARGIN, size[0] - MARGIN, stride)
    v = np.arange(MARGIN, size[1] - MARGIN, stride)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _whole_patches(motion: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The patches all of whose pixels move nearly alike."""
    windows = _windows(motion, centres)
    spread = np.ptp(windows, axis=(1, 2)).max(axis=-1)
    alike = spread <= MAX_SPREAD * np.linalg.norm(windows, axis=-1).max(axis=(1, 2))
    return centres[alike]


def measure(
    renderer: Renderer, view: View, steps: np.ndarray = STEPS_PX, samples: int = 1, stride: int = PATCH
) -> Iterator[Motion]:
    """Errors of the motion measured on pictures of the view, step by step."""
    first = render(renderer, view, samples)
    unit = sideways(view, first)
    first_smooth = SmoothPicture(first.radiance)
    one_pixel = true_motion(first, view, view.moved(unit))
    centres = _whole_patches(one_pixel, patch_grid(view.camera.size, stride))
    for step in steps:
        other = view.moved(step * unit)
        second = render(renderer, other, samples)
        shifts = symmetric_shifts(first_smooth, SmoothPicture(second.radiance), centres)
        # halfway between the two pictures, as the estimator sees it
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
            _shown(_windows(first.body, centres))[seen_from_both],
        )


def _shown(bodies: np.ndarray) -> np.ndarray:
    """The one body that each patch shows, or `MIXED`."""
    lowest, highest = bodies.min(axis=(1, 2)), bodies.max(axis=(1, 2))
    return np.where(lowest == highest, lowest, MIXED)
