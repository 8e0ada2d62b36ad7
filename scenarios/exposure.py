"""Render and expose pictures of a body camera; assemble samples with the truth of their pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.optics import Optics
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Scene, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.sensor import DetectorParameters, ImageMotion
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Environment


@dataclass(frozen=True)
class Sample:
    """A picture and the truth of each pixel.

    - image: counts of `bits` bits, as delivered
    - range_m: distance along the pixel's ray to the surface; infinite for the sky
    - normal: unit normal of the surface, world axes
    - rocks: 1 for a rock or another body, 0 for ground
    - hazard: footprint hazard of a lander: 0 safe, 1 hazard, 255 not completely visible; None without a lander
    - camera: in the body's axes
    - about: pose, sun and other metadata; plain data
    """

    image: UInt16[np.ndarray, "rows columns"]
    bits: int
    range_m: Float32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    rocks: UInt8[np.ndarray, "rows columns"]
    hazard: UInt8[np.ndarray, "rows columns"] | None
    camera: CameraModel
    about: Mapping[str, Any]


def summed_rows(rows_summed: int) -> slice:
    """Select the frame's rows with the truth of a picture's rows: the middle one of each that are summed."""
    return slice(rows_summed // 2, None, rows_summed)


@runtime_checkable
class ProvidesSamples(Protocol):
    """A scenario that provides samples for learning."""

    def samples(self, parameters: BaseModel, streams: Streams) -> Iterator[Sample]:
        """Yield the pictures of one case that `run` gives to its algorithms."""
        ...


def render_state(
    backend: Backend, scene: Scene, optics: Optics, state: State, mounting: RigidTransform | None = None
) -> tuple[Frame, ImageMotion]:
    """Render the view of a camera at the body's origin, and compute the image motion during its exposure.

    `mounting` rotates the camera in the body.
    """
    pose = state.world_from_body if mounting is None else state.world_from_body * mounting
    frame = process_renderer(backend).render(scene, optics.rays, pose, state.time_s)
    rate = state.attitude.apply(state.body_rate_rad_s)
    return frame, ImageMotion.of_camera(optics.camera, frame.range_m, frame.world_from_body, state.velocity_m_s, rate)


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
