"""Undistorted views, and structure from motion: camera motion and depths of features from tracks (section II.B)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.arrays import Flags, Points2, Points3, Values, Vector3
from marsyard.algorithms.hda.kernels import motion as kernels
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage, LandingMeasurements, PoseMeasurement

#: Minimum relative response for the division; dead pixels have less.
MIN_RESPONSE = 0.05


@dataclass(frozen=True)
class View:
    """One image in its camera's frame.

    - counts: Detector counts without frame transfer, pixel response and lens fall-off
    - camera: Its camera, in the camera frame
    - world_from_camera: The camera's pose by the on-board filter
    """

    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    world_from_camera: RigidTransform

    @property
    def focal_px(self) -> float:
        """Mean focal length: pixels per unit of undistorted coordinates."""
        return float(np.mean(self.camera.focal_lengths))


#: The two images of an estimate.
Views = tuple[View, View]


def build_view(image: DetectorImage, pose: PoseMeasurement) -> View:
    """The view of an image taken at a pose. Raises ValueError if the image's size is not its camera's."""
    if image.counts.shape != image.camera.size[::-1]:
        raise ValueError(f"the picture has (rows, columns) {image.counts.shape}, its camera {image.camera.size[::-1]}")
    body_from_camera = camera_pose(image.camera)
    camera = image.camera.transform(body_from_camera.inv())
    return View(flat_fielded(image), camera, pose.world_from_body * body_from_camera)


def flat_fielded(image: DetectorImage) -> UInt16[np.ndarray, "rows columns"]:
    """Counts without offset, frame transfer and response variations.

    A lens passes a third less light in its corners, which biases sums of absolute differences (Eq. 9) of the same
    ground seen in the middle and near the border. Over rendered rocks from 15 m a fifth of the points was wrong without
    this correction, and half a per cent with it. Frame transfer is removed first: at 10 ms it is half of the exposure's
    light in the last of the MER camera's 1,024 rows.
    """
    detector = image.calibration
    response = np.maximum(detector.flat_field, MIN_RESPONSE).astype(np.float32)
    signal = image.counts - np.float32(detector.offset_dn)
    signal = remove_frame_transfer(signal, detector, detector.rows_summed).astype(np.float32, copy=False)
    return np.asarray(np.rint(np.clip(signal / response, 0.0, 65535.0)).astype(np.uint16))


def camera_pose(camera: CameraModel) -> RigidTransform:
    """The transform from the camera frame to the frame of the camera model."""
    axes = np.column_stack([camera.right, np.cross(camera.a, camera.right), camera.a])
    return rigid(Rotation.from_matrix(axes), np.array(camera.c))


def undistort(camera: CameraModel, pixels: Points2) -> Points2:
    """Unit focal length coordinates of pixels; NaN without a forward ray."""
    directions = camera.rays(pixels)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        places: Points2 = directions[:, :2] / directions[:, 2:]
    places[~(directions[:, 2] > 0.0)] = np.nan
    return places


def points_at_depth(places: Points2, depths: Values) -> Points3:
    """Points (camera frame) of undistorted coordinates at depths (Eq. 6)."""
    return np.asarray(np.column_stack([places, np.ones(len(places))]) * depths[:, None])


def project_points(camera: CameraModel, points: Points3) -> tuple[Points2, Flags]:
    """Pixels of points in the camera frame and whether they lie in the picture."""
    pixels, visible = camera.project(points)
    return pixels, visible & camera.in_frame(pixels)


@dataclass(frozen=True)
class LandingScene:
    """Two views and the measurements taken with the first.

    - range_m: Depth of the ground on the first camera's optical axis; NaN if unknown
    - up_camera: Unit vector upwards by the inclinometers, in the first camera's frame
    - apriori_site_world: Default landing site
    """

    views: Views
    range_m: float
    up_camera: Vector3
    apriori_site_world: Vector3

    @property
    def second_from_first(self) -> RigidTransform:
        """The camera's motion by the on-board poses."""
        return self.views[1].world_from_camera.inv() * self.views[0].world_from_camera


def build_scene(measurements: LandingMeasurements) -> LandingScene:
    """Transform the measurements to the cameras' frames. Raises ValueError if an image's size is not its camera's."""
    pairs = zip(measurements.images, measurements.poses, strict=True)
    first, second = (build_view(image, pose) for image, pose in pairs)
    body_from_camera = camera_pose(measurements.images[0].camera)
    up_camera = body_from_camera.rotation.inv().apply(np.array(measurements.up_body))
    return LandingScene((first, second), measurements.slant_range_m, up_camera, measurements.apriori_site_world)


#: Decreasing scales of Cauchy's cost, pixels, for the motion at fixed initial depths (graduated non-convexity, Blake &
#: Zisserman 1987). Of 300 motions with a fifth of the tracks wrong by 20 px rms, 97 % are solved correctly; 80 % if
#: depths are free after the first scale.
START_SCALES_PX = (32.0, 8.0, 3.0)
#: Maximum number of steps at a scale. Over slopes the initial plane is wrong: of 40 rendered pairs over steep ground 4
#: needed 60 to 100 steps.
ITERATIONS = 300
START_TOLERANCE = 1e-4
#: Step (radians; fraction of the depth) below which the minimum is reached.
TOLERANCE = 1e-9
#: Largest relative deviation of an inlier's inverse depth from the plane through all.
MAX_INVERSE_DEPTH_FRACTION = 0.6


