"""Stops of a run: stereo subframes through the true cameras, poses, and the tracker's answer; choice of the target."""

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
from marsyard.sim.dynamics import Drive, Stance
from marsyard.sim.frames import SITE_FROM_WORLD
from marsyard.sim.measurements import (
    MastCalibration,
    MastImage,
    PixelTarget,
    RoverTarget,
    SiteTarget,
    TargetDesignation,
)
from marsyard.sim.render import Objects, PixelRays, Scene, process_renderer
from marsyard.sim.sensor import Detector, auto_expose, natural_fall_off
from marsyard.sim.streams import Streams

#: Full-frame auto-exposure uses a picture this many times smaller.
_BINNED = 16
#: A lens's fall-off; cached, as all runs of a process share the designed cameras.
_cached_fall_off = lru_cache(maxsize=8)(natural_fall_off)


@dataclass(frozen=True)
class StereoPictures:
    """A stereo pair of subframes as delivered."""

    left: MastImage
    right: MastImage
    exposure_s: float

    @cached_property
    def digest(self) -> bytes:
        """Hash of both pictures' counts."""
        return hashlib.sha256(self.left.counts.tobytes() + self.right.counts.tobytes()).digest()


@dataclass(frozen=True)
class StereoCamera:
    """The detectors of a stereo pair, with drawn pixels.

    Without detector noise, counts are proportional to light, rounded, at an exposure that suits the subframe's pixels.
    """

    parameters: RoverScenarioParameters
    detectors: tuple[Detector, Detector]  #: of the left and the right camera
    noise: np.random.Generator  #: stream of the detectors' noise

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> StereoCamera:
        """Draw the detectors of the designed pair."""
        design, settings, rng = p.camera.mast(), p.camera.settings(), streams.generator("detector response")
        left, right = (Detector.draw(_cached_fall_off(one), settings, rng) for one in (design.left, design.right))
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
    ) -> StereoPictures:
        """Take subframes with the true cameras on a head.

        `scene` is without the rover; `rover` is given where its shadow may fall into a picture. `world_from_head` and
        `cameras` are true; `boxes` are the parts of the full frames; `brightness` is sunlight relative to 1 AU.
        """
        p, scale = self.parameters, np.float32(brightness / self.detectors[0].parameters.sunlight)

        def add_rover(shown: Scene) -> Scene:
            return shown if rover is None else shown.with_objects(Objects.join([shown.objects, rover]))

        def render(shown: Scene, rays: PixelRays) -> Float32[np.ndarray, "rows columns"]:
            frame = process_renderer(p.backend).render(shown, rays, world_from_head, time_s)
            return np.asarray(frame.radiance * scale)

        pairs = zip(cameras, boxes, strict=True)
        pixel_rays = [PixelRays.of(camera.crop(*box.corner, box.size)) for camera, box in pairs]
        near = add_rover(scene.within([rays.cone(world_from_head) for rays in pixel_rays]))
        lights, exposure_s = [render(near, rays) for rays in pixel_rays], 0.0
        if p.camera.detector_noise:
            windows = [one.window(*box.corner, box.size) for one, box in zip(self.detectors, boxes, strict=True)]
            metered, light = windows[0], lights[0]
            exposure_s = metered.parameters.exposure_s
            if p.exposure.of == "full-frame":
                # each block of pixels by its mean light, through a detector of as many pixels
                light = render(replace(add_rover(scene), edge_rays=1), PixelRays.of(cameras[0].scale(1.0 / _BINNED)))
                response = np.resize(metered.response[: len(light), : light.shape[1]], light.shape)
                metered = replace(metered, response=response, hot_e_s=None)
            if p.exposure.of != "fixed":
                exposure_s = auto_expose(metered, light, p.exposure.auto, self.noise).detector.parameters.exposure_s
            counts = [
                one.with_exposure(exposure_s).expose(lit, self.noise) for one, lit in zip(windows, lights, strict=True)
            ]
        else:
            # 12 bits in proportion to the light, the left subframe's brightest at three quarters of full scale
            gain = 3071.0 / max(float(np.percentile(lights[0], 98.0)), 1e-9)
            counts = [np.clip(np.rint(gain * one), 0, 4095).astype(np.uint16) for one in lights]
        left, right = (MastImage(values, box.corner) for values, box in zip(counts, boxes, strict=True))
        return StereoPictures(left, right, exposure_s)


