"""Render and expose pictures of a body camera; assemble samples with the truth of their pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.optics import Optics
from marsyard.scenarios.samples import Sample, summed_rows
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Scene, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.sensor import DetectorParameters, ImageMotion
from marsyard.sim.terrain import Environment


def render_state(
    backend: Backend, scene: Scene, optics: Optics, state: State, mounting: RigidTransform | None = None
) -> tuple[Frame, ImageMotion]:
    """Render the view of a camera at the body's origin, and compute the image motion during its exposure.

    `mounting` rotates the camera in the body.
    """
    pose = state.world_from_body if mounting is None else state.world_from_body * mounting
    frame = process_renderer(backend).render(scene, optics.rays, pose, state.time_s)
    rate = state.attitude.apply(state.body_rate_rad_s)
    return frame, ImageMotion.seen(optics.camera, frame.range_m, frame.world_from_body, state.velocity_m_s, rate)


def sunlight_ratio(air: Environment, elevation_rad: float, detector: DetectorParameters) -> float:
    """Return the ratio of the sunlight at the ground to the reference of the detector's responsivity."""
    return air.direct_share(elevation_rad) * air.solar_irradiance / detector.sunlight


def pixel_sample(
    counts: UInt16[np.ndarray, "rows columns"],
    frame: Frame,
    detector: DetectorParameters,
    camera: CameraModel,
    about: Mapping[str, Any],
    hazard: UInt8[np.ndarray, "rows columns"] | None = None,
) -> Sample:
    """Assemble a picture and the truth of its pixels; `camera` is that of the delivered picture."""
    rows = summed_rows(detector.rows_summed)
    return Sample(
        image=counts,
        bits=detector.bits,
        range_m=frame.range_m[rows].astype(np.float32),
        normal=frame.normal[rows],
        rocks=(frame.body[rows] >= 0).astype(np.uint8),
        hazard=hazard,
        camera=camera,
        about=about,
    )
