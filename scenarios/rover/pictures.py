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

#: The full frame is judged for its exposure in a picture so many times smaller.
_BINNED = 16


@lru_cache(maxsize=8)
def fall_off(camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
    """A lens's fall-off; kept, as all runs of a process share cameras as designed."""
    return natural_fall_off(camera)


@dataclass(frozen=True)
class Detectors:
    """The detectors of a pair, their pixels drawn: the left and the right one.

    Without noise, counts are the light in proportion, rounded, at an exposure that suits the subframe's own pixels.
    """

    left: Detector
    right: Detector
    noise: bool

    @classmethod
    def drawn(cls, p: CameraParameters, rng: np.random.Generator) -> Detectors:
        """Detectors of a pair as designed."""
        design, settings = p.mast(), p.settings()
        left, right = (Detector.drawn(fall_off(camera), settings, rng) for camera in (design.left, design.right))
        return cls(left, right, p.detector_noise)

    @property
    def sunlight(self) -> float:
        """Sunlight, over that at 1 AU, for which their responsivity is stated."""
        return self.left.parameters.sunlight


@dataclass(frozen=True)
class StereoPictures:
    """A stereo pair of subframes as delivered, and its exposure time."""

    left: MastImage
    right: MastImage
    exposure_s: float

    @cached_property
    def digest(self) -> bytes:
        """Hash of both pictures' counts; kept, as many targets may be tracked over the same pictures."""
        digest = hashlib.sha256()
        for image in (self.left, self.right):
            digest.update(np.ascontiguousarray(image.counts).tobytes())
        return digest.digest()


@dataclass(frozen=True)
class Photographer:
    """Takes stereo subframes."""

    backend: Backend  #: Of the renderer
    detectors: Detectors  #: Of the pair
    exposure: ExposureParameters  #: How it is set
    noise: np.random.Generator  #: Stream of the detectors' noise

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

        `scene`: What is there, without the rover.
        `rover`: The rover, where its shadow may fall on what is shown.
        `world_from_head`: True pose of the mast's head.
        `cameras`: The true cameras in the head's frame.
        `boxes`: Parts of the full frames to deliver.
        `brightness`: Sunlight over that at 1 AU.
        `time_s`: When.
        """
        shown = [
            PixelRays.of(camera.cropped(*box.corner, box.size)) for camera, box in zip(cameras, boxes, strict=True)
        ]
        near = _joined(scene.within([rays.cone(world_from_head) for rays in shown]), rover)
        brightness /= self.detectors.sunlight
        light = [self._light(near, world_from_head, rays, brightness, time_s) for rays in shown]
        if not self.detectors.noise:
            counts = [_noise_free(one, light[0]) for one in light]
            return StereoPictures(MastImage(counts[0], boxes[0].corner), MastImage(counts[1], boxes[1].corner), 0.0)
        parts = [
            detector.window(*box.corner, box.size)
            for detector, box in zip((self.detectors.left, self.detectors.right), boxes, strict=True)
        ]
        exposure_s = self._exposure_s(scene, rover, world_from_head, cameras[0], parts[0], light[0], brightness, time_s)
        images = [
            MastImage(part.with_exposure(exposure_s).expose(one, self.noise), box.corner)
            for part, one, box in zip(parts, light, boxes, strict=True)
        ]
        return StereoPictures(images[0], images[1], exposure_s)

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
        if self.exposure.of == "subframe":
            return auto_expose(part, light, self.exposure.auto, self.noise).detector.parameters.exposure_s
        # the whole frame, each block of pixels by its mean light, through a detector of as many pixels
        binned = PixelRays.of(camera.scaled(1.0 / _BINNED))
        drawn = replace(_joined(scene, rover), edge_rays=1)
        whole = self._light(drawn, world_from_head, binned, brightness, time_s)
        block = part.response[: len(whole), : whole.shape[1]]
        judged = replace(part, response=np.resize(block, whole.shape), hot_e_s=None)
        return auto_expose(judged, whole, self.exposure.auto, self.noise).detector.parameters.exposure_s


def _joined(scene: Scene, rover: Objects | None) -> Scene:
    return scene if rover is None else scene.with_objects(Objects.joined([scene.objects, rover]))


def _noise_free(light: Float32[np.ndarray, "rows columns"], reference: Float32[np.ndarray, "_ _"]) -> np.ndarray:
    """Counts of 12 bits in proportion to the light, the reference's brightest at three quarters of full scale."""
    scale = 3071.0 / max(float(np.percentile(reference, 98.0)), 1e-9)
    return np.clip(np.rint(scale * light), 0, 4095).astype(np.uint16)
