"""Structure from motion: the camera's motion and the features' depths from their tracks (section II.B)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda.kernels import motion as kernels
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.sim.frames import rigid

#: Scales of Cauchy's cost, pixels, at which the motion is found for the depths as they are given, one after the other:
#: wrong tracks are let go of step by step, before depths are free to take them up (graduated non-convexity, Blake &
#: Zisserman 1987). Of 300 motions with a fifth of the tracks wrong by 20 px rms, 97 % came out right so; 80 % when
#: depths are freed after the first scale.
START_SCALES_PX = (32.0, 8.0, 3.0)
#: Most steps at a scale. Over a slope the plane that depths start on is wrong, and the way back to the right motion is
#: long: of 40 rendered pairs over steep ground 4 needed 60 to 100 steps, the others fewer.
ITERATIONS = 300
START_TOLERANCE = 1e-4
#: Step (radians; share of the depth) below which the minimum is reached.
TOLERANCE = 1e-9
#: Largest share by which an inlier's inverse depth differs from that of the plane through all.
MAX_INVERSE_DEPTH_SHARE = 0.6


@dataclass(frozen=True)
class Motion:
    """A motion between two pictures and the structure seen in both.

    Attributes
    ----------
    second_from_first
        From the first to the second camera's frame, metres.
    depths
        Of the features in the first camera's frame, metres.
    residuals_px
        Pixels from where each feature was found in the second picture to where motion and depth put it.
    inliers
        Whether a feature's residual and depth are believed.
    parallax_px
        Median shift between the pictures that is due to the translation, of the features that the motion fits.
    converged
        Whether the iteration reached a minimum.
    """

    second_from_first: RigidTransform
    depths: Float[np.ndarray, "n"]
    residuals_px: Float[np.ndarray, "n"]
    inliers: Bool[np.ndarray, "n"]
    parallax_px: float
    converged: bool

    def scaled(self, factor: float) -> Motion:
        """The same with all lengths multiplied."""
        moved = rigid(self.second_from_first.rotation, factor * self.second_from_first.translation)
        return replace(self, second_from_first=moved, depths=factor * self.depths)

    @property
    def depth_range_m(self) -> tuple[float, float]:
        """Least and greatest depth of the inliers."""
        depths = self.depths[self.inliers]
        return float(depths.min()), float(depths.max())


def plane_depths(
    places: Float[np.ndarray, "n 2"], range_m: float, up_camera: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Depths of level ground that the optical axis meets at `range_m`; the range itself where a ray misses it."""
    toward = np.column_stack([places, np.ones(len(places))]) @ up_camera
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = range_m * up_camera[2] / toward
    return np.where((depths > 0.2 * range_m) & (depths < 5.0 * range_m), depths, range_m)


def estimate_motion(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    focal_px: float,
    depths: Float[np.ndarray, "n"],
    starts: tuple[RigidTransform, ...],
    options: HdaOptions,
) -> Motion:
    """The motion of least cost over several starts, and depths; the lengths' common scale stays that of `depths`.

    Parameters
    ----------
    first, second
        Undistorted coordinates of the features in both pictures.
    focal_px
        What a unit of them is in pixels.
    depths
        Initial depths, metres: from the altimeter.
    starts
        Motions (second from first camera) to start from.
    options
        The scale of the robust cost and what an inlier is.

    Notes
    -----
    The unknowns are a unit quaternion, the translation and the features' inverse depths; the distance in the second
    picture between a feature and its projection (Eqs. 6-8) is minimised under Cauchy's cost. From each start the motion
    is first found for the given depths, which keeps it from the other of the two motions that explain a plane.
    """
    unit = float(np.median(depths))
    candidates = []
    for start in starts:
        motion = kernels.Motion(start.rotation.as_quat(scalar_first=True), start.translation / unit, unit / depths)
        candidates.append(_minimise(first, second, focal_px, motion, options))
    best, _, converged = min(candidates, key=lambda found: found[1])
    moved = rigid(Rotation.from_quat(best.q, scalar_first=True), unit * best.t)
    with np.errstate(divide="ignore"):
        return assessed(first, second, focal_px, moved, unit / best.inverse_depths, converged, options)


def assessed(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    focal_px: float,
    second_from_first: RigidTransform,
    depths: Float[np.ndarray, "n"],
    converged: bool,
    options: HdaOptions,
) -> Motion:
    """A motion with depths, and what its tracks say of it; the arguments are those of `estimate_motion`."""
    quaternion = second_from_first.rotation.as_quat(scalar_first=True)
    inverse = 1.0 / depths
    unmatched = kernels.Matches(first, np.zeros_like(first), focal_px, 1.0)
    still, moved = (
        kernels.residuals(unmatched, kernels.Motion(quaternion, translation, inverse))
        for translation in (np.zeros(3), np.array(second_from_first.translation))
    )
    residuals = np.hypot(*(moved - focal_px * second).T)
    fitting = residuals <= options.max_residual_px
    return Motion(
        second_from_first=second_from_first,
        depths=depths,
        residuals_px=residuals,
        inliers=fitting & _plausible(first, inverse, fitting),
        parallax_px=float(np.median(np.hypot(*(moved - still)[fitting].T))) if np.any(fitting) else 0.0,
        converged=converged,
    )


def _minimise(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    focal_px: float,
    motion: kernels.Motion,
    options: HdaOptions,
) -> tuple[kernels.Motion, float, bool]:
    """Motion and inverse depths from a start, cost, and whether a minimum was reached."""
    cost, converged = np.inf, False
    stages = [(scale_px, False, START_TOLERANCE) for scale_px in START_SCALES_PX]
    stages.append((options.robust_px, True, TOLERANCE))
    for scale_px, with_depths, tolerance in stages:
        matches = kernels.Matches(first, second, focal_px, scale_px)
        motion, cost, converged, _ = kernels.solve(matches, motion, with_depths, ITERATIONS, tolerance)
    return motion, cost, converged


def _plausible(
    first: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, "n"], fitting: Bool[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """Whether an inverse depth is near that of the ground: on a plane it is linear in undistorted coordinates.

    A wrong match along the epipolar line fits any motion and shows in its depth alone. The plane is the least-squares
    one after points far from their median are left out, twice.
    """
    design = np.column_stack([first, np.ones(len(first))])
    used = fitting & (inverse > 0.0)
    for _ in range(3):
        if used.sum() < 4:
            return used
        plane = design @ np.linalg.lstsq(design[used], inverse[used], rcond=None)[0]
        deviations = np.abs(inverse - plane)
        spread = max(3.0 * 1.4826 * float(np.median(deviations[used])), 1e-3 * float(np.median(inverse[used])))
        used = fitting & (inverse > 0.0) & (deviations <= spread)
    return np.asarray((inverse > 0.0) & (deviations <= MAX_INVERSE_DEPTH_SHARE * np.abs(plane)))
