"""Pictures of a site with truth layers, camera model and record of their inputs, for `render` and `gallery`."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt16

from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, is_terrain_file, site_or_file
from marsyard.scenarios.views import STANCES, Eye, SiteGround, camera_pose, site_scene
from marsyard.sim import sensor
from marsyard.sim.camera import BODY_FRAME, CameraModel, write_cahvor
from marsyard.sim.frames import direction
from marsyard.sim.render import Frame, PixelRays, Scene, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Site, sites
from marsyard.sim.terrain.imported import embed

#: Files of a picture: 16-bit picture, truth layers, camera model, and record of its inputs.
ENDINGS = (".png", ".npz", ".cahvor", ".json")
#: Radiance factor of the largest number in a picture without detector.
FULL_SCALE_RADIANCE_FACTOR = 1.0
MAX_ALTITUDE_M = 20000.0


@dataclass(frozen=True)
class Shot:
    """Site, camera pose and sun of a picture."""

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
    def usual(cls, site: str, camera: str, **settings: Any) -> Shot:
        """A picture from the camera's usual pose with these settings. Raises ValueError for an invalid one."""
        if not is_terrain_file(site):
            _check_name("site", site, sites())
        _check_name("camera", camera, sensor.PRESETS)
        stance = STANCES[camera]
        usual = {"scale": stance.scale, "altitude_m": stance.height_m, "elevation_deg": stance.elevation_deg}
        usual |= dict.fromkeys(("east_m", "north_m", "azimuth_deg"), 0.0)
        usual |= {"sun_azimuth_deg": 250.0, "sun_elevation_deg": 35.0}
        usual |= {"seed": 1, "max_hole_fraction": MAX_HOLE_FRACTION}
        given = {name: value for name, value in settings.items() if value is not None}
        if is_terrain_file(site):  # it lies in the middle of the periodic terrain
            terrain = site_or_file(site, float(given.get("max_hole_fraction", MAX_HOLE_FRACTION))).terrain()
            usual |= dict.fromkeys(("east_m", "north_m"), 0.5 * terrain.samples * terrain.spacing_m)
        shot = cls(site=site, camera=camera, **(usual | given))
        shot._check()
        return shot

    @property
    def site_definition(self) -> Site:
        """The site, or that of the terrain model's file. Raises ValueError where it cannot be used."""
        return site_or_file(self.site, self.max_hole_fraction)

    def _check(self) -> None:
        ranges = {
            "altitude": (self.altitude_m, 0.0, MAX_ALTITUDE_M),
            "elevation": (self.elevation_deg, -90.0, 90.0),
            "sun-elevation": (self.sun_elevation_deg, 0.0, 90.0),
        }
        for name, (value, low, high) in ranges.items():
            above = value >= low if name == "elevation" else value > low
            if not (above and value <= high):
                allowed = f"{low:g}" if name == "elevation" else f"more than {low:g}"
                raise ValueError(f"--{name} {value:g} is out of range; allowed: {allowed} to {high:g}")
        for name in ("east_m", "north_m", "azimuth_deg", "sun_azimuth_deg"):
            if not math.isfinite(value := getattr(self, name)):
                option = name.rpartition("_")[0].replace("_", "-")
                raise ValueError(f"--{option} {value} is not a finite number")
        scales = [scale for scale in ("descent", "ground") if getattr(self.site_definition, scale) is not None]
        if self.scale not in scales:
            raise ValueError(
                f"site {self.site} has no terrain at the scale '{self.scale}', from which camera {self.camera} is to "
                f"look; with --scale: {', '.join(scales)}"
            )


@dataclass(frozen=True)
class Picture:
    """A picture of one camera, or of one of a pair."""

    suffix: str  #: ``-left`` or ``-right`` of a pair; empty for a single camera
    camera: CameraModel  #: in the world frame
    mounted: CameraModel  #: in the body frame, as written to the file
    frame: Frame  #: radiance and truth
    scene: Scene
    exposed: sensor.AutoExposure | None  #: the detector at its automatic exposure time; None without detector
    counts: UInt16[np.ndarray, "rows columns"] | None  #: None without detector
    #: whether a pixel sees a filled hole of a terrain model; None on a preset's ground
    filled: Bool[np.ndarray, "rows columns"] | None

    def sixteen_bit(self) -> UInt16[np.ndarray, "rows columns"]:
        """Counts shifted to the upper bits, or radiance factor in 65535ths of the full scale."""
        if self.exposed is not None and self.counts is not None:
            return np.asarray(self.counts * np.uint16(self.multiplied_by))
        fraction = np.clip(self.frame.radiance / FULL_SCALE_RADIANCE_FACTOR, 0.0, 1.0)
        return np.asarray(np.rint(65535.0 * fraction).astype(np.uint16))

    @property
    def multiplied_by(self) -> int:
        """Factor of the counts that fills 16 bits; 1 without detector."""
        return 1 if self.exposed is None else int(2 ** (16 - self.exposed.detector.parameters.bits))


