"""Synthetic mast images and drives for the tests of target tracking: a rover among textured planes.

The ray of each pixel is intersected with the nearest body. The solid texture is a sum of plane waves; each wave is
averaged over the pixel extent in closed form, so that the images have no aliasing.
"""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.interface import PixelBox, TargetTracker, TargetUpdate
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker, VttDetails
from marsyard.sim.camera import Cahv, Cahvor, CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration, MastGeometry, MastImage, RoverMeasurements, RoverTarget

#: A mast similar to that of MER: the axes are at 1.4 m above the rover frame; elbow and head are offset from the axes.
MAST = MastGeometry(
    base_m=np.array([0.35, 0.05, 1.1]), elbow_m=np.array([0.02, 0.01, 0.3]), head_m=np.array([0.06, 0.0, 0.08])
)


def make_stereo_pair(
    focal_px: float, size: tuple[int, int], baseline_m: float, toe_in_rad: float = 0.0
) -> tuple[CameraModel, CameraModel]:
    """Create head cameras with the lens distortion of Opportunity's navcam and an off-centre axis."""
    cameras = []
    for side in (1.0, -1.0):
        toe_in_rotation = Rotation.from_rotvec([0.0, 0.0, -side * toe_in_rad])
        linear = Cahv.from_axes(
            (focal_px, focal_px),
            size,
            axis=toe_in_rotation.apply([1.0, 0.0, 0.0]),
            right=toe_in_rotation.apply([0.0, -1.0, 0.0]),
            centre=np.array([0.0, 0.5 * side * baseline_m, 0.0]),
            image_centre=(0.5 * size[0] + 3.0, 0.5 * size[1] - 4.0),
        )
        cameras.append(Cahvor.from_cahv(linear, r=np.array([0.00096, -0.002183, 0.018547])))
    return cameras[0], cameras[1]


@cache
def navcam() -> MastCalibration:
    """MER navcam: 0.82 mrad pixels, 20 cm baseline."""
    return MastCalibration(MAST, *make_stereo_pair(1222.5, (1024, 1024), 0.20))


@cache
def pancam() -> MastCalibration:
    """Pancam of the research rover: 0.29 mrad pixels, 30 cm baseline, 516 px of disparity at 2 m."""
    return MastCalibration(MAST, *make_stereo_pair(3440.9, (1024, 768), 0.30))


@dataclass(frozen=True)
class Waves:
    """A solid texture: wave vectors (n, 3) in rad/m, amplitudes with a total variance of 1, and phases."""

    vectors: np.ndarray
    amplitudes: np.ndarray
    phases: np.ndarray


def draw_waves(seed: int, longest_m: float = 0.6, shortest_m: float = 0.003, count: int = 160) -> Waves:
    """Draw waves in all directions with log-uniform wavelengths: each octave has the same variance."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = np.exp(np.linspace(np.log(longest_m), np.log(shortest_m), count))
    return Waves(
        2.0 * np.pi / lengths[:, None] * directions,
        np.full(count, np.sqrt(2.0 / count)),
        rng.uniform(0.0, 2.0 * np.pi, count),
    )


@dataclass(frozen=True)
class Plane:
    """A plane through a point with a normal, in the world."""

    point: np.ndarray
    normal: np.ndarray

    def ranges(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Compute the distance along each ray, metres; NaN where the ray misses the front side."""
        cosine = directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.point - origins) @ self.normal) / cosine
        return np.where((cosine < 0.0) & (distance > 0.0), distance, np.nan)