@dataclass(frozen=True)
class Motion:
    """Camera motion between two images, and the depths of the tracked features.

    - second_from_first: From the first to the second camera's frame, metres
    - depths: Depths of the features in the first camera's frame, metres
    - residuals_px: Reprojection errors in the second image
    - inliers: Whether residual and depth of a feature are plausible
    - parallax_px: Median shift due to the translation, of the features that fit the motion
    - converged: Whether the iteration reached a minimum
    """

    second_from_first: RigidTransform
    depths: Values
    residuals_px: Values
    inliers: Flags
    parallax_px: float
    converged: bool

    def scale(self, factor: float) -> Motion:
        """The motion with all lengths multiplied."""
        moved = rigid(self.second_from_first.rotation, factor * self.second_from_first.translation)
        return replace(self, second_from_first=moved, depths=factor * self.depths)

    @property
    def depth_range_m(self) -> tuple[float, float]:
        """Smallest and largest depth of the inliers."""
        depths = self.depths[self.inliers]
        return float(depths.min()), float(depths.max())


def plane_depths(places: Points2, range_m: float, up_camera: Vector3) -> Values:
    """Depths of level ground that the optical axis meets at `range_m`; the range itself for implausible depths."""
    toward = np.column_stack([places, np.ones(len(places))]) @ up_camera
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = range_m * up_camera[2] / toward
    return np.where((depths > 0.2 * range_m) & (depths < 5.0 * range_m), depths, range_m)


def estimate_motion(
    first: Points2,
    second: Points2,
    focal_px: float,
    depths: Values,
    starts: tuple[RigidTransform, ...],
    options: HdaOptions,
) -> Motion:
    """Motion and depths of least cost over several starts; the common scale of lengths is that of `depths`.

    `first` and `second` are undistorted coordinates, `focal_px` their unit in pixels, `depths` initial depths (metres,
    from the altimeter), `starts` initial motions. The unknowns are a unit quaternion, the translation and the inverse
    depths; the reprojection error in the second image (Eqs. 6-8) is minimised under Cauchy's cost. From each start the
    motion is first solved for fixed depths, which avoids the second of the two motions that explain a plane.
    """
    unit = float(np.median(depths))
    stages = [(scale_px, False, START_TOLERANCE) for scale_px in START_SCALES_PX]
    stages.append((options.robust_px, True, TOLERANCE))
    candidates = []
    for start in starts:
        cost, converged = np.inf, False
        motion = kernels.Motion(start.rotation.as_quat(scalar_first=True), start.translation / unit, unit / depths)
        for scale_px, with_depths, tolerance in stages:
            matches = kernels.Matches(first, second, focal_px, scale_px)
            motion, cost, converged, _ = kernels.solve(matches, motion, with_depths, ITERATIONS, tolerance)
        candidates.append((motion, cost, converged))
    best, _, converged = min(candidates, key=lambda found: found[1])
    moved = rigid(Rotation.from_quat(best.q, scalar_first=True), unit * best.t)
    with np.errstate(divide="ignore"):
        return assess_motion(first, second, focal_px, moved, unit / best.inverse_depths, converged, options)


def assess_motion(
    first: Points2,
    second: Points2,
    focal_px: float,
    second_from_first: RigidTransform,
    depths: Values,
    converged: bool,
    options: HdaOptions,
) -> Motion:
    """A motion with its residuals, inliers and parallax; the arguments are those of `estimate_motion`."""
    quaternion = second_from_first.rotation.as_quat(scalar_first=True)
    inverse = 1.0 / depths
    unmatched = kernels.Matches(first, np.zeros_like(first), focal_px, 1.0)
    shifts = (np.zeros(3), np.array(second_from_first.translation))
    still, moved = (kernels.residuals(unmatched, kernels.Motion(quaternion, one, inverse)) for one in shifts)
    residuals = np.hypot(*(moved - focal_px * second).T)
    fitting = residuals <= options.max_residual_px
    return Motion(
        second_from_first=second_from_first,
        depths=depths,
        residuals_px=residuals,
        inliers=fitting & _has_plausible_depth(first, inverse, fitting),
        parallax_px=float(np.median(np.hypot(*(moved - still)[fitting].T))) if np.any(fitting) else 0.0,
        converged=converged,
    )


def _has_plausible_depth(first: Points2, inverse: Values, fitting: Flags) -> Flags:
    """Whether an inverse depth is near that of the ground plane, linear in undistorted coordinates.

    A wrong match along the epipolar line fits any motion and shows in its depth alone.
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
    return np.asarray((inverse > 0.0) & (deviations <= MAX_INVERSE_DEPTH_FRACTION * np.abs(plane)))
