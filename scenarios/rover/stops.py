"""Stops of a run: stereo images, poses and the tracker's answer; designation and visibility of the target.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import PixelBox, TargetUpdate
from marsyard.algorithms.vtt import VttDetails, VttOptions
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.algorithms.vtt.stereo import triangulate
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import Triangles, Vector
from marsyard.scenarios.rover.world import Rig, RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import (
    MastCalibration,
    MastImage,
    PixelTarget,
    RoverMeasurements,
    RoverTarget,
    SiteTarget,
    TargetDesignation,
)
from marsyard.sim.render import Objects, PixelRays, Scene, process_renderer
from marsyard.sim.sensor import Detector, auto_expose, natural_fall_off
from marsyard.sim.streams import Streams

#: Factor by which the full frame is reduced for auto-exposure.
_BINNING = 16
#: Fall-off of a lens; cached because all runs of a process use the same camera designs.
_cached_fall_off = lru_cache(maxsize=8)(natural_fall_off)
#: Rays of a camera; cached because a navigation camera has the same rays in all images.
cached_rays = lru_cache(maxsize=8)(PixelRays.from_camera)


@dataclass(frozen=True)
class StereoImages:
    """A stereo pair of delivered subframes."""

    left: MastImage
    right: MastImage
    exposure_s: float

    @cached_property
    def digest(self) -> bytes:
        """Hash of both images' counts."""
        return hashlib.sha256(self.left.counts.tobytes() + self.right.counts.tobytes()).digest()


@dataclass(frozen=True)
class StereoCamera:
    """The detectors of a stereo pair with sampled pixel responses.

    Without detector noise, counts are proportional to the light and rounded. The left subframe determines the exposure.
    """

    parameters: RoverScenarioParameters
    detectors: tuple[Detector, Detector]  #: detectors of the left and the right camera
    noise: np.random.Generator  #: random stream of the detector noise

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> StereoCamera:
        """Draw the detectors of both cameras; their fall-off is that of the nominal lens design."""
        design, parameters, rng = (
            p.camera.mast(),
            p.camera.detector_parameters(),
            streams.generator("detector response"),
        )
        left, right = (
            Detector.draw(_cached_fall_off(camera), parameters, rng) for camera in (design.left, design.right)
        )
        return cls(p, (left, right), streams.generator("detector noise"))

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
                # reduced full frame, and a detector of its size
                reduced_rays = PixelRays.from_camera(cameras[0].scale(1.0 / _BINNING))
                metering_radiance = render(add_rover(scene).with_edge_rays(1), reduced_rays)
                rows, columns = metering_radiance.shape
                response = np.resize(detector.response[:rows, :columns], (rows, columns))
                detector = replace(detector, response=response, hot_e_s=None)
            if p.exposure.metering != "fixed":
                auto_exposure = auto_expose(detector, metering_radiance, p.exposure.auto, self.noise)
                exposure_s = auto_exposure.detector.parameters.exposure_s
            counts = [
                window.with_exposure(exposure_s).expose(radiance, self.noise)
                for window, radiance in zip(windows, radiances, strict=True)
            ]
        else:
            # 12-bit counts: the 98th percentile of the left subframe is 3071, three quarters of full scale
            gain = 3071.0 / max(float(np.percentile(radiances[0], 98.0)), 1e-9)
            counts = [np.clip(np.rint(gain * radiance), 0, 4095).astype(np.uint16) for radiance in radiances]
        left, right = (MastImage(values, box.corner) for values, box in zip(counts, boxes, strict=True))
        return StereoImages(left, right, exposure_s)


class RunOutcome(Enum):
    """Outcome of a run. All outcomes except COMPLETED are expected failures: no position is reported at the goal.

    NOT_SEEDED and LOST are failures of the tracker. STUCK is a property of rover and ground: the target may be tracked.
    """

    COMPLETED = "the run was completed and the target was tracked at its end"
    NOT_SEEDED = "the target was not found in the first images"
    LOST = "the target was lost and was not found again"
    OUT_OF_REACH = "the mast or the cameras cannot show the target"
    NO_PATH = "the navigator found no path"
    STUCK = "the rover hardly moved over several steps"
    NOT_AT_GOAL = "the maximum number of steps was reached before the goal"


