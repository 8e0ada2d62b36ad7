"""Baseline landing site estimators: OpenCV's essential matrix, and its semi-global matching of rectified images.

All other stages are those of `HdaEstimator`; the motion of the semi-global matching is that of the essential matrix.
"""

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda import structure
from marsyard.algorithms.hda.estimator import find_site, match_structure
from marsyard.algorithms.hda.motion import CameraMotion, assess_motion
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.preparation import covering_camera
from marsyard.algorithms.hda.scene import LandingScene, Views, build_scene, points_at_depth, project_points, undistort
from marsyard.algorithms.hda.tracking import Tracks
from marsyard.algorithms.interface import SiteEstimate
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements

#: Confidence of the robust estimation of the essential matrix.
CONFIDENCE = 0.9999
#: Methods and inlier distances (pixels) of `cv2.findEssentialMat`; the best result is used. A planar scene has two
#: solutions; each method sometimes returns the wrong solution, in which most tracks are behind a camera.
ATTEMPTS = ((cv2.LMEDS, 1.0), (cv2.RANSAC, 0.1), (cv2.RANSAC, 0.3), (cv2.RANSAC, 1.0), (cv2.USAC_PROSAC, 0.1))
#: Window side of the semi-global matching, pixels, and the penalties (P1, P2) of disparity steps recommended by OpenCV.
BLOCK_PX = 5
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 8 * BLOCK_PX**2, 32 * BLOCK_PX**2
#: OpenCV requires the number of disparities to be a multiple of this.
DISPARITY_STEP = 16
#: OpenCV's unit of disparity, pixels.
DISPARITY_UNIT = 1.0 / 16.0
#: Largest cosine between the baseline and the mean optical axis for which images are rectified.
MAX_BASELINE_COSINE = 0.8
#: Largest side of a rectified image, in diagonals of the original images.
MAX_SIDE_DIAGONALS = 2.0
#: Quantile of the counts that becomes white in 8-bit images; few pixels are brighter.
WHITE_QUANTILE = 0.995


@final
class EssentialMatrixEstimator:
    """Baseline landing site estimator: motion from OpenCV's essential matrix, structure as in `HdaEstimator`."""

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """Select the site; details and errors are those of `HdaEstimator.estimate`."""
        return find_site(build_scene(measurements), essential_motion, match_structure, self.options)


def essential_motion(scene: LandingScene, tracks: Tracks, options: HdaOptions) -> CameraMotion | None:
    """Estimate the motion by essential matrices; return the motion with most tracks in front of both cameras.

    The motion is scaled so that the median depth of the tracks equals the laser range. None without a solution.
    """
    focal = scene.views[1].focal_px
    track_pixels = (tracks.first[tracks.accepted], tracks.second[tracks.accepted])
    first, second = (undistort(view.camera, pixels) for view, pixels in zip(scene.views, track_pixels, strict=True))
    intrinsics = np.diag([focal, focal, 1.0])
    poses = []
    for method, inlier_px in ATTEMPTS:
        pixels = focal * first, focal * second
        matrix, inlier_mask = cv2.findEssentialMat(*pixels, intrinsics, method, CONFIDENCE, inlier_px)
        if matrix is not None and matrix.shape == (3, 3) and np.all(np.isfinite(matrix)):
            poses.append(cv2.recoverPose(matrix, *pixels, intrinsics, mask=inlier_mask)[:3])
    if not poses:
        return None
    _, rotation, translation = max(poses, key=lambda pose: pose[0])
    second_from_first = rigid(Rotation.from_matrix(rotation), translation.ravel())
    depths = structure.triangulate(first, second, second_from_first)
    depths[~(np.abs(depths) > 0.0)] = np.inf  # no depth: a point at infinity
    positive_depths = depths[np.isfinite(depths) & (depths > 0.0)]
    if len(positive_depths) == 0:
        return None
    motion = assess_motion(first, second, focal, second_from_first, depths, True, options)
    return motion.scale(scene.range_m / float(np.median(positive_depths)))


@final
class SemiGlobalEstimator:
    """Baseline landing site estimator: OpenCV's essential matrix and semi-global matching of rectified images."""

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """Select the site; details and errors are those of `HdaEstimator.estimate`."""
        return find_site(build_scene(measurements), essential_motion, semi_global_structure, self.options)


