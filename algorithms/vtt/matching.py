"""Prediction of the target, magnification and roll (4.1, 4.3.1); template extraction and matching (4.3.2, 4.3.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Counts, Patch, Vector2, Vector3
from marsyard.algorithms.image.correlation import Peak, biquadratic_offset, coarse_to_fine_peak, normalized_correlation
from marsyard.algorithms.image.registration import SURROUND, Warp, build_spline, register_template, similarity_patch
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import SITE_FROM_WORLD, compose
from marsyard.sim.measurements import MastImage, RoverTarget, SiteTarget


@dataclass(frozen=True)
class Sighting:
    """The last stop with a match: start of the next update.

    The template is resampled from the image once magnification and roll are known: one interpolation only, at the
    target's sub-pixel position.

    - image: The left image
    - pixel: The target in it, full-frame (u, v)
    - position_head: The target in the mast head's frame at that stop, metres
    - camera: The left camera in that frame
    - world_from_head, world_from_rover: Estimated poses of head and rover at that stop
    """

    image: MastImage
    pixel: Vector2
    position_head: Vector3
    camera: CameraModel
    world_from_head: RigidTransform
    world_from_rover: RigidTransform

    @property
    def distance_m(self) -> float:
        """From the camera's centre to the target."""
        return float(np.linalg.norm(self.position_head - self.camera.c))

    @cached_property
    def azimuth_world_rad(self) -> float:
        """Direction from the camera to the target in the estimated world frame, clockwise from north."""
        return bearing_rad(self.world_from_head.as_matrix()[:3, :3] @ (self.position_head - self.camera.c))


@dataclass(frozen=True)
class Change:
    """Change of the target's appearance since the last match: magnification, and clockwise roll."""

    magnification: float = 1.0
    roll_rad: float = 0.0


@dataclass(frozen=True)
class Match:
    """The target in the new left image.

    - pixel: Full-frame (u, v)
    - score: Normalised correlation (Eq. 11) of the template with the image there
    - template: The old image about the target, magnified and rolled
    """

    pixel: Vector2
    score: float
    template: Patch


#: Registrations after the shift, in this order.
_WARPS: dict[Warp, tuple[Warp, ...]] = {"shift": (), "stretch": ("stretch",), "bend": ("stretch", "bend")}
#: Matches a sighting in a new image near a full-frame pixel; None if the window does not fit.
Matcher = Callable[[Sighting, MastImage, Vector2, Change, VttOptions], Match | None]


def cut_patch(
    image: MastImage, pixel: Vector2, side: int, change: Change | None = None
) -> Float[np.ndarray, "side side"]:
    """A square about a full-frame pixel, at its sub-pixel position, magnified and rolled by `change`."""
    applied = Change() if change is None else change
    # convert only the patch's diagonal and the spline's margin to floating point
    reach = int(np.ceil(0.75 * side / min(applied.magnification, 1.0))) + SURROUND + 1
    centre = pixel - np.array(image.corner, dtype=np.float64)
    near = np.maximum(np.floor(centre).astype(int) - reach, 0)
    region = image.counts[near[1] : max(int(centre[1]) + reach, 1), near[0] : max(int(centre[0]) + reach, 1)]
    return similarity_patch(region.astype(np.float64), centre - near, side, applied.magnification, applied.roll_rad)


def search_window(image: MastImage, pixel: Vector2, side: int) -> tuple[Counts, tuple[int, int]]:
    """The square of `side` pixels about a full-frame pixel, clipped to the image, and its corner in the frame."""
    near = np.rint(pixel - 0.5 * (side - 1)).astype(int) - np.array(image.corner)
    far = np.maximum(near + side, 0)
    near = np.maximum(near, 0)
    window = image.counts[near[1] : far[1], near[0] : far[0]]
    return window, (int(near[0]) + image.corner[0], int(near[1]) + image.corner[1])


def has_room(image: MastImage, pixel: Vector2, side: int) -> bool:
    """Whether a square of `side` pixels about a full-frame pixel lies in the image."""
    local = pixel - np.array(image.corner, dtype=np.float64)
    rows, columns = image.counts.shape
    reach = 0.5 * (side - 1)
    return bool(np.all(local >= reach) and np.all(local <= np.array([columns, rows]) - 1.0 - reach))


@dataclass(frozen=True)
class Refinement:
    """A sub-pixel match.

    - corner: Row and column of its upper left pixel in the image's counts
    - score: Normalised correlation of the shifted template
    - warped_score: Normalised correlation of the warped template
    """

    corner: Vector2
    score: float
    warped_score: float