@dataclass(frozen=True)
class StopView:
    """The images of a stop, with the poses at which they were taken."""

    leg: int  #: index of the leg (drive between two stops) that ended here; -1 for the start
    time_s: float  #: time since the start of the run
    stance: Stance  #: true pose and joint angles of the rover
    estimated_pose: RigidTransform  #: estimated world pose of the rover
    angles_rad: tuple[float, float]  #: azimuth and elevation read by the mast's encoders
    world_from_head: RigidTransform  #: true pose of the mast's head
    images: StereoImages
    drives: tuple[Drive, ...]  #: drives since the previous stop

    def measurements(self, mast: MastCalibration) -> RoverMeasurements:
        """Return the measurements of the stop, with the calibrated mast."""
        return RoverMeasurements(self.images.left, self.images.right, mast, *self.angles_rad, self.estimated_pose)


@dataclass(frozen=True)
class Stop(StopView):
    """A stop at which the target was tracked."""

    update: TargetUpdate  #: the tracker's answer
    details: VttDetails | None  #: details of the answer; None for a custom tracker
    reported_position_rover: Float64[np.ndarray, "3"] | None  #: reported position, rover frame; None if not tracked
    track_time_s: float  #: processor time of the update
    point_px: Float64[np.ndarray, "2"]  #: true full-frame (u, v) of the target in the left image; NaN outside
    point_rover: Float64[np.ndarray, "3"]  #: the designated point in the rover's true frame, metres
    range_m: float  #: true distance from the left camera to the point

    @classmethod
    def from_view(
        cls,
        view: StopView,
        point_m: Float64[np.ndarray, "3"],
        left: CameraModel,
        update: TargetUpdate,
        track_time_s: float,
    ) -> Stop:
        """Create a stop; `point_m` is the designated point in world axes, `left` the true left camera."""
        in_head = np.asarray(view.world_from_head.inv().apply(point_m.copy()))
        return cls(
            **{item.name: getattr(view, item.name) for item in fields(StopView)},
            update=update,
            details=update.details if isinstance(update.details, VttDetails) else None,
            reported_position_rover=update.position_rover if update.tracked else None,
            track_time_s=track_time_s,
            point_px=np.asarray(left.project(in_head)[0]),
            point_rover=np.asarray(view.stance.world_from_rover.inv().apply(point_m.copy())),
            range_m=float(np.linalg.norm(in_head - left.c)),
        )

    def reported_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Compute the pixel at which the tracker reports the target in the left image; NaN if it was not tracked.

        Without details of the match it is the projection of the reported position by the calibrated camera.
        """
        if self.reported_position_rover is None:
            return np.full(2, np.nan)
        if self.details is not None and self.details.match is not None:
            return np.asarray(self.details.match.pixel, dtype=np.float64)
        camera = mast.left.transform(mast.geometry.rover_from_head(*self.angles_rad))
        return np.asarray(camera.project(self.reported_position_rover)[0], dtype=np.float64)

    def error_m(self) -> Float64[np.ndarray, "3"]:
        """Compute the reported minus the true position in the rover frame; NaN if no position was reported."""
        return (
            np.full(3, np.nan)
            if self.reported_position_rover is None
            else np.asarray(self.reported_position_rover - self.point_rover)
        )


#: Number of directions around a point. The point is on an edge if one direction shows ground far behind the rock.
_RING_DIRECTIONS = 12
#: Minimum distance of background behind the point, divided by the point's distance, at which the background moves
#: visibly relative to the rock between steps: "large discontinuities at occluding boundaries" (paper, 5.2). The ground
#: in the template of a small rock is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_FRACTION = 0.1


@dataclass(frozen=True)
class DesignatedTarget:
    """The designated point on the rock's surface."""

    point_world: Vector
    designation: TargetDesignation
    on_edge: bool  #: whether the template in one of the first images shows background far behind the rock
    lit: bool  #: whether the point is in direct sunlight at the start


@dataclass(frozen=True)
class Visibility:
    """Visibility of a point of the rock along a run.

    Obliquity is the angle between the left camera's line of sight and the surface normal in the first template; it is 0
    face-on. The apparent width of a patch is proportional to the cosine of its obliquity: an increase by 10 deg reduces
    the width by a sixth near 45 deg and by a third near 65 deg. Scale and roll of a template do not compensate this.
    """

    in_view: bool  #: whether at every stop both cameras see the point, and it is not on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def designate_from_start(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> DesignatedTarget:
    """Designate the point of the parameters `target.across` and `target.up` in the view from the start.

    The point is designated by its true pixel, or by the position triangulated from its true pixels in both images. The
    mast does not move between this designation and the rover's first images.
    """
    number = world.target_number
    centre = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(centre)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; change start.target_azimuth_deg")
    rig.point(*angles)
    head, readings = stance.world_from_rover * rig.rover_from_head, rig.state.readings_rad
    target = designate_point(world, rig, head, readings, (p.target.across, p.target.up), p.vtt)
    if p.target.designation == "pixel":
        return target
    in_rover = triangulate_point(rig, stance, target.point_world)
    if p.target.designation == "rover":
        return replace(target, designation=RoverTarget(in_rover))
    in_site = np.asarray(SITE_FROM_WORLD.apply(stance.world_from_rover.apply(in_rover)))
    return replace(target, designation=SiteTarget(in_site))


