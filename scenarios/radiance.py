"""Light of an image: ground and sun of a site, the brightness of the sunlight, and haze in dusty air."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from marsyard.scenarios.views import SiteGround
from marsyard.sim.frames import direction
from marsyard.sim.render import Frame, Sun
from marsyard.sim.render.sky import add_air_light
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.terrain import Environment, Surface


@dataclass(frozen=True)
class SiteWorld:
    """Ground of a site with its reflectance and atmosphere, and its sun.

    brightness: sunlight at the ground divided by the reference sunlight of the detector's responsivity
    """

    ground: SiteGround
    sun: Sun
    brightness: float = 1.0

    @property
    def air(self) -> Environment:
        """Atmosphere of the site."""
        return self.ground.site.environment

    @property
    def surface(self) -> Surface:
        """Surface of the ground; it is periodic."""
        return self.ground.surface


def add_haze(frame: Frame, air: Environment, sun: Sun, extinction_m: float) -> Float32[np.ndarray, "rows columns"]:
    """Compute the radiance factor of an image through a homogeneous layer of dusty air between ground and camera.

    The light from the ground is attenuated by the transmission ``T = exp(-extinction_m * range_m)``. The air adds
    ``(1 - T)`` times its source function: single scattering of sunlight (phase function of Henyey & Greenstein 1941)
    and of the mean light from sky and ground. Sky pixels are not changed.
    """
    if extinction_m == 0.0:
        return frame.radiance
    transmission = np.multiply(frame.range_m, -extinction_m, dtype=np.float32, casting="same_kind")
    np.exp(transmission, out=transmission)
    transmission[np.isinf(frame.range_m)] = 1.0
    # sunlight travels along -sun and is scattered along -direction, towards the camera
    sun_body = frame.world_from_body.rotation.inv().apply(sun.direction)
    sky = air.sky_fraction(float(np.arcsin(np.clip(sun.direction[2], -1.0, 1.0))))
    ambient = 0.5 * (sky + float(frame.radiance.mean()))
    radiance, transmission = frame.radiance.reshape(-1), transmission.reshape(-1)
    scattering = air.single_scattering_albedo, air.asymmetry, ambient
    hazy = add_air_light(radiance, transmission, frame.rays.device_rays.directions, sun_body, *scattering)
    return hazy.reshape(frame.radiance.shape)


def sun_at(air: Environment, azimuth_deg: float, elevation_deg: float) -> Sun:
    """Return the sun over a site; azimuth clockwise from north."""
    return Sun(direction(np.radians(azimuth_deg), np.radians(elevation_deg)), air.sun_radius_rad)


def sunlight_ratio(air: Environment, elevation_rad: float, detector: DetectorParameters) -> float:
    """Return direct sunlight at the ground divided by the reference sunlight of the detector's responsivity."""
    return air.direct_fraction(elevation_rad) * air.solar_irradiance / detector.sunlight
