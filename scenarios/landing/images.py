"""Images of a landing case."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.cameras import Optics
from marsyard.scenarios.case_faults import add_detector_faults, corrupt_images
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.world import LandingWorld
from marsyard.scenarios.meshes import add_meshes
from marsyard.scenarios.views import Viewpoint, render_state, site_scene
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.render import Frame
from marsyard.sim.sensor import Detector, auto_expose
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class Pair:
    """The two images of a landing case, and their rendered frames."""

    images: tuple[DetectorImage, DetectorImage]  #: delivered images with the true camera and time
    frames: tuple[Frame, Frame]  #: rendered radiance and ground truth

    @property
    def counts(self) -> tuple[UInt16[np.ndarray, "rows columns"], UInt16[np.ndarray, "rows columns"]]:
        """Detector counts of both images."""
        return self.images[0].counts, self.images[1].counts

    @property
    def cameras(self) -> tuple[CameraModel, CameraModel]:
        """True cameras of both images, body frame."""
        return self.images[0].camera, self.images[1].camera

    @property
    def axis_range_m(self) -> float:
        """True range along the optical axis of the first image to ground or rock, metres."""
        return self.range_along_m(self.images[0].camera.a)

    def range_along_m(self, axis: Float64[np.ndarray, "3"]) -> float:
        """Compute the true range of the first image along a direction (body axes): median of the four nearest pixels.

        The centres of these pixels are at most 0.7 px from the direction.
        """
        ranges, image = self.frames[0].range_m, self.images[0]
        column, row = image.camera.project(np.array([axis]))[0][0]
        rows_summed = len(ranges) // len(image.counts)
        first_row, first_column = int((row + 0.5) * rows_summed - 0.5), int(column)
        return float(np.median(ranges[first_row : first_row + 2, first_column : first_column + 2]))


def take_images(
    p: LandingScenarioParameters, world: LandingWorld, flight: LandingFlight, optics: Optics, streams: Streams
) -> Pair:
    """Take both images of a flight; the first image determines the exposure of both."""
    parameters = add_detector_faults(p.faults, p.detector)
    detector = Detector.draw(optics.fall_off, parameters, streams.generator("detector response"))
    # a disc at the camera casts the vehicle's shadow; a fault can enlarge it
    shadow_disc_m = max(p.lander.caster_diameter_m, p.faults.vehicle_shadow_m)
    lowest = min(flight.states, key=lambda state: float(state.position_m[2]))
    # one scene for both images, with the level of detail for the lower image
    viewpoint = Viewpoint.from_pose(optics.rays, lowest.world_from_body, world.ground.surface)
    scene = add_meshes(
        site_scene(world.ground, viewpoint, world.sun), world.meshes, (viewpoint.east_m, viewpoint.north_m)
    )
    scene = replace(scene, caster_diameter_m=shadow_disc_m)
    noise = streams.generator("detector noise")
    frames_and_motions = [render_state(p.render.backend, scene, optics, state) for state in flight.states]
    frames, motions = zip(*frames_and_motions, strict=True)
    radiances = [frame.radiance * np.float32(world.brightness) for frame in frames]
    # another name of a random stream would change the random values
    detector = auto_expose(detector, radiances[0], p.exposure, streams.generator("exposure images")).detector
    counts = [detector.expose(radiance, noise, motion) for radiance, motion in zip(radiances, motions, strict=True)]
    delivered_images = corrupt_images(
        counts,
        repeated=2 if p.faults.repeated_image else 0,
        black=p.faults.black_image,
        incomplete=2,
        lost_rows=p.faults.lost_rows,
    )
    camera = p.detector.delivered_camera(optics.camera)
    first, second = (
        DetectorImage(image, state.time_s, camera, detector.calibration)
        for image, state in zip(delivered_images, flight.states, strict=True)
    )
    return Pair((first, second), (frames[0], frames[1]))
