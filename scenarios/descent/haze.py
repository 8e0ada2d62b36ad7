"""A veil of dusty air between the lander and the ground."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from marsyard.sim.render import Frame, Sun
from marsyard.sim.terrain import Environment

#: Height over which the optical depth is stated, m: that of the first picture.
HEIGHT_M = 2000.0


def veiled(frame: Frame, optical_depth: float, sun: Sun, air: Environment) -> Float32[np.ndarray, "rows columns"]:
    """Radiance factor of a picture through a layer of dusty air, even from the ground to the lander.

    The ground's light is weakened by ``T = exp(-optical depth x range / HEIGHT_M)``; ``1 - T`` of the air's own is
    added, whose source function is single scattering of sunlight (Henyey & Greenstein 1941) and of the mean light from
    sky and ground: contrast falls, brightness changes less.
    """
    transmitted = np.exp(-optical_depth * frame.range_m / HEIGHT_M)
    directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
    # sunlight travels along -sun and is scattered along -direction, towards the camera
    cosine = (directions @ sun.direction).reshape(frame.radiance.shape)
    g = air.asymmetry
    phase = (1.0 - g**2) / (1.0 + g**2 - 2.0 * g * cosine) ** 1.5
    sky = air.sky_share(float(np.arcsin(np.clip(sun.direction[2], -1.0, 1.0))))
    around = 0.5 * (sky + float(frame.radiance.mean()))
    source = air.single_scattering_albedo * (0.25 * phase + around)
    return np.asarray(transmitted * frame.radiance + (1.0 - transmitted) * source, dtype=np.float32)
