"""`marsyard render`: a picture of a site with its truth layers, camera model and inputs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from marsyard.cli.options import MaxHolesOption, OverwriteOption, SiteArgument, fail, with_options

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Bool, Float32, UInt16

    from marsyard.scenarios.views import SiteGround
    from marsyard.sim.camera import CameraModel
    from marsyard.sim.render import Frame, Scene
    from marsyard.sim.sensor import AutoExposure
    from marsyard.sim.terrain import Site

#: Files of a picture: 16-bit picture, truth layers, camera model, and record of its inputs.
ENDINGS = (".png", ".npz", ".cahvor", ".json")
#: Radiance factor of the largest number in a picture without detector.
FULL_SCALE_RADIANCE_FACTOR = 1.0
HIGHEST_M = 20000.0


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
        from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, is_terrain_file, site_or_file
        from marsyard.scenarios.views import STANCES
        from marsyard.sim.sensor import PRESETS
        from marsyard.sim.terrain import sites

        if not is_terrain_file(site):
            _check_name("site", site, sites())
        _check_name("camera", camera, PRESETS)
        stance = STANCES[camera]
        usual = {
            "scale": stance.scale,
            "altitude_m": stance.height_m,
            "east_m": 0.0,
            "north_m": 0.0,
            "azimuth_deg": 0.0,
            "elevation_deg": stance.elevation_deg,
            "sun_azimuth_deg": 250.0,
            "sun_elevation_deg": 35.0,
            "seed": 1,
            "max_hole_fraction": MAX_HOLE_FRACTION,
        }
        given = {name: value for name, value in settings.items() if value is not None}
        if is_terrain_file(site):  # it lies in the middle of the periodic terrain
            terrain = site_or_file(site, float(given.get("max_hole_fraction", MAX_HOLE_FRACTION))).terrain()
            usual |= dict.fromkeys(("east_m", "north_m"), 0.5 * terrain.samples * terrain.spacing_m)
        shot = cls(site=site, camera=camera, **(usual | given))
        shot._check()
        return shot

    @property
    def place(self) -> Site:
        """The site, or that of the terrain model's file. Raises ValueError where it cannot be used."""
        from marsyard.scenarios.terrain_files import site_or_file

        return site_or_file(self.site, self.max_hole_fraction)

    def _check(self) -> None:
        ranges = {
            "altitude": (self.altitude_m, 0.0, HIGHEST_M),
            "elevation": (self.elevation_deg, -90.0, 90.0),
            "sun-elevation": (self.sun_elevation_deg, 0.0, 90.0),
        }
        for name, (value, low, high) in ranges.items():
            above = value >= low if name == "elevation" else value > low
            if not (above and value <= high):
                least = f"{low:g}" if name == "elevation" else f"more than {low:g}"
                raise ValueError(f"--{name} {value:g} is out of range; allowed: {least} to {high:g}")
        free = {"east": self.east_m, "north": self.north_m, "azimuth": self.azimuth_deg}
        for name, value in (free | {"sun-azimuth": self.sun_azimuth_deg}).items():
            if not math.isfinite(value):
                raise ValueError(f"--{name} {value} is not a finite number")
        known = self.place
        scales = [scale for scale in ("descent", "ground") if getattr(known, scale) is not None]
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
    exposed: AutoExposure | None  #: the detector at its automatic exposure time; None without detector
    counts: UInt16[np.ndarray, "rows columns"] | None  #: None without detector
    #: whether a pixel sees a filled hole of a terrain model; None on a preset's ground
    filled: Bool[np.ndarray, "rows columns"] | None

    def sixteen_bit(self) -> UInt16[np.ndarray, "rows columns"]:
        """Counts shifted to the upper bits, or radiance factor in 65535ths of the full scale."""
        import numpy as np

        if self.exposed is not None and self.counts is not None:
            multiplied: UInt16[np.ndarray, "rows columns"] = self.counts * np.uint16(self.multiplied_by)
            return multiplied
        share = np.clip(self.frame.radiance / FULL_SCALE_RADIANCE_FACTOR, 0.0, 1.0)
        scaled: UInt16[np.ndarray, "rows columns"] = np.rint(65535.0 * share).astype(np.uint16)
        return scaled

    @property
    def multiplied_by(self) -> int:
        """Factor of the counts that fills 16 bits; 1 without detector."""
        return 1 if self.exposed is None else int(2 ** (16 - self.exposed.detector.parameters.bits))


