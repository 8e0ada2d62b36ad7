"""Preparation of an image pair for stereo matching: common orientation and scale, band-pass filter.

The published algorithm compares the images as they are. Both steps belong to `hda-plus`.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.scene import CameraView, Views
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid

#: Standard deviation of the Gaussian filter, and side of the window of the local mean, pixels. Detector noise is
#: independent from pixel to pixel, texture is not: over ten flights of the calibration seed of hda-mars, windows at the
#: true match have correlations of 0.7 to 0.9 without the filter, and 0.95 and more with it.
SMOOTHING_PX, MEAN_WINDOW_PX = 0.7, 21
#: Counts of filtered images: the factor keeps fractions of counts; the local mean of the image becomes `FILTER_OFFSET`.
FILTER_GAIN, FILTER_OFFSET = 8.0, 32768.0
#: Largest side of the resampled image, in sides of the original one.
MAX_SIDE_RATIO = 2


def prepare_views(
    views: Views, second_from_first: RigidTransform, depth_m: float, options: HdaOptions
) -> tuple[Views, RigidTransform]:
    """Prepare two views for matching; return them and the motion between their cameras.

    `depth_m` is the depth at which both images have the same scale (option `resample_second`). The first view keeps its
    geometry.
    """
    if options.resample_second:
        views, second_from_first = resample_second(views, second_from_first, depth_m)
    if options.filter_images:
        views = (filter_view(views[0]), filter_view(views[1]))
    return views, second_from_first


def resample_second(views: Views, second_from_first: RigidTransform, depth_m: float) -> tuple[Views, RigidTransform]:
    """Resample the second image to the orientation of the first camera, and to its scale at the depth `depth_m`.

    A window then shows the same ground in both images, also after a rotation or a change of height. The resampled
    image covers the field of view of the second image, but has at most `MAX_SIDE_RATIO` times the sides of the first;
    outside the second image it repeats the border. The views are returned unchanged if the second camera is
    not above the ground at this depth, or does not look in the direction of the first.
    """
    first, second = views
    first_from_second = second_from_first.rotation.inv()
    origin = first_from_second.apply(np.array(second_from_first.translation))
    rays = first_from_second.apply(second.camera.rays(second.camera.border(steps=16))[1])
    second_depth_m = depth_m + float(origin[2])
    if not (second_depth_m > 0.0 and np.all(rays[:, 2] > 0.0)):
        return views, second_from_first
    focal = first.focal_px * second_depth_m / depth_m
    border_px = focal * rays[:, :2] / rays[:, 2:]
    limits = 0.5 * MAX_SIDE_RATIO * np.array(first.camera.size)
    centre = 0.5 * (border_px.min(axis=0) + border_px.max(axis=0))
    low = np.floor(np.maximum(border_px.min(axis=0), centre - limits))
    high = np.ceil(np.minimum(border_px.max(axis=0), centre + limits))
    camera = covering_camera(focal, low, high)
    grid_rays = camera.rays(camera.pixel_grid())[1].reshape(-1, 3)
    # pixels behind the second camera are outside its image
    pixels = np.nan_to_num(second.camera.project(second_from_first.rotation.apply(grid_rays))[0], nan=-10.0)
    grid = pixels.astype(np.float32).reshape(camera.size[1], camera.size[0], 2)
    # linear interpolation: OpenCV's cubic samples are displaced by up to 0.05 px
    counts = cv2.remap(second.counts.astype(np.float32), grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    resampled = CameraView(np.rint(counts).astype(np.uint16), camera, second.world_from_camera)
    return (first, resampled), rigid(Rotation.identity(), origin)


def covering_camera(focal_px: float, low_px: Vector2, high_px: Vector2) -> Cahv:
    """Return the camera along z whose image covers the whole pixels `low_px` to `high_px` from its optical axis."""
    columns, rows = (int(side) + 1 for side in high_px - low_px)
    centre = (-float(low_px[0]), -float(low_px[1]))
    axis, right = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    return Cahv.from_axes((focal_px, focal_px), (columns, rows), axis=axis, right=right, image_centre=centre)


def filter_view(view: CameraView) -> CameraView:
    """Smooth an image and subtract its local mean (band-pass filter); the counts are `FILTER_GAIN` times as large.

    The sum of absolute differences (Eq. 9) then does not depend on the exposure: the brightness of the same ground
    differs by up to 2 % between the images, in counts more than the texture of smooth ground.
    """
    smooth = cv2.GaussianBlur(view.counts.astype(np.float32), (0, 0), SMOOTHING_PX)
    contrast = smooth - cv2.blur(smooth, (MEAN_WINDOW_PX, MEAN_WINDOW_PX))
    counts = np.clip(np.rint(FILTER_GAIN * contrast + FILTER_OFFSET), 0.0, 65535.0)
    return replace(view, counts=counts.astype(np.uint16))