class RunOutcome(Enum):
    """How a run ended. Every member but COMPLETED is an expected failure: no position is reported at the goal."""

    COMPLETED = "the run went to its end with the target tracked there"
    NOT_SEEDED = "the target was not found in the first pictures"
    LOST = "the target was lost and not found again"
    OUT_OF_REACH = "the mast or the cameras cannot show the target"
    NO_PATH = "the navigator found no way"
    STUCK = "the steps ran out before the goal"


@dataclass(frozen=True)
class View:
    """The pictures of a stop, with the poses at which they were taken."""

    leg: int  #: number of the leg that led here; -1 for the start
    time_s: float  #: since the start of the run
    stance: Stance  #: truth
    estimated: RigidTransform  #: world pose of the rover as estimated on board
    angles_rad: tuple[float, float]  #: azimuth and elevation of the mast's encoders
    world_from_head: RigidTransform  #: true pose of the mast's head
    pictures: StereoPictures
    drives: tuple[Drive, ...]  #: the commands driven since the stop before


@dataclass(frozen=True)
class Stop(View):
    """A stop at which the target was tracked."""

    update: TargetUpdate  #: the tracker's answer
    details: VttDetails | None  #: details of the answer of one of the project's trackers
    reported_rover: Float64[np.ndarray, "3"] | None  #: in the rover frame; None where the target was not found
    track_time_s: float  #: processor time of the update
    point_px: Float64[np.ndarray, "2"]  #: true full-frame (u, v) of the target in the left picture; NaN outside of it
    point_rover: Float64[np.ndarray, "3"]  #: the designated point in the rover's true frame, metres
    range_m: float  #: from the left camera's true centre to it

    @classmethod
    def of(
        cls, view: View, point_m: Float64[np.ndarray, "3"], left: CameraModel, update: TargetUpdate, track_time_s: float
    ) -> Stop:
        """A view with a tracker's answer; `point_m` is the designated point in the world, `left` the true camera."""
        in_head = np.asarray(view.world_from_head.inv().apply(point_m.copy()))
        return cls(
            **{one.name: getattr(view, one.name) for one in fields(View)},
            update=update,
            details=update.details if isinstance(update.details, VttDetails) else None,
            reported_rover=update.position_rover if update.found else None,
            track_time_s=track_time_s,
            point_px=np.asarray(left.project(in_head)[0]),
            point_rover=np.asarray(view.stance.world_from_rover.inv().apply(point_m.copy())),
            range_m=float(np.linalg.norm(in_head - left.c)),
        )

    def found_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Pixel of the target in the left picture by the tracker; NaN where it was not found.

        Without details of the match the reported position is projected through the calibrated camera.
        """
        if self.reported_rover is None:
            return np.full(2, np.nan)
        if self.details is not None and self.details.match is not None:
            return np.asarray(self.details.match.pixel, dtype=np.float64)
        camera = mast.left.transform(mast.geometry.rover_from_head(*self.angles_rad))
        return np.asarray(camera.project(self.reported_rover)[0], dtype=np.float64)

    def error_m(self) -> Float64[np.ndarray, "3"]:
        """Reported minus true position in the rover frame; NaN where none was reported."""
        return np.full(3, np.nan) if self.reported_rover is None else np.asarray(self.reported_rover - self.point_rover)


#: Directions about a point in which the rock, or ground just behind it, must be visible: else it is on an edge.
_RING_DIRECTIONS = 12
#: Background further behind the point than this fraction of its distance moves against the rock from step to step:
#: the paper's "large discontinuities at occluding boundaries" (5.2). The ground about a small rock, which its template
#: reaches over, is nearer: 3 % behind a 7 cm rock at 4 m, 8 % behind a 12 cm rock at 10 m.
BEHIND_FRACTION = 0.1


@dataclass(frozen=True)
class DesignatedTarget:
    """The designated point of the rock's surface."""

    point_world: Vector
    designation: TargetDesignation
    on_edge: bool  #: whether its template in either first picture shows background well behind the rock
    lit: bool  #: whether the sun shines on it at the start


