"""Rendered counterpart of a recorded image over a map: another ground, seen by the same camera.

Height, attitude and map pixel are those of the recorded image, ground and detector those of the scenario localisation.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import UInt16
from pydantic import Field, field_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.localisation.camera import LANDER_DETECTOR
from marsyard.scenarios.localisation.map_product import make_map
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.localisation.sites import localisation_site
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.radiance import add_haze
from marsyard.scenarios.site_parameters import DustOpacity, RenderParameters, SunParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.render import process_renderer
from marsyard.sim.sensor import Detector, DetectorParameters
from marsyard.sim.sensor.image_coding import MAX_BITS, MIN_BITS, compress_and_decompress
from marsyard.sim.streams import Streams

#: Largest side of a rendered map, pixels; fewest bits of a simulated detector.
_MAX_SIDE_PX, _MIN_DETECTOR_BITS = 4096, 8
#: Smallest height of a camera for which the mesh of the ground is made, m.
_MIN_HEIGHT_M = 50.0
_MAP = MapParameters()


class CounterpartParameters(Parameters):
    """Ground and light of the rendered images; a case has the terrain with its own number."""

    site: Annotated[str, Field(description="preset of terrain and light of the scenario localisation")] = "crater-floor"
    bank_seed: Annotated[int, Field(ge=0, description="seed of the terrains")] = 1
    sun: Annotated[SunParameters, Field(description="sun in the images")] = SunParameters()
    dust_opacity: DustOpacity = None
    map_sun: Annotated[SunParameters, Field(description="sun in the images of the map")] = SunParameters(
        azimuth_deg=_MAP.sun_azimuth_deg, elevation_deg=_MAP.sun_elevation_deg
    )
    map_aperture_px: Annotated[
        float, bounded_field(0.1, 1.0, "aperture of the orbital images in map pixels; less for a reduced copy of a map")
    ] = _MAP.aperture_px
    map_nyquist_mtf: Annotated[
        float, bounded_field(0.01, 1.0, "MTF of the map at one cycle per two pixels, without the aperture")
    ] = _MAP.nyquist_mtf
    bits_per_pixel: Annotated[
        float | None, bounded_field(MIN_BITS, MAX_BITS, "size of a compressed image; default: as the recorded image")
    ] = None
    render: RenderParameters = Field(default_factory=RenderParameters)

    @field_validator("site")
    @classmethod
    def _check_site(cls, name: str) -> str:
        localisation_site(name)
        return name


@dataclass(frozen=True, eq=False)
class Counterpart:
    """A rendered image, its map, and its true pose."""

    image: DetectorImage
    map_product: MapProduct
    world_from_body: RigidTransform


def render_counterpart(
    recorded: PosedImage,
    map_product: MapProduct,
    full_scale_dn: int,
    bits_per_pixel: float | None,
    p: CounterpartParameters,
    streams: Streams,
    *,
    is_level: bool,
) -> Counterpart:
    """Render an image like a recorded one, and the map of its ground with the quality of the scenario localisation.

    The camera has the height above the ground and the attitude of the recorded image; the middle of the image shows the
    middle of the map. The detector is that of the scenario localisation, with the bits of the recorded image.

    - recorded: recorded image with its pose on `map_product`
    - bits_per_pixel: size of the recorded image if it was compressed
    - is_level: whether the recorded map contains no elevation; the elevation of the rendered map is then constant
    """
    bits = max(full_scale_dn.bit_length(), _MIN_DETECTOR_BITS)
    parameters = LANDER_DETECTOR.model_copy(
        update={
            "bits": bits,
            "gain_e_dn": LANDER_DETECTOR.full_well_e / 2**bits,
            "offset_dn": LANDER_DETECTOR.offset_dn * 2.0 ** (bits - LANDER_DETECTOR.bits),
        }
    )
    site = localisation_site(p.site)
    terrain = site.terrain("descent")
    world = LocalisationWorld.from_parameters(
        site,
        terrain,
        bank_seed=p.bank_seed,
        terrain_number=streams.case,
        sun_azimuth_deg=p.sun.azimuth_deg,
        sun_elevation_deg=p.sun.elevation_deg,
        optical_depth=p.dust_opacity,
        detector=parameters,
    )
    period_px = int(terrain.samples * terrain.spacing_m / map_product.pixel_m)
    map_parameters = MapParameters(
        pixel_m=map_product.pixel_m,
        side_px=min(max(map_product.appearance.shape), period_px, _MAX_SIDE_PX),
        sun_azimuth_deg=p.map_sun.azimuth_deg,
        sun_elevation_deg=p.map_sun.elevation_deg,
        aperture_px=p.map_aperture_px,
        nyquist_mtf=p.map_nyquist_mtf,
        # a shift of the whole map has no effect on images without a position
        registration_sd_m=0.0,
    )
    product, _ = make_map(world, map_parameters, np.zeros(2), streams.generator("map"), p.render.backend)
    if is_level:
        level = np.full_like(product.elevation_m, product.elevation_m.mean(dtype=np.float64))
        product = replace(product, elevation_m=level)
    pose = _pose_above_middle(recorded, map_product, world)
    counts, detector = _expose(recorded.camera, world, pose, parameters, p, streams)
    size = p.bits_per_pixel or bits_per_pixel
    if size is not None:
        counts = compress_and_decompress(counts, min(max(size, MIN_BITS), MAX_BITS), parameters.full_scale_dn)
    image = DetectorImage(counts, recorded.time_s, recorded.camera, detector.calibration)
    return Counterpart(image, product, pose)


def _pose_above_middle(recorded: PosedImage, map_product: MapProduct, world: LocalisationWorld) -> RigidTransform:
    """Return the pose with attitude and height of the recorded image from which its middle shows the world's origin."""
    x, y, z = recorded.position_m
    height_m = float(z) - elevation_at(map_product, np.array([x, y]))
    axis = recorded.world_camera.boresight()
    east_m, north_m = (axis[:2] * height_m / axis[2]).tolist()
    ground_m = float(world.surface.height(east_m, north_m))
    return rigid(recorded.world_from_body, np.array([east_m, north_m, ground_m + height_m]))


def _expose(
    camera: CameraModel,
    world: LocalisationWorld,
    pose: RigidTransform,
    parameters: DetectorParameters,
    p: CounterpartParameters,
    streams: Streams,
) -> tuple[UInt16[np.ndarray, "rows columns"], Detector]:
    """Render and expose the image; return its counts and the detector."""
    optics = camera_optics(camera)
    east_m, north_m, up_m = np.asarray(pose.translation).tolist()
    height_m = up_m - float(world.surface.height(east_m, north_m))
    scene = world.scene(east_m, north_m, max(height_m, _MIN_HEIGHT_M), optics.rays.pixel_rad)
    frame = process_renderer(p.render.backend).render(scene, optics.rays, pose)
    radiance = add_haze(frame, world.air, world.sun, world.air.mean_extinction_m(height_m))
    detector = Detector.draw(optics.fall_off, parameters, streams.generator("detector response"))
    brightness = np.float32(world.brightness)
    return detector.expose(radiance * brightness, streams.generator("detector noise")), detector