def triangulate_point(rig: Rig, stance: Stance, point_world: Vector) -> Vector:
    """Triangulate a point from its true pixels in both cameras with the calibrated cameras, rover frame.

    Raises ValueError if the lines of sight have no nearest point.
    """
    head, calibrated = stance.world_from_rover * rig.rover_from_head, rig.calibrated
    in_head = np.asarray(head.inv().apply(point_world.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulate(calibrated.left, calibrated.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    return np.asarray(calibrated.geometry.rover_from_head(*rig.state.readings_rad).apply(position))


def designate_point(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    position: tuple[float, float],
    options: VttOptions,
    outline_viewpoint: Vector | None = None,
) -> DesignatedTarget:
    """Designate a point on the rock's face by its true pixel in the left image.

    `position` selects the point in the view from `outline_viewpoint`, by default the left camera: across the outline,
    from -1 (left) to 1 (right), and up, from 0 (foot) to 1 (top). The point is on an edge if it is on an edge for
    either camera, because stereo matching needs it in both images.
    """
    cameras_m, triangles = rig.camera_positions(world_from_head), world.target_triangles
    foot_m = float(world.rocks.position_m[world.target_number, 2])
    outline_viewpoint = cameras_m[0] if outline_viewpoint is None else outline_viewpoint
    outline = points.RockOutline.from_triangles(triangles, outline_viewpoint, foot_m)
    point = outline.point(*position)
    half_rad = 0.5 * options.template_px * rig.pixel_rad
    is_on_edge = any(_is_on_edge(triangles, foot_m, viewpoint, point, half_rad) for viewpoint in cameras_m)
    is_lit = not bool(points.find_self_shadow(triangles, point[None], world.sun.direction(0.0))[0])
    pixel = rig.left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return DesignatedTarget(point, PixelTarget(np.asarray(pixel), *angles_rad), is_on_edge, is_lit)


def evaluate_visibility(
    world: RunWorld, rig: Rig, point: Vector, heads: Sequence[RigidTransform], options: VttOptions
) -> Visibility:
    """Evaluate the visibility of a point on the rock from true poses of the mast's head, world axes."""
    half_rad, triangles = 0.5 * options.template_px * rig.pixel_rad, world.target_triangles
    cameras_m = [rig.camera_positions(head) for head in heads]
    normal = points.patch_normal(triangles, cameras_m[0][0], point, half_rad)
    to_cameras = np.array([left - point for left, _ in cameras_m])
    to_cameras /= np.linalg.norm(to_cameras, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(to_cameras @ normal, -1.0, 1.0)))
    foot_m, spheres = float(world.rocks.position_m[world.target_number, 2]), points.enclosing_spheres(triangles)

    def is_clear(viewpoint: Vector) -> bool:
        nearby = triangles[points.spheres_near_line(spheres, viewpoint, point, half_rad)]
        is_occluded = points.find_self_occlusion(nearby, point[None], viewpoint)[0]
        return not is_occluded and not _is_on_edge(nearby, foot_m, viewpoint, point, half_rad)

    in_view = all(is_clear(viewpoint) for pair in cameras_m for viewpoint in pair)
    return Visibility(in_view, float(obliquity_deg[0]), float(obliquity_deg.max()))


def _is_on_edge(triangles: Triangles, foot_m: float, viewpoint: Vector, point: Vector, half_rad: float) -> bool:
    """Return whether a line of sight at the angle `half_rad` from the point misses the rock and hits ground far behind.

    `foot_m` is the height of the rock's foot, world z.
    """
    distance = float(np.linalg.norm(point - viewpoint))
    axis, right, up = points.sight_axes(point - viewpoint)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_DIRECTIONS, endpoint=False)
    ring = axis + half_rad * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    # the ground around the rock is assumed level with its foot
    descent_rates = np.maximum(-ring[:, 2], 1e-9)
    visible_range_m = np.minimum(
        points.ray_distances(triangles, viewpoint, ring), (viewpoint[2] - foot_m) / descent_rates
    )
    return bool(np.any(visible_range_m > (1.0 + BEHIND_FRACTION) * distance))