@dataclass(frozen=True)
class Visibility:
    """Visibility of a point of the rock along a run.

    A patch narrows with the cosine of its obliquity: a turn of 10 deg takes a sixth of its width about 45 deg, and a
    third about 65 deg, which a template that is only scaled and rolled does not follow. Obliquity is the angle between
    the left camera's line of sight and the normal of the surface in the first template; 0 is face-on.
    """

    in_view: bool  #: whether both cameras see it at every stop, its template never on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def choose_target(p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance) -> DesignatedTarget:
    """Choose the point at the parameters' position on the rock's face, as operators pick it from the start.

    It is designated by its true pixel, or by the position that operators triangulate from the pair of pixels. The
    rover's first pictures are taken from there without moving the mast.
    """
    number = world.target_number
    middle = world.rocks.position_m[number] + np.array([0.0, 0.0, 0.5 * world.rocks.height_m[number]])
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(middle)), rig.calibrated, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from the start; start.target_azimuth_deg turns it")
    rig.point(*angles)
    head, readings, calibrated = stance.world_from_rover * rig.rover_from_head, rig.state.readings_rad, rig.calibrated
    target = pick_target(world, rig, head, readings, (p.target.across, p.target.up), p.vtt)
    if p.target.designation == "pixel":
        return target
    in_head = np.asarray(head.inv().apply(target.point_world.copy()))
    left, right = (np.asarray(camera.project(in_head)[0]) for camera in (rig.left, rig.right))
    position = triangulate(calibrated.left, calibrated.right, left, right)
    if position is None:
        raise ValueError("the target cannot be triangulated from the start")
    in_rover = np.asarray(calibrated.geometry.rover_from_head(*readings).apply(position))
    if p.target.designation == "rover":
        return replace(target, designation=RoverTarget(in_rover))
    in_site = np.asarray(SITE_FROM_WORLD.apply(stance.world_from_rover.apply(in_rover)))
    return replace(target, designation=SiteTarget(in_site))


def pick_target(
    world: RunWorld,
    rig: Rig,
    world_from_head: RigidTransform,
    angles_rad: tuple[float, float],
    position: tuple[float, float],
    options: VttOptions,
    picked_from: Vector | None = None,
) -> DesignatedTarget:
    """Pick a point of the rock's face, designated by its true pixel in the left picture.

    `position` is (across, up) as seen from `picked_from`, by default the left camera. The point is on the edge if it is
    on the edge for either camera: point stereo needs it off the edge in the right picture too.
    """
    eyes, triangles = rig.eyes(world_from_head), world.target_triangles
    foot = float(world.rocks.position_m[world.target_number, 2])
    point = points.RockOutline.of(triangles, eyes[0] if picked_from is None else picked_from, foot).point(*position)
    half_rad = 0.5 * options.template_px * rig.pixel_rad
    on_edge = any(_is_on_edge(triangles, foot, eye, point, half_rad) for eye in eyes)
    lit = not bool(points.self_shadowed(triangles, point[None], world.sun.direction(0.0))[0])
    pixel = rig.left.project(np.asarray(world_from_head.inv().apply(point.copy())))[0]
    return DesignatedTarget(point, PixelTarget(np.asarray(pixel), *angles_rad), on_edge, lit)


def evaluate_visibility(
    world: RunWorld, rig: Rig, point: Vector, heads: Sequence[RigidTransform], options: VttOptions
) -> Visibility:
    """Evaluate the visibility of a point of the rock from true poses of the head, world axes."""
    half_rad, triangles = 0.5 * options.template_px * rig.pixel_rad, world.target_triangles
    eyes = [rig.eyes(head) for head in heads]
    normal = points.patch_normal(triangles, eyes[0][0], point, half_rad)
    towards = np.array([left - point for left, _ in eyes])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(towards @ normal, -1.0, 1.0)))
    foot = float(world.rocks.position_m[world.target_number, 2])

    def is_clear(eye: Vector) -> bool:
        near = points.triangles_near_line(triangles, eye, point, half_rad)
        return not points.self_occluded(near, point[None], eye)[0] and not _is_on_edge(near, foot, eye, point, half_rad)

    in_view = all(is_clear(eye) for pair in eyes for eye in pair)
    return Visibility(in_view, float(obliquity_deg[0]), float(obliquity_deg.max()))


def _is_on_edge(triangles: Triangles, foot_m: float, eye: Vector, point: Vector, half_rad: float) -> bool:
    """Whether some line of sight within an angle of the point misses the rock and meets the ground well behind."""
    distance = float(np.linalg.norm(point - eye))
    ahead, right, up = points.sight_axes(point - eye)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_DIRECTIONS, endpoint=False)
    ring = ahead + half_rad * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    # the ground about the rock is taken as level with its foot
    falls = np.maximum(-ring[:, 2], 1e-9)
    visible_m = np.minimum(points.ray_distances(triangles, eye, ring), (eye[2] - foot_m) / falls)
    return bool(np.any(visible_m > (1.0 + BEHIND_FRACTION) * distance))