def refine_match(
    template: Patch, image: MastImage, corner: Vector2, offset: Vector2, whole: Peak, options: VttOptions
) -> Refinement:
    """Refine a match by registration: a shift, then the stretch and bend of the options.

    `corner` is that of the best whole pixel, with the correlation of `whole`; `offset` is the top of the fit to the
    correlation, the result if registration fails. If the bend is not determined the stretch is kept, else the shift.
    """
    near = np.maximum(corner.astype(int) - SURROUND - 2, 0)
    far = corner.astype(int) + len(template) + SURROUND + 2
    region = image.counts[near[0] : far[0], near[1] : far[1]].astype(np.float64)
    part = build_spline(region, corner + offset - near, len(template))
    shifted = register_template(template, part, corner + offset - near, "shift")
    if shifted is None:
        return Refinement(corner + offset, whole.value, whole.value)
    best = shifted
    for warp in _WARPS[options.warp]:
        part = build_spline(region, best.corner, len(template), known=part)
        warped = register_template(template, part, best.corner, warp)
        if warped is None:
            break
        best = warped
    return Refinement(best.corner + near, shifted.score, best.score)


def match_by_correlation(
    sighting: Sighting, image: MastImage, predicted: Vector2, change: Change, options: VttOptions
) -> Match | None:
    """The paper's matcher: coarse-to-fine normalised correlation of the magnified, rolled template in a window."""
    template = cut_patch(sighting.image, sighting.pixel, options.template_px, change)
    counts, window_corner = search_window(image, predicted, options.search_px)
    if min(counts.shape) < options.template_px:
        return None
    window = counts.astype(np.float64)
    peak = coarse_to_fine_peak(template, window, options.coarse_levels, options.coarse_candidates)
    half = 0.5 * (options.template_px - 1)
    corner = np.array([peak.row, peak.column]) + np.array(window_corner[::-1], dtype=np.float64) - image.corner[::-1]
    best = Refinement(corner, peak.value, peak.value)
    if options.subpixel:
        offset = np.zeros(2)
        if not peak.on_border:
            row, column = peak.row - 1, peak.column - 1
            about = window[row : row + options.template_px + 2, column : column + options.template_px + 2]
            offset = biquadratic_offset(normalized_correlation(template, about), Peak(1, 1, peak.value, False))
        best = refine_match(template, image, corner, offset, peak, options)
    return Match(best.corner[::-1] + half + image.corner, best.score, template)


def designated_position_world(target: RoverTarget | SiteTarget, world_from_rover: RigidTransform) -> Vector3:
    """World position of a target designated by position; `world_from_rover` is the pose at designation."""
    if isinstance(target, RoverTarget):
        return np.asarray(world_from_rover.apply(target.position_rover.copy()))
    return np.asarray(SITE_FROM_WORLD.inv().apply(target.position_site.copy()))


def pose_change(old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform) -> RigidTransform:
    """The transform from the old frame into the new frame."""
    return compose(new_world_from_frame.inv(), old_world_from_frame)


def predicted_position(
    position: Vector3, old_world_from_frame: RigidTransform, new_world_from_frame: RigidTransform
) -> Vector3:
    """Position of a static point in a frame that moved (rover or mast head), from its old position there."""
    return np.asarray(pose_change(old_world_from_frame, new_world_from_frame).apply(position.copy()))


def bearing_rad(direction_world: Vector3) -> float:
    """Azimuth of a direction, clockwise from north, radians in (-pi, pi]."""
    return float(np.arctan2(direction_world[0], direction_world[1]))


def magnification(old_position: Vector3, old_centre: Vector3, new_position: Vector3, new_centre: Vector3) -> float:
    """Scale factor, Eq. 6: the target's old distance from the camera over its new one.

    Positions and camera centres are each in the rover frame of their own stop.
    """
    return float(np.linalg.norm(old_position - old_centre) / np.linalg.norm(new_position - new_centre))


def horizontal_axis(camera: CameraModel) -> Vector3:
    """Unit vector Hx along the image's x axis, Eqs. 7 to 9; A and H need not be perpendicular."""
    hs = np.linalg.norm(np.cross(camera.a, camera.h))
    hc = camera.a @ camera.h
    return np.asarray((camera.h - hc * camera.a) / hs)


def lever_pixels(
    old_position: Vector3,
    old_camera: CameraModel,
    new_camera: CameraModel,
    new_from_old: RigidTransform,
    lever_m: float,
) -> Float[np.ndarray, "2 2"] | None:
    """Pixels (u, v) in the new image of the target and of a point `lever_m` along the old image's x axis (before Eq.
    10).

    Each camera is in the frame of its own stop. None if the new camera cannot image one of the points.
    """
    points = np.stack([old_position, old_position + lever_m * horizontal_axis(old_camera)])
    pixels, visible = new_camera.project(np.asarray(new_from_old.apply(points)))
    return pixels if np.all(visible) else None


def roll_angle(lever_px: Float[np.ndarray, "2 2"]) -> float:
    """Clockwise roll of the target's image, radians, from `lever_pixels`: Eq. 10 and the text after it."""
    across, down = lever_px[1] - lever_px[0]
    return float(np.arctan2(down, across))