def take(shot: Shot, *, detector: bool = True, both: bool = True) -> list[Picture]:
    """Take the picture; of a stereo pair both, or the left one alone."""
    ground = SiteGround.of(shot.site_definition, "descent" if shot.scale == "descent" else "ground", seed=shot.seed)
    of_camera = sensor.preset(shot.camera)
    cameras = of_camera.cameras()
    position = (shot.east_m, shot.north_m, shot.altitude_m)
    pose = camera_pose(ground.surface, of_camera.design, *position, shot.azimuth_deg, shot.elevation_deg)
    towards_sun = direction(np.radians(shot.sun_azimuth_deg), np.radians(shot.sun_elevation_deg))
    sun = Sun(towards_sun, ground.site.environment.sun_radius_rad)
    selected = cameras if both else cameras[:1]
    rays = [PixelRays.of(camera) for camera in selected]
    # The cameras of a pair are so close together that one scene serves both.
    scene = site_scene(ground, Eye.of(rays[0], pose, ground.surface), sun)
    pictures = []
    for number, camera in enumerate(selected):
        frame = process_renderer(default_backend()).render(scene, rays[number], pose)
        exposed, counts = _expose(shot, ground, camera, number, frame) if detector else (None, None)
        suffix = "" if len(cameras) == 1 else ("-left", "-right")[number]
        filled = _mark_filled(ground, frame)
        pictures.append(Picture(suffix, camera.transform(pose), camera, frame, scene, exposed, counts, filled))
    return pictures


def _mark_filled(ground: SiteGround, frame: Frame) -> Bool[np.ndarray, "rows columns"] | None:
    """Mark the pixels that see ground in holes of a terrain model; None for the ground of a preset."""
    terrain = ground.terrain
    if terrain.source is None:
        return None
    holes = embed(terrain.source, terrain.samples, terrain.spacing_m).filled_samples(terrain.samples)
    visible = np.isfinite(frame.range_m)
    points = np.where(visible[..., None], frame.points_world(), 0.0)
    column, row = (np.rint(points[..., axis] / terrain.spacing_m).astype(int) % terrain.samples for axis in (0, 1))
    return np.asarray(visible & holes[row, column])


def _expose(
    shot: Shot, ground: SiteGround, camera: CameraModel, number: int, frame: Frame
) -> tuple[sensor.AutoExposure, UInt16[np.ndarray, "rows columns"]]:
    """Expose the camera's detector at the site automatically; its rows are not summed."""
    streams = Streams(shot.seed, "render", number)
    of_camera, air = sensor.preset(shot.camera), ground.site.environment
    # The preset's light may be another planet's.
    sun_au = 1.0 / math.sqrt(air.solar_irradiance)
    lit = {"responsivity_e_s": of_camera.light.responsivity_e_s(sun_au), "sun_au": sun_au}
    parameters = of_camera.detector.model_copy(update={**lit, "rows_summed": 1})
    detector = sensor.Detector.draw(sensor.natural_fall_off(camera), parameters, streams.generator("detector response"))
    # the frame's radiance factor is over the sunlight at the ground; the detector's is over that above the air
    radiance = frame.radiance * np.float32(air.direct_share(math.radians(shot.sun_elevation_deg)))
    exposed = sensor.auto_expose(
        detector, radiance, sensor.AutoExposureParameters(), streams.generator("test pictures")
    )
    return exposed, exposed.detector.expose(radiance, streams.generator("detector noise"))


def layers(picture: Picture) -> dict[str, Any]:
    """The truth layers, each of the picture's rows and columns, and the pose."""
    frame, scene = picture.frame, picture.scene
    directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
    phase = np.degrees(np.arccos(np.clip(-(directions @ scene.sun.direction), -1.0, 1.0)))
    ground = np.isfinite(frame.range_m)
    # Rendered again with the sun alone: black pixels have no direct light.
    direct = replace(scene.photometry, sky_share=0.0, sky_radiance=0.0, surrounding_albedo=0.0)
    by_sun = process_renderer(default_backend()).render(
        replace(scene, photometry=direct, edge_rays=1), frame.rays, frame.world_from_body
    )
    names = np.append(scene.objects.names, [-2, -1])  # the last two: bodies -2 (sky) and -1 (ground)
    return {
        "radiance_factor": frame.radiance,
        "range_m": frame.range_m,
        "point_m": frame.points_world(),
        "normal": frame.normal,
        "object": names[frame.body].astype(np.int32),
        "shadow": ground & (by_sun.radiance <= 0.0),
        "phase_deg": np.where(ground, phase.reshape(ground.shape), np.nan).astype(np.float32),
        "world_from_body": frame.world_from_body.as_matrix(),
        **({} if picture.filled is None else {"filled": picture.filled}),
    }


