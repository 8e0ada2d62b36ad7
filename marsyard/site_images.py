"""Images of a site with ground truth: their request (camera, pose, sun and seed), and their rendering.

Used by the commands `marsyard render` and `gallery`, and by `marsyard.render_view`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt16

from marsyard.scenarios import views
from marsyard.scenarios.radiance import add_haze
from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, check_site_name, is_terrain_file, load_site
from marsyard.scenarios.visible_rocks import add_unresolved_rocks, smallest_rock_rad
from marsyard.sim import sensor
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.rover import MER, settle
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Frame, Objects, PixelRays, Scene, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.rover import rover_objects
from marsyard.sim.sensor.mast import MER_MAST
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Site, sites
from marsyard.sim.terrain.imported import embed

#: Radiance factor that maps to full scale (65535) without a detector model.
FULL_SCALE_RADIANCE_FACTOR = 1.0
#: Minimum and maximum azimuth and elevation of the mast, and steering angle of the front wheels, in hazard images,
#: degrees (assumed).
ROVER_ANGLES_DEG = ((-120.0, -30.0, -10.0), (120.0, 10.0, 10.0))
#: Maximum height of the camera above the ground, m.
MAX_ALTITUDE_M = 20000.0


@dataclass(frozen=True)
class ImageRequest:
    """Site, camera, camera pose, sun direction and seed of an image to render; lengths in metres, angles in degrees."""

    site: str
    camera: str
    scale: str
    altitude_m: float
    east_m: float
    north_m: float
    azimuth_deg: float
    elevation_deg: float
    sun_azimuth_deg: float
    sun_elevation_deg: float
    seed: int
    max_hole_fraction: float

    @classmethod
    def from_defaults(cls, site: str, camera: str, **given: Any) -> ImageRequest:
        """Create a request with the camera's default pose, changed by `given`; raises ValueError if invalid."""
        if not is_terrain_file(site):
            check_site_name(site)
            _check_name("site", site, sites())
        _check_name("camera", camera, sensor.PRESETS)
        mounting = views.CAMERA_MOUNTINGS[camera]
        defaults = {"scale": mounting.scale, "altitude_m": mounting.height_m, "elevation_deg": mounting.elevation_deg}
        defaults |= dict.fromkeys(("east_m", "north_m", "azimuth_deg"), 0.0)
        defaults |= {"sun_azimuth_deg": 250.0, "sun_elevation_deg": 35.0}
        defaults |= {"seed": 1, "max_hole_fraction": MAX_HOLE_FRACTION}
        changes = {name: value for name, value in given.items() if value is not None}
        if is_terrain_file(site):  # the DTM is centred in the periodic terrain
            terrain = load_site(site, float(changes.get("max_hole_fraction", MAX_HOLE_FRACTION))).terrain()
            defaults |= dict.fromkeys(("east_m", "north_m"), 0.5 * terrain.samples * terrain.spacing_m)
        request = cls(site=site, camera=camera, **(defaults | changes))
        request._check()
        return request

    @property
    def site_definition(self) -> Site:
        """The preset site, or the site created from the DTM file. Raises ValueError if the file is not usable."""
        return load_site(self.site, self.max_hole_fraction)

    def _check(self) -> None:
        ranges = {
            "altitude": (self.altitude_m, 0.0, MAX_ALTITUDE_M),
            "elevation": (self.elevation_deg, -90.0, 90.0),
            "sun-elevation": (self.sun_elevation_deg, 0.0, 90.0),
        }
        for name, (value, low, high) in ranges.items():
            # a camera may look straight down, but is above the ground, and the sun above the horizon
            includes_low = name == "elevation"
            if not (low <= value <= high) or (value == low and not includes_low):
                allowed = f"{low:g}" if includes_low else f"more than {low:g}"
                raise ValueError(f"--{name} {value:g} is out of range; allowed: {allowed} to {high:g}")
        for name in ("east_m", "north_m", "azimuth_deg", "sun_azimuth_deg"):
            if not math.isfinite(value := getattr(self, name)):
                option = name.rpartition("_")[0].replace("_", "-")
                raise ValueError(f"--{option} {value} is not a finite number")
        scales = [scale for scale in ("descent", "ground") if getattr(self.site_definition, scale) is not None]
        if self.scale not in scales:
            raise ValueError(
                f"site {self.site} has no terrain at the scale '{self.scale}', which camera {self.camera} needs; "
                f"allowed --scale: {', '.join(scales)}"
            )


