"""Image motion during clearing, exposure and charge transfer.

A point p of the static world moves in body coordinates by dp/dt = -v - w x p (v, w: velocity and angular rate of the
body, body axes); its pixel moves by the projection's Jacobian times that. From the start of clearing to the end of the
transfer, some 10 ms, this image velocity is taken as constant: at 60 deg/s of nodding with a period of 1.2 s the
angular acceleration moves the picture by less than 0.05 px in 4 ms, and a roll's curvature by less than 0.01 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera import CameraModel
from marsyard.sim.sensor.imu import Vector
from marsyard.sim.sensor.kernels import Transfer, add_smear, block_means, blur, gather_blocks, sums_before
from marsyard.sim.sensor.optics import Picture

GRID_STEP_PX = 32.0  #: Spacing of the velocity grid's nodes, pixels.
FAR_M = 1e9  #: Distance of points without range (the sky), metres.
STILL_PX = 0.01  #: Motion below which a picture is still, pixels.
#: Motion within a block of rows of the transfer, pixels, and minimum and maximum number of rows in a block.
BLOCK_PX, BLOCK_ROWS = 0.25, (4, 32)
#: The padded scene, the response and the charge, which is changed in place.
_Pictures = tuple[Float32[np.ndarray, "padded_rows padded_columns"], Picture, Picture]


@dataclass(frozen=True)
class ImageMotion:
    """Image velocity over a picture.

    `velocity_px_s` has rows and columns per second at the nodes of a grid of at least 2 x 2. The first node is pixel
    (0, 0), the spacing `GRID_STEP_PX`; the velocity is constant beyond the last node.
    """

    velocity_px_s: Float64[np.ndarray, "n m 2"]

    @classmethod
    def of_camera(
        cls,
        camera: CameraModel,
        range_m: Float[np.ndarray, "rows columns"],
        world_from_body: RigidTransform,
        velocity_m_s: Vector,
        rate_rad_s: Vector,
    ) -> ImageMotion:
        """Compute the image motion of a camera (body frame) on a moving body over a static world.

        - range_m: distance along each pixel's ray; infinite without an object
        - world_from_body: pose of the body at mid exposure
        - velocity_m_s, rate_rad_s: velocity of the body's origin and its angular rate, world axes
        """
        rows, columns = range_m.shape
        v, u = np.meshgrid(_nodes(rows), _nodes(columns), indexing="ij")
        origins, directions = camera.rays(np.stack([u, v], axis=-1))
        at = (np.minimum(v.astype(np.int64), rows - 1), np.minimum(u.astype(np.int64), columns - 1))
        distance = np.minimum(range_m[at].astype(np.float64), FAR_M)
        points = origins + distance[..., None] * directions
        body_from_world = world_from_body.rotation.inv()
        moving = -body_from_world.apply(velocity_m_s) - np.cross(body_from_world.apply(rate_rad_s), points)
        pixels = np.einsum("...ij,...j->...i", camera.projection_jacobian(points), moving)
        # nodes outside the optics have no motion: no pixel of the frame lies there
        return cls(np.ascontiguousarray(np.nan_to_num(pixels[..., ::-1])))

    @property
    def max_px_s(self) -> float:
        """Maximum speed of the nodes, pixels per second."""
        return float(np.hypot(*np.moveaxis(self.velocity_px_s, -1, 0)).max())

    def is_still(self, duration_s: float) -> bool:
        """Whether all motion within this time is below `STILL_PX`."""
        return self.max_px_s * duration_s < STILL_PX


def _nodes(extent: int) -> Float64[np.ndarray, "nodes"]:
    count = max(2, int(np.ceil((extent - 1) / GRID_STEP_PX)) + 1)
    return GRID_STEP_PX * np.arange(count, dtype=np.float64)


def moving_exposure(
    scene: Picture, response: Picture, motion: ImageMotion, exposure_s: float, transfer_row_s: float, clear_row_s: float
) -> Picture:
    """Compute the exposure of every pixel to a moving scene including clearing and transfer, radiance x seconds.

    Beyond the frame's border the scene is constant. At 60 deg/s, 4.9 pixels in an exposure of the descent camera, the
    error is 1.2 % of the mean (RMS, Gusev from 2 km) in the outermost pixels, 0.5 % in the next, and below 0.15 % from
    the third on: a seventh of the noise at SNR 100:1.

    - scene: radiance at mid exposure
    - response: relative response of every pixel
    - transfer_row_s, clear_row_s: time under each row during the transfer and the clearing
    """
    reach_s = 0.5 * exposure_s + len(scene) * max(transfer_row_s, clear_row_s)
    pad = int(np.ceil(motion.max_px_s * reach_s)) + 3
    near = int(np.ceil(0.5 * motion.max_px_s * exposure_s)) + 2
    padded = np.pad(scene, pad, mode="edge")
    inner = np.pad(scene, ((near, near), (near, near + 3)), mode="edge")
    charge = np.empty_like(scene)
    blur(inner, near, motion.velocity_px_s, GRID_STEP_PX, exposure_s, charge)
    charge *= np.float32(exposure_s)
    charge *= response
    pictures = (padded, response, charge)
    if transfer_row_s > 0.0:
        _add_smear(pictures, motion, 0.5 * exposure_s, transfer_row_s)
    if clear_row_s > 0.0:
        _add_clearing(pictures, motion, 0.5 * exposure_s, clear_row_s)
    return charge


def _add_clearing(pictures: _Pictures, motion: ImageMotion, start_s: float, row_s: float) -> None:
    """Add the clearing: the transfer of an inverted picture with time running backwards."""
    padded, response, charge = pictures
    rows = len(response)
    # velocities of the inverted picture at its own nodes: the row velocity is inverted twice, the column velocity once
    upright = np.clip((rows - 1 - _nodes(rows)) / GRID_STEP_PX, 0.0, len(motion.velocity_px_s) - 1.0)
    below = np.minimum(upright.astype(np.int64), len(motion.velocity_px_s) - 2)
    fraction = (upright - below)[:, None, None]
    inverted = (1.0 - fraction) * motion.velocity_px_s[below] + fraction * motion.velocity_px_s[below + 1]
    backwards = ImageMotion(np.ascontiguousarray(inverted * np.array([1.0, -1.0])))
    gathered = np.zeros_like(charge)
    turned = (np.ascontiguousarray(padded[::-1]), np.ascontiguousarray(response[::-1]), gathered)
    _add_smear(turned, backwards, start_s, row_s)
    charge += gathered[::-1]


def _add_smear(pictures: _Pictures, motion: ImageMotion, start_s: float, row_s: float) -> None:
    """Add the charge gathered under the rows before a packet's own, from `start_s` after mid exposure."""
    padded, response, charge = pictures
    rows = len(response)
    block_rows = int(np.clip(BLOCK_PX / max(motion.max_px_s * row_s, 1e-12), *BLOCK_ROWS))
    edges = np.append(np.arange(0, rows, block_rows), rows).astype(np.int64)
    pad = (len(padded) - rows) // 2
    transfer = Transfer(padded, pad, response, edges, motion.velocity_px_s, GRID_STEP_PX, start_s, row_s)
    add_smear(transfer, gather_blocks(transfer, sums_before(padded), block_means(response, edges)), charge)
