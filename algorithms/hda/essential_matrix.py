"""Baseline landing site estimator: camera motion from OpenCV's essential matrix.

All other stages are those of `HdaEstimator`.
"""

from typing import final

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import structure
from marsyard.algorithms.hda.estimator import find_site, match_structure
from marsyard.algorithms.hda.motion import CameraMotion, assess_motion
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.scene import LandingScene, build_scene, undistort
from marsyard.algorithms.hda.tracking import Tracks
from marsyard.algorithms.interface import SiteEstimate
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements

#: Confidence of the robust estimation of the essential matrix.
CONFIDENCE = 0.9999
#: Methods and inlier distances (pixels) of `cv2.findEssentialMat`; the best result is used. A planar scene has two
#: solutions; each method sometimes returns the wrong solution, in which most tracks are behind a camera.
ATTEMPTS = ((cv2.LMEDS, 1.0), (cv2.RANSAC, 0.1), (cv2.RANSAC, 0.3), (cv2.RANSAC, 1.0), (cv2.USAC_PROSAC, 0.1))


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
