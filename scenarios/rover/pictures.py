"""Stereo subframes: rendered through the true cameras, exposed by their detectors."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import PixelBox
from marsyard.scenarios.rover.parameters import CameraParameters, ExposureParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastImage
from marsyard.sim.render import Objects, PixelRays, Scene, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.sensor import Detector, auto_expose, natural_fall_off

#: Full-frame auto-exposure uses a picture this many times smaller.
_BINNED = 16


@lru_cache(maxsize=8)
def fall_off(camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
    """A lens's fall-off; cached, as all runs of a process share the designed cameras."""
    return natural_fall_off(camera)


@dataclass(frozen=True)
class Detectors:
    """The detectors of a stereo pair, their pixels drawn.

    Without noise, counts are proportional to light, rounded, at an exposure that suits the subframe's own pixels.
    """

    left: Detector
    right: Detector
    noise: bool

    @classmethod
    def drawn(cls, p: CameraParameters, rng: np.random.Generator) -> Detectors:
        """Detectors of the designed pair."""
        design, settings = p.mast(), p.settings()
        left, right = (Detector.drawn(fall_off(camera), settings, rng) for camera in (design.left, design.right))
        return cls(left, right, p.detector_noise)

    @property
    def sunlight(self) -> float:
        """Sunlight, relative to 1 AU, of the stated responsivity."""
        return self.left.parameters.sunlight


@dataclass(frozen=True)
class StereoPictures:
    """A stereo pair of subframes as delivered."""

    left: MastImage
    right: MastImage
    exposure_s: float

    @cached_property
    def digest(self) -> bytes:
        """Hash of both pictures' counts."""
        digest = hashlib.sha256()
        for image in (self.left, self.right):
            digest.update(np.ascontiguousarray(image.counts).tobytes())
        return digest.digest()


@dataclass(frozen=True)
class Photographer:
    """Camera pair that takes subframes."""

    backend: Backend
    detectors: Detectors
    exposure: ExposureParameters
    noise: np.random.Generator  #: stream of the detectors' noise

    def take(
        self,
        scene: Scene,
        rover: Objects | None,
        world_from_head: RigidTransform,
        cameras: tuple[CameraModel, CameraModel],
        boxes: tuple[PixelBox, PixelBox],
        brightness: float,
        time_s: float,
    ) -> StereoPictures:
        """Subframes of the true cameras on a head.

        `scene` is without the rover; `rover` is given where its shadow may fall into a picture. `world_from_head` and
        `cameras` are true; `boxes` are the parts of the full frames; `brightness` is sunlight relative to 1 AU.
        """
        pairs = zip(cameras, boxes, strict=True)
        shown = [PixelRays.of(camera.cropped(*box.corner, box.size)) for camera, box in pairs]
        near = _joined(scene.within([rays.cone(world_from_head) for rays in shown]), rover)
        brightness /= self.detectors.sunlight
        light = [self._light(near, world_from_head, rays, brightness, time_s) for rays in shown]
        if not self.detectors.noise:
            left, right = (
                MastImage(_noise_free(one, light[0]), box.corner) for one, box in zip(light, boxes, strict=True)
            )
            return StereoPictures(left, right, 0.0)
        parts = [
            detector.window(*box.corner, box.size)
            for detector, box in zip((self.detectors.left, self.detectors.right), boxes, strict=True)
        ]
        exposure_s = self._exposure_s(scene, rover, world_from_head, cameras[0], parts[0], light[0], brightness, time_s)
        left, right = (
            MastImage(part.with_exposure(exposure_s).expose(one, self.noise), box.corner)
            for part, one, box in zip(parts, light, boxes, strict=True)
        )
        return StereoPictures(left, right, exposure_s)

    def _light(
        self, scene: Scene, world_from_head: RigidTransform, rays: PixelRays, brightness: float, time_s: float
    ) -> Float32[np.ndarray, "rows columns"]:
        frame = process_renderer(self.backend).render(scene, rays, world_from_head, time_s)
        light: Float32[np.ndarray, "rows columns"] = frame.radiance * np.float32(brightness)
        return light

    def _exposure_s(
        self,
        scene: Scene,
        rover: Objects | None,
        world_from_head: RigidTransform,
        camera: CameraModel,
        part: Detector,
        light: Float32[np.ndarray, "rows columns"],
        brightness: float,
        time_s: float,
    ) -> float:
        if self.exposure.of == "fixed":
            return part.parameters.exposure_s
        if self.exposure.of == "full-frame":
            # each block of pixels by its mean light, through a detector of as many pixels
            binned = PixelRays.of(camera.scaled(1.0 / _BINNED))
            light = self._light(
                replace(_joined(scene, rover), edge_rays=1), world_from_head, binned, brightness, time_s
            )
            block = part.response[: len(light), : light.shape[1]]
            part = replace(part, response=np.resize(block, light.shape), hot_e_s=None)
        return auto_expose(part, light, self.exposure.auto, self.noise).detector.parameters.exposure_s


def _joined(scene: Scene, rover: Objects | None) -> Scene:
    return scene if rover is None else scene.with_objects(Objects.joined([scene.objects, rover]))


def _noise_free(light: Float32[np.ndarray, "rows columns"], reference: Float32[np.ndarray, "_ _"]) -> np.ndarray:
    """Counts of 12 bits in proportion to the light, the reference's brightest at three quarters of full scale."""
    scale = 3071.0 / max(float(np.percentile(reference, 98.0)), 1e-9)
    return np.clip(np.rint(scale * light), 0, 4095).astype(np.uint16)