def write(picture: Picture, shot: Shot, prefix: Path) -> list[Path]:
    """Write a picture's files and return their paths."""
    png, npz, cahvor, sidecar = (_path(prefix, picture.suffix, ending) for ending in ENDINGS)
    done, encoded = cv2.imencode(".png", picture.sixteen_bit())
    if not done:
        raise ValueError(f"{png} could not be encoded")
    png.write_bytes(encoded.tobytes())
    with npz.open("wb") as file:
        np.savez(file, **layers(picture))
    write_cahvor(picture.mounted, cahvor, f"{shot.camera}{picture.suffix} at {shot.site}", frame=BODY_FRAME)
    sidecar.write_text(json.dumps(record(picture, shot), indent=2) + "\n", encoding="utf-8")
    return [png, npz, cahvor, sidecar]


def record(picture: Picture, shot: Shot) -> dict[str, Any]:
    """All inputs of a picture, and the meaning of its numbers."""
    columns, rows = picture.camera.size
    scene, exposed, detector = picture.scene, picture.exposed, None
    meaning: dict[str, Any] = {
        "holds": "radiance factor (I/F) over the sunlight that reaches the ground",
        "full_scale_radiance_factor": FULL_SCALE_RADIANCE_FACTOR,
    }
    if exposed is not None:
        detector = exposed.detector.parameters
        meaning = {
            "holds": "counts of the detector, in the upper bits",
            "multiplied_by": picture.multiplied_by,
            "exposure_s": detector.exposure_s,
            "auto_exposure_converged": exposed.converged,
        }
    return {
        "marsyard": version("marsyard"),
        "shot": asdict(shot),
        "picture": picture.suffix.lstrip("-") or "single",
        "size": {"columns": columns, "rows": rows},
        "png": meaning,
        "npz": {
            "object": "number of the rock seen; -1 ground, -2 sky",
            "shadow": "no direct sunlight: a cast shadow, or a face turned away from the sun",
            "frame": "world: x east, y north (of a DTM the grid's north), z up, metres",
            "filled": "the ground is in a hole of the DTM, which is filled",
        },
        "cahvor": {"frame": "body; world_from_body takes it to the world"},
        "filled_fraction": None if picture.filled is None else float(picture.filled.mean()),
        "world_from_body": picture.frame.world_from_body.as_matrix().tolist(),
        "sun_direction": scene.sun.direction.tolist(),
        "photometry": asdict(scene.photometry),
        "mesh": {name: getattr(scene, name) for name in ("mesh_finest_m", "mesh_reach_m", "mesh_lines")},
        "rocks_drawn": len(scene.objects),
        "site": shot.site_definition.model_dump(mode="json"),
        "detector": None if detector is None else detector.model_dump(mode="json"),
        "gl_backend": default_backend(),
    }


def _path(prefix: Path, suffix: str, ending: str) -> Path:
    return prefix.with_name(f"{prefix.name}{suffix}{ending}")


def check_files(prefix: Path, camera: str, overwrite: bool) -> None:
    """Raise ValueError where the files cannot be written, or exist and may not be replaced."""
    folder = prefix.parent
    if prefix.name in ("", ".", ".."):
        raise ValueError(f"--out {prefix} names no file; a path without ending is needed, such as pictures/gusev")
    if not folder.is_dir():
        raise ValueError(f"--out {prefix}: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"--out {prefix}: the folder {folder} cannot be written to")
    suffixes = ("",) if sensor.preset(camera).design.baseline_m is None else ("-left", "-right")
    paths = [_path(prefix, suffix, ending) for suffix in suffixes for ending in ENDINGS]
    existing = [str(path) for path in paths if path.exists()]
    if existing and not overwrite:
        raise ValueError(f"{', '.join(existing)}: there already; --overwrite replaces what is there")


def _check_name(kind: str, name: str, names: Iterable[str]) -> None:
    """Raise ValueError for an unknown name, with similar names."""
    allowed = list(names)
    if name in allowed:
        return
    close = get_close_matches(name, allowed, n=1) or [one for one in allowed if name and name in one]
    meant = f"; did you mean {' or '.join(close)}?" if close else "."
    raise ValueError(f"no {kind} is called '{name}'{meant} Allowed: {', '.join(allowed)}")
