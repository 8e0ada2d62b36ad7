"""The world of a case rendered from above, as a surface of its timeline."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, UInt8
from scipy.spatial.transform import Rotation

from marsyard.scenarios.timeline import SurfacePatch
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.render import PixelRays, Scene, process_renderer
from marsyard.sim.render.backend import Backend

#: Side of the image of `surface_from_above`, pixels, and the height of its camera divided by the half width.
_SIDE_PX, _HEIGHT_RATIO = 384, 6.0
#: Quantiles of the brightness that become black and white, and minimum difference between both, for black images.
_DARK, _BRIGHT, _MIN_CONTRAST = 0.005, 0.995, 1e-9


def surface_from_above(
    create_scene: Callable[[float, float, float, float], Scene],
    centre_m: tuple[float, float],
    half_width_m: float,
    backend: Backend,
) -> SurfacePatch:
    """Render the world from above; return the visible points, rocks included, with their brightness.

    - create_scene: creates the scene for a camera by its east and north, height above the ground, and pixel angle (rad)
    - centre_m: east and north of the centre
    """
    height_m = _HEIGHT_RATIO * half_width_m
    scene = create_scene(*centre_m, height_m, 2.0 / (_HEIGHT_RATIO * _SIDE_PX))
    ground_m = float(scene.surface.height(*centre_m))
    camera = Cahv.from_field_of_view(
        2.0 * np.arctan(1.0 / _HEIGHT_RATIO),
        (_SIDE_PX, _SIDE_PX),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    pose = rigid(Rotation.identity(), np.array([*centre_m, ground_m + height_m]))
    frame = process_renderer(backend).render(scene, PixelRays.from_camera(camera), pose)
    return SurfacePatch(frame.points_world().astype(np.float32), grey_values(frame.radiance))


def grey_values(brightness: Float32[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """Scale brightness to 8 bits; the darkest and the brightest 0.5 % become black and white."""
    low, high = np.quantile(brightness, (_DARK, _BRIGHT))
    scaled = (brightness - low) * (255.0 / max(float(high - low), _MIN_CONTRAST))
    return np.asarray(np.clip(scaled, 0.0, 255.0), dtype=np.uint8)