@dataclass(frozen=True)
class Scene:
    """Bodies with one texture; the nearest occludes the others. Wave phases are relative to `origin`."""

    bodies: tuple[Plane, ...]
    texture: Waves
    origin: np.ndarray
    contrast: float = 0.15
    level_dn: float = 1500.0

    def intersect(self, camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
        """Compute the world points at the pixels of a camera in the world frame; NaN for the sky."""
        origins, directions = camera.rays(pixels)
        ranges = np.stack([body.ranges(origins, directions) for body in self.bodies])
        nearest = np.where(np.isnan(ranges), np.inf, ranges).min(axis=0)
        return np.asarray(origins + np.where(np.isinf(nearest), np.nan, nearest)[..., None] * directions)

    def render_image(
        self, camera: CameraModel, box: PixelBox, noise: np.random.Generator | None = None, noise_dn: float = 8.0
    ) -> MastImage:
        """Render a subframe; each texture wave is averaged over the extent of the central pixel.

        The average over a parallelogram attenuates a wave by a product of two sinc functions. `noise_dn` is the SD of
        the noise.
        """
        u = box.corner[0] + np.arange(box.size[0], dtype=np.float64)
        v = box.corner[1] + np.arange(box.size[1], dtype=np.float64)
        points = self.intersect(camera, np.stack(np.meshgrid(u, v), axis=-1))
        middle = points[box.size[1] // 2, box.size[0] // 2]
        column_step = points[box.size[1] // 2, box.size[0] // 2 + 1] - middle
        row_step = points[box.size[1] // 2 + 1, box.size[0] // 2] - middle
        attenuated_amplitudes = self.texture.amplitudes.copy()
        for extent in (column_step, row_step):
            attenuated_amplitudes *= np.sinc(self.texture.vectors @ extent / (2.0 * np.pi))
        is_relevant = np.abs(attenuated_amplitudes) > 1e-4
        vectors = self.texture.vectors[is_relevant].T.astype(np.float32)
        phases = self.texture.phases[is_relevant].astype(np.float32)
        amplitudes = attenuated_amplitudes[is_relevant].astype(np.float32)
        value = np.empty(points.shape[:2])
        for row, offsets in zip(value, (points - self.origin).astype(np.float32), strict=True):
            row[:] = np.cos(offsets @ vectors + phases) @ amplitudes
        counts = self.level_dn * (1.0 + self.contrast * value)
        counts = np.where(np.isnan(counts), 0.3 * self.level_dn, counts)
        if noise is not None:
            counts = counts + noise_dn * noise.standard_normal(counts.shape)
        return MastImage(np.clip(np.rint(counts), 0, 4095).astype(np.uint16), box.corner)


def pose(x: float, y: float, heading_rad: float = 0.0, tilt: Rotation | None = None) -> RigidTransform:
    """Create the pose of the rover on level ground, heading counter-clockwise from +x, tilted in its own axes."""
    heading = Rotation.from_rotvec([0.0, 0.0, heading_rad])
    return rigid(heading if tilt is None else heading * tilt, np.array([x, y, 0.0]))


@dataclass
class Drive:
    """A rover that tracks a target from stop to stop.

    `mast` is the true mast, `mast_model` the model used by the tracker (default: the true mast). `pointing_error_rad`
    is the true minus the commanded mast angle, for azimuth and elevation.
    """

    scene: Scene
    mast: MastCalibration
    tracker: TargetTracker
    mast_model: MastCalibration | None = None
    noise: np.random.Generator | None = None
    pointing_error_rad: tuple[float, float] = (0.0, 0.0)
    measurements: list[RoverMeasurements] = field(default_factory=list)
    updates: list[TargetUpdate] = field(default_factory=list)

    def camera(self, world_from_rover: RigidTransform, angles: tuple[float, float], right: bool = False) -> CameraModel:
        """Return the camera in the world frame for mast angles (azimuth, elevation), radians."""
        camera = self.mast.right if right else self.mast.left
        return camera.transform(world_from_rover * self.mast.geometry.rover_from_head(*angles))

    def stop(self, true_pose: RigidTransform, estimated_pose: RigidTransform | None = None) -> TargetUpdate | None:
        """Aim, capture images at the true pose and update; return None if the tracker has no aim."""
        rover_estimate = true_pose if estimated_pose is None else estimated_pose
        tracker_mast = self.mast if self.mast_model is None else self.mast_model
        aim = self.tracker.aim(rover_estimate, tracker_mast)
        if aim is None:
            return None
        angles = (aim.azimuth_rad, aim.elevation_rad)
        true_angles = (angles[0] + self.pointing_error_rad[0], angles[1] + self.pointing_error_rad[1])
        self.measurements.append(
            RoverMeasurements(
                left=self.scene.render_image(self.camera(true_pose, true_angles), aim.left, self.noise),
                right=self.scene.render_image(self.camera(true_pose, true_angles, right=True), aim.right, self.noise),
                mast=tracker_mast,
                azimuth_rad=angles[0],
                elevation_rad=angles[1],
                world_from_rover=rover_estimate,
            )
        )
        self.updates.append(self.tracker.update(self.measurements[-1]))
        return self.updates[-1]

    def true_pixel(self, true_pose: RigidTransform, point_world: np.ndarray) -> np.ndarray:
        """Project a world point into the left image of the last stop, with the true pose and mast angles."""
        last, error = self.measurements[-1], self.pointing_error_rad
        return self.camera(true_pose, (last.azimuth_rad + error[0], last.elevation_rad + error[1])).project(
            point_world
        )[0]


#: Options with a smaller search window than the paper's, so that smaller subframes are rendered.
SMALL_WINDOW = VttOptions(search_px=101, warp="bend")


def make_face(seed: int, target: np.ndarray) -> Plane:
    """Create a plane rock face through the target with a random tilt, visible to a rover at the origin."""
    rng = np.random.default_rng(seed)
    normal = np.array([-1.0, rng.uniform(-0.5, 0.5), rng.uniform(0.0, 1.0)])
    return Plane(target, normal / np.linalg.norm(normal))


def make_scene(body: Plane, target: np.ndarray, seed: int) -> Scene:
    """Create a scene of one body with a random texture."""
    return Scene((body,), draw_waves(seed, count=100), target)


def start_drive(
    target: np.ndarray,
    seed: int,
    options: VttOptions = SMALL_WINDOW,
    mast: MastCalibration | None = None,
    mast_model: MastCalibration | None = None,
    face: Plane | None = None,
) -> Drive:
    """Create a drive to a face (a random one by default), designate the target at the start, and stop there."""
    scene = make_scene(make_face(seed, target) if face is None else face, target, seed)
    drive = Drive(scene, navcam() if mast is None else mast, VisualTargetTracker(options), mast_model)
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    return drive


def get_details(update: TargetUpdate | None) -> VttDetails:
    assert isinstance(update.details, VttDetails)
    return update.details


def get_pixel(update: TargetUpdate | None) -> np.ndarray:
    match = get_details(update).match
    return match.pixel


def drive_to_target(
    drive: Drive, target: np.ndarray, fraction: float, goal_m: float = 2.0, slip: float = 0.0
) -> list[tuple[RigidTransform, TargetUpdate]]:
    """Drive along x towards the target until it is `goal_m` away or lost; each step is a fraction of the distance.

    `slip` is the fraction of each step that the rover does not move. Returns the true pose and the update of each stop.
    """
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    stops, x, estimated_x = [], 0.0, 0.0
    while True:
        update = drive.stop(pose(x, 0.0), pose(estimated_x, 0.0))
        assert update is not None
        stops.append((pose(x, 0.0), update))
        distance = get_details(update).distance_m
        if not update.tracked or distance < goal_m + 0.02:
            return stops
        step = min(fraction * distance, 1.3 * (distance - goal_m))
        estimated_x += step
        x += step * (1.0 - slip)
