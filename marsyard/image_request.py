"""Request of an image of a site: camera, pose, sun and seed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from marsyard.scenarios import views
from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, check_site_name, is_terrain_file, load_site
from marsyard.sim import sensor
from marsyard.sim.terrain import Site, sites

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
            is_above_minimum = value >= low if name == "elevation" else value > low
            if not (is_above_minimum and value <= high):
                allowed = f"{low:g}" if name == "elevation" else f"more than {low:g}"
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


def _check_name(kind: str, name: str, names: Iterable[str]) -> None:
    """Raise ValueError for an unknown name; the message lists similar names."""
    allowed = list(names)
    if name in allowed:
        return
    similar = get_close_matches(name, allowed, n=1) or [item for item in allowed if name and name in item]
    hint = f"; did you mean {' or '.join(similar)}?" if similar else "."
    raise ValueError(f"no {kind} is called '{name}'{hint} Allowed: {', '.join(allowed)}")
