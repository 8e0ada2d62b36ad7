"""Baselines from OpenCV: essential matrix for motion, semi-global matching for structure.

All other stages are shared with the algorithm under test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda.estimator import find_site, matched_structure
from marsyard.algorithms.hda.motion import (
    LandingScene,
    Motion,
    Views,
    assess_motion,
    build_scene,
    points_at_depth,
    project_points,
    undistort,
)
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.structure import Fate, Matches, depth_bounds, epipolar_segments, pixel_lattice, triangulate
from marsyard.algorithms.hda.tracking import Tracks
from marsyard.algorithms.interface import SiteEstimate
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements

#: Confidence of the search for an essential matrix.
CONFIDENCE = 0.9999
#: Methods and inlier distances, pixels. Two motions explain a plane; each method sometimes returns the wrong one, which
#: puts most tracks behind a camera.
ATTEMPTS = ((cv2.LMEDS, 1.0), (cv2.RANSAC, 0.1), (cv2.RANSAC, 0.3), (cv2.RANSAC, 1.0), (cv2.USAC_PROSAC, 0.1))
#: Window of the semi-global matching, pixels, and the penalties of disparity steps recommended by OpenCV.
BLOCK_PX = 5
SMALL_STEP, LARGE_STEP = 8 * BLOCK_PX**2, 32 * BLOCK_PX**2
#: OpenCV requires the number of disparities to be a multiple of this.
DISPARITY_STEP = 16
#: OpenCV's unit of disparity, pixels.
DISPARITY_UNIT = 1.0 / 16.0
#: Largest cosine between the baseline and the mean optical axis.
MAX_BASELINE_COSINE = 0.8
#: Largest side of a rectified image, in diagonals of the original images.
MAX_SIDE_DIAGONALS = 2.0


@final
class EssentialMatrixEstimator:
    """Motion from OpenCV's essential matrix, structure as in `HdaEstimator`."""

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The estimate; details and errors are those of `HdaEstimator.estimate`."""
        return find_site(build_scene(measurements), essential_motion, matched_structure, self.options)


@final
class SemiGlobalEstimator:
    """Motion from OpenCV's essential matrix, structure from its semi-global matching of the rectified images."""

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The estimate; details and errors are those of `HdaEstimator.estimate`."""
        return find_site(build_scene(measurements), essential_motion, semi_global_structure, self.options)


def essential_motion(scene: LandingScene, tracks: Tracks, options: HdaOptions) -> Motion | None:
    """The essential matrix motion with most tracks in front of both cameras; None without any.

    Its scale makes the median depth equal the range.
    """
    focal = scene.views[1].focal_px
    accepted = (tracks.first[tracks.accepted], tracks.second[tracks.accepted])
    first, second = (undistort(one.camera, pixels) for one, pixels in zip(scene.views, accepted, strict=True))
    intrinsics = np.diag([focal, focal, 1.0])
    poses = []
    for method, inlier_px in ATTEMPTS:
        pixels = focal * first, focal * second
        matrix, agreeing = cv2.findEssentialMat(*pixels, intrinsics, method, CONFIDENCE, inlier_px)
        if matrix is not None and matrix.shape == (3, 3) and np.all(np.isfinite(matrix)):
            poses.append(cv2.recoverPose(matrix, *pixels, intrinsics, mask=agreeing)[:3])
    if not poses:
        return None
    _, rotation, translation = max(poses, key=lambda pose: pose[0])
    moved = rigid(Rotation.from_matrix(rotation), translation.ravel())
    depths = triangulate(first, second, moved)
    depths[~(np.abs(depths) > 0.0)] = np.inf
    ahead = depths[np.isfinite(depths) & (depths > 0.0)]
    if len(ahead) == 0:
        return None
    motion = assess_motion(first, second, focal, moved, depths, True, options)
    return motion.scale(scene.range_m / float(np.median(ahead)))


@dataclass(frozen=True)
class Rectification:
    """A pair of linear cameras with parallel axes and columns along the baseline.

    - rectified_from_first: From the first camera's frame to the rectified one, with the same origin
    - baseline_m: Distance between the cameras
    - camera: The camera of both rectified images
    """

    rectified_from_first: Rotation
    baseline_m: float
    camera: Cahv

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return self.camera.focal_lengths[0]


def rectify_views(views: Views, second_from_first: RigidTransform) -> Rectification | None:
    """The rectification of a pair; None for motion along the optical axis."""
    first_from_second = second_from_first.inv()
    baseline = float(np.linalg.norm(first_from_second.translation))
    along = first_from_second.translation / baseline
    axis = np.array([0.0, 0.0, 1.0]) + first_from_second.rotation.apply(np.array([0.0, 0.0, 1.0]))
    axis /= np.linalg.norm(axis)
    if abs(float(along @ axis)) > MAX_BASELINE_COSINE:
        return None
    axis -= (along @ axis) * along
    axis /= np.linalg.norm(axis)
    turn = Rotation.from_matrix(np.stack([along, np.cross(axis, along), axis]))
    focal = views[0].focal_px
    borders = [
        turn.apply(rotation.apply(one.camera.rays(one.camera.border(16))[1]))
        for one, rotation in zip(views, (Rotation.identity(), first_from_second.rotation), strict=True)
    ]
    edges = np.concatenate(borders)
    if np.any(edges[:, 2] <= 0.0):
        return None
    edges = focal * edges[:, :2] / edges[:, 2:]
    low, high = np.floor(edges.min(axis=0)), np.ceil(edges.max(axis=0))
    if float((high - low).max()) > MAX_SIDE_DIAGONALS * float(np.hypot(*views[0].camera.size)):
        return None
    camera = Cahv.from_axes(
        (focal, focal),
        (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1),
        axis=(0.0, 0.0, 1.0),
        right=(1.0, 0.0, 0.0),
        image_centre=(-float(low[0]), -float(low[1])),
    )
    return Rectification(turn, baseline, camera)


def match_disparities(
    views: Views, pair: Rectification, second_from_first: RigidTransform, bounds_m: tuple[float, float]
) -> Float[np.ndarray, "rows columns"]:
    """Disparities of the first rectified image by semi-global matching, pixels; NaN without a match."""
    first_from_rectified = pair.rectified_from_first.inv()
    full_scale = max(float(np.quantile(views[0].counts, 0.995)), 1.0)
    turns = (first_from_rectified, second_from_first.rotation * first_from_rectified)
    rays = pair.camera.rays(pair.camera.pixel_grid())[1].reshape(-1, 3)
    pictures = []
    for one, turn in zip(views, turns, strict=True):
        # in 8 bits; black outside the field of view
        pixels = np.nan_to_num(one.camera.project(turn.apply(rays))[0], nan=-10.0).astype(np.float32)
        grey = np.clip(one.counts * (255.0 / full_scale), 0.0, 255.0).astype(np.float32)
        grid = pixels.reshape(pair.camera.size[1], pair.camera.size[0], 2)
        pictures.append(np.rint(cv2.remap(grey, grid, None, cv2.INTER_LINEAR)).astype(np.uint8))
    disparity_px_m = pair.focal_px * pair.baseline_m
    min_disparity = int(disparity_px_m / bounds_m[1])
    count = DISPARITY_STEP * (int(disparity_px_m / bounds_m[0] - min_disparity) // DISPARITY_STEP + 1)
    matcher = cv2.StereoSGBM.create(
        minDisparity=min_disparity,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=SMALL_STEP,
        P2=LARGE_STEP,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparities = matcher.compute(*pictures).astype(np.float64) * DISPARITY_UNIT
    return np.where(disparities >= max(min_disparity, 1), disparities, np.nan)


def semi_global_structure(scene: LandingScene, motion: Motion, options: HdaOptions) -> Matches:
    """Structure on the same pixel grid from the disparities of the rectified images."""
    first, second = scene.views
    bounds = depth_bounds(motion.depth_range_m, options.depth_margin)
    border = options.search_half_px + 1
    pixels = pixel_lattice(first.camera.size, options.grid_px, border)
    places = undistort(first.camera, pixels)
    starts, ends, room = epipolar_segments(second, motion.second_from_first, places, bounds, border)
    pixels, places, starts, ends = pixels[room], places[room], starts[room], ends[room]
    depths = np.full(len(pixels), np.nan)
    pair = rectify_views(scene.views, motion.second_from_first)
    if pair is not None:
        disparities = match_disparities(scene.views, pair, motion.second_from_first, bounds)
        rays = pair.rectified_from_first.apply(np.column_stack([places, np.ones(len(places))]))
        column, row = np.rint(pair.camera.project(rays)[0]).astype(np.int64).T
        depths = pair.focal_px * pair.baseline_m / disparities[row, column] / rays[:, 2]
    accepted = (depths > bounds[0]) & (depths < bounds[1])
    fates = np.where(accepted, Fate.ACCEPTED, Fate.OUT_OF_BOUNDS).astype(np.uint8)
    points = points_at_depth(places, depths)
    matched, _ = project_points(second.camera, motion.second_from_first.apply(points))
    return Matches(pixels, starts, ends, matched, np.full(len(pixels), np.nan), depths, fates, points[accepted])