@dataclass(frozen=True)
class RenderedImage:
    """Rendered image of a single camera, or of one camera of a stereo pair, with ground truth."""

    suffix: str  #: ``-left`` or ``-right`` for a stereo pair; empty for a single camera
    camera_world: CameraModel  #: camera model in the world frame
    camera_body: CameraModel  #: camera model in the body frame, as written to the file
    frame: Frame  #: radiance and ground truth
    scene: Scene
    auto_exposure: sensor.AutoExposure | None  #: detector with automatic exposure time; None without detector
    counts: UInt16[np.ndarray, "rows columns"] | None  #: None without detector
    #: whether a pixel shows a filled hole of a DTM; None for a preset site
    filled: Bool[np.ndarray, "rows columns"] | None

    def to_uint16(self) -> UInt16[np.ndarray, "rows columns"]:
        """Return the counts shifted to the upper bits, or the radiance factor scaled to 65535 at full scale."""
        if self.auto_exposure is not None and self.counts is not None:
            return np.asarray(self.counts * np.uint16(self.count_scale))
        fraction = np.clip(self.frame.radiance / FULL_SCALE_RADIANCE_FACTOR, 0.0, 1.0)
        return np.asarray(np.rint(65535.0 * fraction).astype(np.uint16))

    @property
    def count_scale(self) -> int:
        """Factor that scales the counts to 16 bits; 1 without detector."""
        return 1 if self.auto_exposure is None else int(2 ** (16 - self.auto_exposure.detector.parameters.bits))


def _check_name(kind: str, name: str, names: Iterable[str]) -> None:
    """Raise ValueError for an unknown name; the message lists similar names."""
    allowed = list(names)
    if name in allowed:
        return
    similar = get_close_matches(name, allowed, n=1) or [item for item in allowed if name and name in item]
    hint = f"; did you mean {' or '.join(similar)}?" if similar else "."
    raise ValueError(f"no {kind} is called '{name}'{hint} Allowed: {', '.join(allowed)}")


def render_images(
    request: ImageRequest, *, detector: bool = True, both: bool = True, note: Callable[[str], None] = lambda _: None
) -> list[RenderedImage]:
    """Render the requested image. A stereo camera has two images; with `both` False, only the left one is rendered.

    `note` is called at the start of each stage, with its name.
    """
    preset, site = sensor.preset(request.camera), request.site_definition
    note(f"terrain and rocks of {request.site}")
    ground = views.SiteGround.from_site(site, "descent" if request.scale == "descent" else "ground", seed=request.seed)
    cameras = preset.cameras()
    position = (request.east_m, request.north_m, request.altitude_m)
    pose = views.camera_pose(ground.surface, preset.design, *position, request.azimuth_deg, request.elevation_deg)
    sun_direction = direction(np.radians(request.sun_azimuth_deg), np.radians(request.sun_elevation_deg))
    sun = Sun(sun_direction, ground.site.environment.sun_radius_rad)
    rendered_cameras = cameras if both else cameras[:1]
    rays = [PixelRays.from_camera(camera) for camera in rendered_cameras]
    # The baseline of a stereo pair is short: both cameras use the scene built for the left camera.
    viewpoint = views.Viewpoint.from_pose(rays[0], pose, ground.surface)
    scene = _add_rover(views.site_scene(ground, viewpoint, sun), request, ground)
    smallest_rad = smallest_rock_rad(ground.rocks, viewpoint) if ground.rocks is not None else 0.0
    rms_slope = math.tan(math.radians(ground.terrain.rms_slope_deg))
    images = []
    for number, camera in enumerate(rendered_cameras):
        note(f"image {number + 1} of {len(rendered_cameras)}")
        frame = process_renderer(default_backend()).render(scene, rays[number], pose)
        frame = add_unresolved_rocks(frame, scene, ground.rocks, smallest_rad, rms_slope)
        exposure, counts = _expose(request, ground, camera, number, frame, sun) if detector else (None, None)
        suffix = "" if len(cameras) == 1 else ("-left", "-right")[number]
        filled = _mark_filled(ground, frame)
        images.append(RenderedImage(suffix, camera.transform(pose), camera, frame, scene, exposure, counts, filled))
    return images


