"""Poses of cameras in the labels of images, and the world in which the poses of a case are compared."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.measured.layout import ImageRow
from marsyard.sim.camera import CameraModel, FramedCamera, LabelFrame, Pds3Product
from marsyard.sim.camera.label_frames import MARS_FIXED
from marsyard.sim.frames import SITE_FROM_WORLD, rigid, world_from_mars_fixed


def label_pose(
    row: ImageRow, framed: FramedCamera, product: Pds3Product | None
) -> tuple[CameraModel, LabelFrame, RigidTransform]:
    """Return the camera in the body's frame, and the body's pose in the frame that the label names.

    The body is the rover or, for a model in a frame that the label does not connect to the rover, the camera's centre
    with the axes of that frame.
    """
    camera = framed.camera
    if not framed.frame.is_vehicle:
        frame_from_body = rigid(Rotation.identity(), camera.c)
        return camera.transform(frame_from_body.inv()), framed.frame, frame_from_body
    if product is None or product.pose is None:
        raise row.error("qx to qw are empty, and no label contains them")
    return camera, *product.pose


def is_mars_fixed(framed: FramedCamera, product: Pds3Product | None) -> bool:
    """Return whether the label contains the pose of the camera, or of its rover, in the Mars-fixed frame."""
    frame = framed.frame
    if frame.is_vehicle and product is not None and product.pose is not None:
        frame = product.pose[0]
    return frame.name == MARS_FIXED


def world_from(row: ImageRow, frame: LabelFrame, origin_m: Float64[np.ndarray, "3"]) -> RigidTransform:
    """Return the transform to world axes: from a site, or from the Mars-fixed frame with this origin."""
    if frame.name != MARS_FIXED:
        return rigid(SITE_FROM_WORLD.inv(), np.zeros(3))
    try:
        return world_from_mars_fixed(origin_m)
    except ValueError as error:
        raise row.error(f"the label's pose in {frame}: {error}; allowed: metres from the centre of Mars") from error


def is_same_world(frame: LabelFrame | None, first: LabelFrame | None) -> bool:
    """Return whether positions in both frames have the same origin; that of the table (None) can be a site's."""
    if frame is None or first is None:
        return MARS_FIXED not in [known.name for known in (frame, first) if known is not None]
    return frame.matches(first)


def describe_frame(frame: LabelFrame | None) -> str:
    """Describe the frame of a pose; None for that of the table."""
    return "the table's axes" if frame is None else f"the label's frame {frame}"