@dataclass(frozen=True)
class Rectification:
    """Pair of linear cameras with parallel axes; the x axes (image columns) lie along the baseline.

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
    """Compute the rectification of a pair; None for motion along the optical axis or too large rectified images."""
    first_from_second = second_from_first.inv()
    baseline = float(np.linalg.norm(first_from_second.translation))
    baseline_axis = first_from_second.translation / baseline
    axis = np.array([0.0, 0.0, 1.0]) + first_from_second.rotation.apply(np.array([0.0, 0.0, 1.0]))
    axis /= np.linalg.norm(axis)
    if abs(float(baseline_axis @ axis)) > MAX_BASELINE_COSINE:
        return None
    axis -= (baseline_axis @ axis) * baseline_axis
    axis /= np.linalg.norm(axis)
    rectified_from_first = Rotation.from_matrix(np.stack([baseline_axis, np.cross(axis, baseline_axis), axis]))
    focal = views[0].focal_px
    border_rays = [
        rectified_from_first.apply(rotation.apply(view.camera.rays(view.camera.border(steps=16))[1]))
        for view, rotation in zip(views, (Rotation.identity(), first_from_second.rotation), strict=True)
    ]
    rays = np.concatenate(border_rays)
    if np.any(rays[:, 2] <= 0.0):
        return None
    border_px = focal * rays[:, :2] / rays[:, 2:]
    low, high = np.floor(border_px.min(axis=0)), np.ceil(border_px.max(axis=0))
    if float((high - low).max()) > MAX_SIDE_DIAGONALS * float(np.hypot(*views[0].camera.size)):
        return None
    return Rectification(rectified_from_first, baseline, covering_camera(focal, low, high))


def match_disparities(
    views: Views, rectification: Rectification, second_from_first: RigidTransform, bounds_m: tuple[float, float]
) -> Float[np.ndarray, "rows columns"]:
    """Compute disparities (pixels) in the first rectified image by semi-global matching; NaN without a match."""
    first_from_rectified = rectification.rectified_from_first.inv()
    full_scale = max(float(np.quantile(views[0].counts, WHITE_QUANTILE)), 1.0)
    rotations = (first_from_rectified, second_from_first.rotation * first_from_rectified)
    rays = rectification.camera.rays(rectification.camera.pixel_grid())[1].reshape(-1, 3)
    images = []
    for view, rotation in zip(views, rotations, strict=True):
        # 8-bit images, black outside the field of view: (-10, -10) is outside every image
        pixels = np.nan_to_num(view.camera.project(rotation.apply(rays))[0], nan=-10.0).astype(np.float32)
        grey = np.clip(view.counts * (255.0 / full_scale), 0.0, 255.0).astype(np.float32)
        grid = pixels.reshape(rectification.camera.size[1], rectification.camera.size[0], 2)
        images.append(np.rint(cv2.remap(grey, grid, None, cv2.INTER_LINEAR)).astype(np.uint8))
    disparity_times_depth_px_m = rectification.focal_px * rectification.baseline_m
    min_disparity = int(disparity_times_depth_px_m / bounds_m[1])
    disparity_range = int(disparity_times_depth_px_m / bounds_m[0] - min_disparity)
    matcher = cv2.StereoSGBM.create(
        minDisparity=min_disparity,
        numDisparities=DISPARITY_STEP * (disparity_range // DISPARITY_STEP + 1),
        blockSize=BLOCK_PX,
        P1=SMALL_STEP_PENALTY,
        P2=LARGE_STEP_PENALTY,
        # left-right check, uniqueness and speckle filters: usual values (OpenCV's manual)
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparities = matcher.compute(*images).astype(np.float64) * DISPARITY_UNIT
    return np.where(disparities >= max(min_disparity, 1), disparities, np.nan)


def semi_global_structure(scene: LandingScene, motion: CameraMotion, options: HdaOptions) -> structure.Matches:
    """Compute points for the pixel grid of `HdaEstimator` from the disparities of the rectified images."""
    first, second = scene.views
    bounds = structure.depth_bounds(motion.depth_range_m, options.depth_margin)
    border = options.search_half_px + 1
    spacing = structure.grid_spacing_px(first, motion.depth_range_m, options)
    pixels = structure.pixel_lattice(first.camera.size, spacing, border)
    coordinates = undistort(first.camera, pixels)
    starts, ends, valid = structure.epipolar_segments(second, motion.second_from_first, coordinates, bounds, border)
    pixels, coordinates, starts, ends = pixels[valid], coordinates[valid], starts[valid], ends[valid]
    depths = np.full(len(pixels), np.nan)
    rectification = rectify_views(scene.views, motion.second_from_first)
    if rectification is not None:
        disparities = match_disparities(scene.views, rectification, motion.second_from_first, bounds)
        rays = rectification.rectified_from_first.apply(np.column_stack([coordinates, np.ones(len(coordinates))]))
        column, row = np.rint(rectification.camera.project(rays)[0]).astype(np.int64).T
        # rays have unit depth in the first camera's frame; disparities give depths in the rectified frame
        depths = rectification.focal_px * rectification.baseline_m / disparities[row, column] / rays[:, 2]
    is_accepted = (depths > bounds[0]) & (depths < bounds[1])
    statuses = np.full(len(pixels), structure.MatchStatus.OUT_OF_BOUNDS, dtype=np.uint8)
    statuses[is_accepted] = structure.MatchStatus.ACCEPTED
    points = points_at_depth(coordinates, depths)
    matched_pixels, _ = project_points(second.camera, motion.second_from_first.apply(points))
    return structure.Matches(pixels, starts, ends, matched_pixels, depths, statuses, points[is_accepted])