def _add_rover(scene: Scene, request: ImageRequest, ground: views.SiteGround) -> Scene:
    """Add the rover on which the camera is mounted: level, with its mounting point at the camera's position."""
    position_on_rover = views.CAMERA_MOUNTINGS[request.camera].on_rover_m
    if position_on_rover is None:
        return scene
    camera = views.mast_pose(
        ground.surface, request.east_m, request.north_m, request.altitude_m, request.azimuth_deg, 0.0
    )
    world_from_rover = rigid(camera.rotation, camera.apply(-np.array(position_on_rover)))
    # the joints follow the ground; each seed has its own directions of mast and front wheels
    x, y, _ = world_from_rover.translation
    settled = settle(MER, ground.surface, float(x), float(y), math.radians(request.azimuth_deg))
    stance = replace(settled, world_from_rover=world_from_rover)
    rng = Streams(request.seed, "render", 0).generator("rover pose")
    azimuth, elevation, steering = np.radians(rng.uniform(*np.array(ROVER_ANGLES_DEG))).tolist()
    rover = rover_objects(MER, stance, MER_MAST, azimuth, elevation, steering_rad=steering)
    return scene.with_objects(Objects.join([scene.objects, rover]))


def _mark_filled(ground: views.SiteGround, frame: Frame) -> Bool[np.ndarray, "rows columns"] | None:
    """Mark the pixels that show filled holes of a DTM; None for a preset site."""
    terrain = ground.terrain
    if terrain.source is None:
        return None
    holes = embed(terrain.source, terrain.samples, terrain.spacing_m).filled_samples(terrain.samples)
    is_ground = np.isfinite(frame.range_m)
    points = np.where(is_ground[..., None], frame.points_world(), 0.0)
    column, row = (np.rint(points[..., axis] / terrain.spacing_m).astype(int) % terrain.samples for axis in (0, 1))
    return np.asarray(is_ground & holes[row, column])


def _expose(
    request: ImageRequest, ground: views.SiteGround, camera: CameraModel, number: int, frame: Frame, sun: Sun
) -> tuple[sensor.AutoExposure, UInt16[np.ndarray, "rows columns"]]:
    """Simulate the detector with automatic exposure time and without summed rows; return the detector and counts.

    `number` of the camera, 1 for the right one of a pair, selects its random streams.
    """
    streams = Streams(request.seed, "render", number)
    preset, environment = sensor.preset(request.camera), ground.site.environment
    # the preset may be defined for the sun distance of another planet
    sun_au = 1.0 / math.sqrt(environment.solar_irradiance)
    sunlight = {"responsivity_e_s": preset.light.responsivity_e_s(sun_au), "sun_au": sun_au}
    parameters = preset.detector.model_copy(update={**sunlight, "rows_summed": 1})
    detector = sensor.Detector.draw(sensor.natural_fall_off(camera), parameters, streams.generator("detector response"))
    # the rendered radiance factor I/F is relative to the solar irradiance at the ground, the detector's I/F to that at
    # the top of the atmosphere
    position = np.asarray(frame.world_from_body.translation)
    height = float(position[2]) - float(ground.surface.height(*position[:2]))
    hazy_radiance = add_haze(frame, environment, sun, environment.mean_extinction_m(height))
    radiance = hazy_radiance * np.float32(environment.direct_fraction(math.radians(request.sun_elevation_deg)))
    # the name of a random stream determines its values, so that it must not change
    auto_exposure = sensor.auto_expose(
        detector, radiance, sensor.AutoExposureParameters(), streams.generator("exposure images")
    )
    counts = auto_exposure.detector.expose(radiance, streams.generator("detector noise"))
    return auto_exposure, counts
