"""Stereo images for visual odometry and the terrain map: navcams on the mast and hazcams on the body, binned.

The rover's software bins images to 256 x 256 pixels. `oracle_heights` replaces the map's images by the true ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.interface import PixelBox
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import build_shadow_caster
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.stereo_camera import StereoCamera, cached_rays
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.scenarios.rover.world import RunWorld
from marsyard.scenarios.views import CAMERA_MOUNTINGS
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import compose, rigid
from marsyard.sim.measurements import MastCalibration, StereoMeasurement
from marsyard.sim.sensor import Detector, DetectorParameters, natural_fall_off, preset
from marsyard.sim.sensor.mast import StereoHead, stereo_mast
from marsyard.sim.streams import Streams

#: Presets of the mast's navigation cameras; keys: presets of the tracking cameras.
NAVCAMS = {"mer-navcam": "mer-navcam", "research-navcam": "research-navcam", "research-pancam": "research-navcam"}
#: Preset of the body's hazard cameras.
HAZCAM = "mer-hazcam"
#: Supersampling of edge pixels (rays along each side of a pixel) for odometry and for the map. Block matching does not
#: need antialiasing.
ODOMETRY_EDGE_RAYS, MAP_EDGE_RAYS = 2, 1
#: Circle that contains the imaged ground near the rover, for the test of the rover's shadow: distance ahead and radius,
#: metres.
_SHADOW_AHEAD_M, _SHADOW_RADIUS_M = 4.0, 4.0
#: Spacing of the points of `oracle_heights`, metres.
_ORACLE_SPACING_M = 0.05
#: Half of the horizontal field of view of a navcam and of a hazcam, radians.
_MAST_HALF_RAD, _BODY_HALF_RAD = float(np.radians(22.5)), float(np.radians(60.0))


@dataclass(frozen=True)
class _StereoPair:
    """A binned stereo pair: detectors, and true and calibrated cameras in the frame of their mount.

    The mount is the head of the mast, or the bracket of the hazard cameras on the body.
    """

    camera: StereoCamera
    true: tuple[CameraModel, CameraModel]
    calibrated: tuple[CameraModel, CameraModel]

    @classmethod
    def draw(
        cls, p: RoverScenarioParameters, name: str, detector: DetectorParameters, head: StereoHead, streams: Streams
    ) -> _StereoPair:
        """Draw the detectors of a pair.

        - name: preset of the cameras; detector: parameters of their detectors, not binned
        - head: their true and calibrated models
        """
        factor = 1.0 / p.navigation.binning
        binned_cameras = [(mast.left.scale(factor), mast.right.scale(factor)) for mast in (head.true, head.calibrated)]
        binned_detector, rng = detector.bin(p.navigation.binning), streams.generator(f"{name} response")
        left, right = (Detector.draw(natural_fall_off(camera), binned_detector, rng) for camera in binned_cameras[0])
        # the exposure is metered in the binned image, which is the whole subframe
        exposure = p.exposure.model_copy(update={"metering": "subframe"})
        parameters = p.model_copy(update={"exposure": exposure})
        camera = StereoCamera(parameters, (left, right), streams.generator(f"{name} noise"))
        return cls(camera, binned_cameras[0], binned_cameras[1])

    def take(
        self,
        world: RunWorld,
        rig: Rig,
        vehicle: Vehicle,
        rover_from_mount: RigidTransform,
        measured_rover_from_mount: RigidTransform,
        time_s: float,
        edge_rays: int,
    ) -> StereoMeasurement:
        """Take a pair; the poses of the mount are the true and the measured one, rover frame."""
        world_from_mount = compose(vehicle.stance.world_from_rover, rover_from_mount)
        rays = cached_rays(self.true[0])
        scene = world.navigation_scene(rays, world_from_mount, time_s).with_edge_rays(edge_rays)
        ahead = np.asarray(vehicle.stance.world_from_rover.apply(np.array([_SHADOW_AHEAD_M, 0.0, 0.0])))
        geometry, sun = rig.calibrated.geometry, scene.sun.direction
        shadow = None
        if self.camera.parameters.rover_shadow:
            shadow = build_shadow_caster(
                vehicle.rover, vehicle.stance, geometry, rig.state.true_rad, ahead, _SHADOW_RADIUS_M, sun
            )
        boxes = tuple(PixelBox((0, 0), camera.size) for camera in self.true)
        images = self.camera.take(
            scene, shadow, world_from_mount, self.true, (boxes[0], boxes[1]), world.brightness(time_s), time_s
        )
        left, right = (camera.transform(measured_rover_from_mount) for camera in self.calibrated)
        return StereoMeasurement(images.left.counts, images.right.counts, (left, right))


@dataclass(frozen=True)
class NavigationCameras:
    """The stereo pairs of a run; None if no leg uses them."""

    mast: _StereoPair | None
    body: _StereoPair | None
    rover_from_body: RigidTransform  #: pose of the hazard cameras' mount in the rover frame, exact

    @classmethod
    def draw(cls, p: RoverScenarioParameters, rig: Rig, streams: Streams) -> NavigationCameras:
        """Draw the calibration errors and detectors of the pairs that the legs use."""
        mapping_legs = p.legs if p.navigation.terrain == "stereo" else ()
        mapped_by = {leg.map_by for leg in mapping_legs if leg.uses_map}
        uses_odometry = p.navigation.odometry == "stereo" and any(leg.visual_odometry for leg in p.legs)
        mast = body = None
        if uses_odometry or "mast" in mapped_by:
            # the pair that tracks also navigates, with its calibration, detectors and optics, if it is the navcam
            name, head, detector = NAVCAMS[p.camera.preset], rig.head, p.camera.detector_parameters()
            if name != p.camera.preset or p.camera.custom is not None:
                head = StereoHead.draw(stereo_mast(name), p.stereo, streams.generator("navcam calibration"))
                detector = preset(name).detector
            mast = _StereoPair.draw(p, name, detector, head, streams)
        if "body" in mapped_by:
            left, right = preset(HAZCAM).cameras()
            # calibration errors of the body's cameras are sampled like those of a mast's cameras
            design = MastCalibration(rig.calibrated.geometry, left, right)
            head = StereoHead.draw(design, p.stereo, streams.generator("hazcam calibration"))
            body = _StereoPair.draw(p, HAZCAM, preset(HAZCAM).detector, head, streams)
        mounting = CAMERA_MOUNTINGS[HAZCAM]
        tilt = Rotation.from_rotvec([0.0, -np.radians(mounting.elevation_deg), 0.0])
        return cls(mast, body, rigid(tilt, np.array(mounting.on_rover_m)))

    def take_mast_pair(
        self,
        p: RoverScenarioParameters,
        world: RunWorld,
        rig: Rig,
        vehicle: Vehicle,
        azimuth_rad: float,
        time_s: float,
        edge_rays: int = MAP_EDGE_RAYS,
    ) -> StereoMeasurement:
        """Point the mast down at an azimuth, positive to the right, and take a pair; ValueError without navcams."""
        if self.mast is None:
            raise ValueError("no leg of this run uses the mast's navigation cameras")
        rig.point(azimuth_rad, float(np.radians(p.navigation.elevation_deg)))
        measured = rig.calibrated.geometry.rover_from_head(*rig.state.readings_rad)
        return self.mast.take(world, rig, vehicle, rig.rover_from_head, measured, time_s, edge_rays)

    def take_body_pair(self, world: RunWorld, rig: Rig, vehicle: Vehicle, time_s: float) -> StereoMeasurement:
        """Take a pair with the body cameras. Raises ValueError without hazcams."""
        if self.body is None:
            raise ValueError("no leg of this run uses the body cameras")
        return self.body.take(world, rig, vehicle, self.rover_from_body, self.rover_from_body, time_s, MAP_EDGE_RAYS)


def oracle_heights(
    world: RunWorld, vehicle: Vehicle, azimuth_rad: float, ranges_m: tuple[float, float], by_body: bool
) -> Float64[np.ndarray, "n 3"]:
    """Sample the true ground with its rocks in the sector that a camera sees: a map without occlusion and errors.

    Points are in world axes, metres. `azimuth_rad` is that of the sector's centre line, positive to the right of the
    rover's heading. The apex of the sector is the front axle with `by_body`, else the rover's origin.
    """
    rover, stance = vehicle.rover, vehicle.stance
    half_rad = _BODY_HALF_RAD if by_body else _MAST_HALF_RAD
    ahead = np.array([rover.front_m if by_body else 0.0, 0.0, 0.0])
    east, north, _ = (float(value) for value in stance.world_from_rover.apply(ahead))
    offsets = np.arange(-ranges_m[1], ranges_m[1] + _ORACLE_SPACING_M, _ORACLE_SPACING_M)
    x, y = (values.ravel() for values in np.meshgrid(offsets, offsets))
    angle = np.arctan2(x, y) - (stance.azimuth_rad + azimuth_rad)
    angle = np.abs((angle + np.pi) % (2.0 * np.pi) - np.pi)
    distance = np.hypot(x, y)
    is_inside = (angle <= half_rad) & (distance >= ranges_m[0]) & (distance <= ranges_m[1])
    x, y = east + x[is_inside], north + y[is_inside]
    return np.column_stack([x, y, world.route_ground.height(x, y)])