@dataclass(frozen=True)
class RenderOptions:
    """Arguments and options of `marsyard render`."""

    site: SiteArgument
    camera: Annotated[str, Option("--camera", metavar="NAME", help="Such as mer-navcam; a wrong name lists all.")]
    out: Annotated[Path, Option("--out", metavar="PREFIX", help="Path of the files without extension.")]
    scale: Annotated[
        str | None, Option("--scale", metavar="SCALE", help="descent or ground; by default the camera's.")
    ] = None
    altitude: Annotated[
        float | None, Option("--altitude", metavar="M", help="Height above the ground; by default the camera's.")
    ] = None
    east: Annotated[
        float | None, Option("--east", metavar="M", help="By default 0, or the middle of a DTM; periodic.")
    ] = None
    north: Annotated[
        float | None, Option("--north", metavar="M", help="By default 0, or the middle of a DTM; periodic.")
    ] = None
    azimuth: Annotated[float, Option("--azimuth", metavar="DEG", help="Viewing direction, clockwise from north.")] = 0.0
    elevation: Annotated[float | None, Option("--elevation", metavar="DEG", help="Of the optical axis; -90: down.")] = (
        None
    )
    sun_azimuth: Annotated[float, Option("--sun-azimuth", metavar="DEG", help="Clockwise from north.")] = 250.0
    sun_elevation: Annotated[float, Option("--sun-elevation", metavar="DEG", help="Above the horizon.")] = 35.0
    detector: Annotated[bool, Option("--detector/--radiance", help="Detector counts, or radiance factor.")] = True
    seed: Annotated[int, Option("--seed", metavar="S", min=0, help="Of the terrain and the noise.")] = 1
    overwrite: OverwriteOption = False
    max_holes: MaxHolesOption = None


@with_options(RenderOptions)
def render(given: RenderOptions) -> None:
    """Render a site or DTM: PREFIX.png (16 bits), .npz (truth), .cahvor (camera), .json; -left, -right of a pair."""
    with report_picture_errors(given.out):
        shot = Shot.usual(
            given.site,
            given.camera,
            scale=given.scale,
            altitude_m=given.altitude,
            east_m=given.east,
            north_m=given.north,
            azimuth_deg=given.azimuth,
            elevation_deg=given.elevation,
            sun_azimuth_deg=given.sun_azimuth,
            sun_elevation_deg=given.sun_elevation,
            seed=given.seed,
            max_hole_fraction=given.max_holes,
        )
        _check_files(given.out, given.camera, given.overwrite)
        for picture in take(shot, detector=given.detector):
            if picture.filled is not None and picture.filled.any():
                share = f"{picture.filled.mean():.1%} of the pixels{picture.suffix and f' ({picture.suffix[1:]})'}"
                typer.echo(f"note: {share} see filled holes of the DTM (`filled` in the .npz)", err=True)
            typer.echo(", ".join(str(path) for path in write(picture, shot, given.out)))


@contextmanager
def report_picture_errors(out: Path) -> Iterator[None]:
    """End the command with status 2 where pictures cannot be rendered or written."""
    from marsyard.sim.render.backend import RenderingError

    try:
        yield
    except (ValueError, RenderingError) as error:
        fail(error)
    except OSError as error:
        fail(f"cannot write to {out}: {error}")


def take(shot: Shot, *, detector: bool = True, both: bool = True) -> list[Picture]:
    """The picture; of a stereo pair both, or the left one alone."""
    import numpy as np

    from marsyard.scenarios.views import Eye, SiteGround, camera_pose, site_scene
    from marsyard.sim.frames import direction
    from marsyard.sim.render import PixelRays, Sun, process_renderer
    from marsyard.sim.render.backend import default_backend
    from marsyard.sim.sensor import preset

    ground = SiteGround.of(shot.place, "descent" if shot.scale == "descent" else "ground", seed=shot.seed)
    of_camera = preset(shot.camera)
    cameras = of_camera.cameras()
    place = (shot.east_m, shot.north_m, shot.altitude_m)
    pose = camera_pose(ground.surface, of_camera.design, *place, shot.azimuth_deg, shot.elevation_deg)
    towards_sun = direction(np.radians(shot.sun_azimuth_deg), np.radians(shot.sun_elevation_deg))
    sun = Sun(towards_sun, ground.site.environment.sun_radius_rad)
    taken = cameras if both else cameras[:1]
    rays = [PixelRays.of(camera) for camera in taken]
    # The cameras of a pair are so close together that one scene serves both.
    scene = site_scene(ground, Eye.of(rays[0], pose, ground.surface), sun)
    pictures = []
    for number, camera in enumerate(taken):
        frame = process_renderer(default_backend()).render(scene, rays[number], pose)
        exposed, counts = _exposed(shot, ground, camera, number, frame) if detector else (None, None)
        suffix = "" if len(cameras) == 1 else ("-left", "-right")[number]
        filled = _filled(ground, frame)
        pictures.append(Picture(suffix, camera.moved(pose), camera, frame, scene, exposed, counts, filled))
    return pictures


def _filled(ground: SiteGround, frame: Frame) -> Bool[np.ndarray, "rows columns"] | None:
    """Which pixels see ground in holes of a terrain model; None where the ground is a preset's."""
    import numpy as np

    from marsyard.sim.terrain.imported import embed

    terrain = ground.terrain
    if terrain.source is None:
        return None
    holes = embed(terrain.source, terrain.samples, terrain.spacing_m).filled_samples(terrain.samples)
    seen = np.isfinite(frame.range_m)
    points = np.where(seen[..., None], frame.points_world(), 0.0)
    column, row = (np.rint(points[..., axis] / terrain.spacing_m).astype(int) % terrain.samples for axis in (0, 1))
    return np.asarray(seen & holes[row, column])


