"""Stereo images of a pair of cameras: rendering and exposure of their subframes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import PixelBox
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastImage
from marsyard.sim.render import Objects, PixelRays, Scene, process_renderer
from marsyard.sim.sensor import Detector, auto_expose, natural_fall_off
from marsyard.sim.sensor.optics import apply_point_spread
from marsyard.sim.streams import Streams

#: Factor by which the full frame is reduced for auto-exposure.
_BINNING = 16
#: Images without detector noise, of any detector: bits of the counts, and count of the given percentile of the left
#: subframe (three quarters of full scale).
_EXACT_BITS, _EXACT_PERCENTILE, _EXACT_COUNT = 12, 98.0, 3071.0
#: Fall-off of a lens; cached because all runs of a process use the same camera designs.
_cached_fall_off = lru_cache(maxsize=8)(natural_fall_off)
#: Rays of a camera; cached because a navigation camera has the same rays in all images.
cached_rays = lru_cache(maxsize=8)(PixelRays.from_camera)


@dataclass(frozen=True)
class StereoImages:
    """A stereo pair of delivered subframes."""

    left: MastImage
    right: MastImage
    exposure_s: float  #: of both images; 0 without detector noise

    @cached_property
    def digest(self) -> bytes:
        """Hash of both images' counts."""
        return hashlib.sha256(self.left.counts.tobytes() + self.right.counts.tobytes()).digest()


@dataclass(frozen=True)
class StereoCamera:
    """The detectors of a stereo pair with sampled pixel responses.

    Without detector noise, counts are proportional to the light behind the optics, without fall-off and dust, and
    rounded to 12 bits. The left subframe sets the exposure.
    """

    parameters: RoverScenarioParameters
    detectors: tuple[Detector, Detector]  #: detectors of the left and the right camera
    noise: np.random.Generator  #: random stream of the detector noise

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> StereoCamera:
        """Draw the detectors of both cameras; their fall-off is that of the nominal lens design."""
        design, parameters = p.camera.mast(), p.camera.detector_parameters()
        rng = streams.generator("detector response")
        left, right = (
            Detector.draw(_cached_fall_off(camera), parameters, rng) for camera in (design.left, design.right)
        )
        return cls(p, (left, right), streams.generator("detector noise"))

    @property
    def bits(self) -> int:
        """Number of bits of a count."""
        return self.detectors[0].parameters.bits if self.parameters.camera.detector_noise else _EXACT_BITS

    def take(
        self,
        scene: Scene,
        rover: Objects | None,
        world_from_head: RigidTransform,
        cameras: tuple[CameraModel, CameraModel],
        boxes: tuple[PixelBox, PixelBox],
        brightness: float,
        time_s: float,
    ) -> StereoImages:
        """Take subframes with the true cameras on the mast's head.

        - scene: the scene without the rover
        - rover: mesh of the rover if its shadow may fall into an image, else None
        - world_from_head, cameras: true pose of the head, and true cameras in the head's frame
        - boxes: subframes of the cameras
        - brightness: direct sunlight on the ground relative to 1 AU
        """
        p, scale = self.parameters, np.float32(brightness / self.detectors[0].parameters.sunlight)

        def add_rover(base: Scene) -> Scene:
            return base if rover is None else base.with_objects(Objects.join([base.objects, rover]))

        def render(full_scene: Scene, rays: PixelRays) -> Float32[np.ndarray, "rows columns"]:
            frame = process_renderer(p.backend).render(full_scene, rays, world_from_head, time_s)
            return np.asarray(frame.radiance * scale)

        pairs = zip(cameras, boxes, strict=True)
        pixel_rays = [cached_rays(camera.crop(*box.corner, box.size)) for camera, box in pairs]
        local_scene = add_rover(scene.restrict_to_cones([rays.cone(world_from_head) for rays in pixel_rays]))
        radiances, exposure_s = [render(local_scene, rays) for rays in pixel_rays], 0.0
        if p.camera.detector_noise:
            windows = [unit.window(*box.corner, box.size) for unit, box in zip(self.detectors, boxes, strict=True)]
            detector, metering_radiance = windows[0], radiances[0]
            exposure_s = detector.parameters.exposure_s
            if p.exposure.metering == "full-frame":
                # reduced full frame, and a detector of its size with the reduced response
                reduced_rays = PixelRays.from_camera(cameras[0].scale(1.0 / _BINNING))
                metering_radiance = render(add_rover(scene).with_edge_rays(1), reduced_rays)
                response = cv2.resize(
                    self.detectors[0].response, metering_radiance.shape[::-1], interpolation=cv2.INTER_AREA
                )
                detector = replace(detector, response=response, hot_e_s=None, listed=None)
            if p.exposure.metering != "fixed":
                auto_exposure = auto_expose(detector, metering_radiance, p.exposure.auto, self.noise)
                exposure_s = auto_exposure.detector.parameters.exposure_s
            counts = [
                window.with_exposure(exposure_s).expose(radiance, self.noise)
                for window, radiance in zip(windows, radiances, strict=True)
            ]
        else:
            optics = self.detectors[0].parameters.optics
            radiances = [apply_point_spread(radiance, optics) for radiance in radiances]
            brightness_at_count = float(np.percentile(radiances[0], _EXACT_PERCENTILE))
            gain = _EXACT_COUNT / max(brightness_at_count, 1e-9)  # finite also without light
            full_scale = 2**_EXACT_BITS - 1
            counts = [np.clip(np.rint(gain * radiance), 0, full_scale).astype(np.uint16) for radiance in radiances]
        left, right = (MastImage(values, box.corner) for values, box in zip(counts, boxes, strict=True))
        return StereoImages(left, right, exposure_s)