def _exposed(
    shot: Shot, ground: SiteGround, camera: CameraModel, number: int, frame: Frame
) -> tuple[AutoExposure, UInt16[np.ndarray, "rows columns"]]:
    """What the camera's detector delivers at the site, exposed automatically; its rows are not summed."""
    from marsyard.sim.sensor import AutoExposureParameters, Detector, auto_expose, natural_fall_off, preset
    from marsyard.sim.streams import Streams

    streams = Streams(shot.seed, "render", number)
    of_camera, air = preset(shot.camera), ground.site.environment
    # The preset's light may be another planet's.
    sun_au = 1.0 / math.sqrt(air.solar_irradiance)
    lit = {"responsivity_e_s": of_camera.light.responsivity_e_s(sun_au), "sun_au": sun_au}
    parameters = of_camera.detector.model_copy(update={**lit, "rows_summed": 1})
    detector = Detector.drawn(natural_fall_off(camera), parameters, streams.generator("detector response"))
    radiance = _above_air(ground, shot, frame)
    exposed = auto_expose(detector, radiance, AutoExposureParameters(), streams.generator("test pictures"))
    return exposed, exposed.detector.expose(radiance, streams.generator("detector noise"))


def _above_air(ground: SiteGround, shot: Shot, frame: Frame) -> Float32[np.ndarray, "rows columns"]:
    """Radiance factor over sunlight above the air: the frame's is over the sunlight that reaches the ground."""
    import numpy as np

    share = ground.site.environment.direct_share(math.radians(shot.sun_elevation_deg))
    return frame.radiance * np.float32(share)


def layers(picture: Picture) -> dict[str, Any]:
    """The truth layers, each of the picture's rows and columns, and the pose."""
    import numpy as np

    from marsyard.sim.render import process_renderer
    from marsyard.sim.render.backend import default_backend

    frame, scene = picture.frame, picture.scene
    directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
    phase = np.degrees(np.arccos(np.clip(-(directions @ scene.sun.direction), -1.0, 1.0)))
    ground = np.isfinite(frame.range_m)
    # Drawn once more by the sun alone: what stays black has no direct light.
    direct = replace(scene.photometry, sky_share=0.0, sky_radiance=0.0, surrounding_albedo=0.0)
    by_sun = process_renderer(default_backend()).render(
        replace(scene, photometry=direct, edge_rays=1), frame.rays, frame.world_from_body
    )
    names = np.append(scene.objects.names, [-2, -1])  # the last two: what bodies -2 and -1 stand for
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
    import json

    import cv2
    import numpy as np

    from marsyard.sim.camera import BODY_FRAME, write_cahvor

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
    from importlib.metadata import version

    from marsyard.sim.render.backend import default_backend

    columns, rows = picture.camera.size
    scene, exposed = picture.scene, picture.exposed
    if exposed is None:
        meaning: dict[str, Any] = {
            "holds": "radiance factor (I/F) over the sunlight that reaches the ground",
            "full_scale_radiance_factor": FULL_SCALE_RADIANCE_FACTOR,
        }
    else:
        meaning = {
            "holds": "counts of the detector, in the upper bits",
            "multiplied_by": picture.multiplied_by,
            "exposure_s": exposed.detector.parameters.exposure_s,
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
        "site": shot.place.model_dump(mode="json"),
        "detector": None if exposed is None else exposed.detector.parameters.model_dump(mode="json"),
        "gl_backend": default_backend(),
    }


def _path(prefix: Path, suffix: str, ending: str) -> Path:
    return prefix.with_name(f"{prefix.name}{suffix}{ending}")


def _check_files(prefix: Path, camera: str, overwrite: bool) -> None:
    """Raise ValueError where the files cannot be written, or exist and may not be replaced."""
    from marsyard.sim.sensor import preset

    folder = prefix.parent
    if prefix.name in ("", ".", ".."):
        raise ValueError(f"--out {prefix} names no file; a path without ending is needed, such as pictures/gusev")
    if not folder.is_dir():
        raise ValueError(f"--out {prefix}: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"--out {prefix}: the folder {folder} cannot be written to")
    suffixes = ("",) if preset(camera).design.baseline_m is None else ("-left", "-right")
    paths = [_path(prefix, suffix, ending) for suffix in suffixes for ending in ENDINGS]
    there = [str(path) for path in paths if path.exists()]
    if there and not overwrite:
        raise ValueError(f"{', '.join(there)}: there already; --overwrite replaces what is there")


def _check_name(kind: str, name: str, names: Iterable[str]) -> None:
    """Raise ValueError for an unknown name, with similar names."""
    allowed = list(names)
    if name in allowed:
        return
    close = get_close_matches(name, allowed, n=1) or [one for one in allowed if name and name in one]
    meant = f"; did you mean {' or '.join(close)}?" if close else "."
    raise ValueError(f"no {kind} is called '{name}'{meant} Allowed: {', '.join(allowed)}")
