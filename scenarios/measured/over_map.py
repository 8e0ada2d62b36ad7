"""Comparison of recorded images with a map, and of rendered images of the same kind with theirs.

The rendered counterpart of an image shows another ground, with the same camera, height, attitude and map pixel. If
matchers succeed as often on it as on the recorded image, rendered cases are as hard as real ones.
"""

from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated

import numpy as np
from jaxtyping import UInt16
from pydantic import BaseModel, Field, field_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.condition_columns import hash_images
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.localisation.camera import LANDER_DETECTOR
from marsyard.scenarios.localisation.map_product import make_map
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.localisation.sites import localisation_site
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.map_matching import MapComparison, compare_with_map
from marsyard.scenarios.measured.map_registration import extract_features, load_map, register_on_map
from marsyard.scenarios.measured.store import MeasuredParameters
from marsyard.scenarios.radiance import add_haze
from marsyard.scenarios.site_parameters import DustOpacity, RenderParameters, SunParameters
from marsyard.scenarios.typed_scenario import TypedScenario
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.parameters import NonNegative, Parameters, bounded_field
from marsyard.sim.render import process_renderer
from marsyard.sim.sensor import Detector, DetectorParameters
from marsyard.sim.sensor.image_coding import MAX_BITS, MIN_BITS, compress_and_decompress
from marsyard.sim.streams import Streams

#: Largest side of a rendered map, pixels; fewest bits of a simulated detector.
_MAX_SIDE_PX, _MIN_DETECTOR_BITS = 4096, 8
#: Smallest height of a camera for which the mesh of the ground is made, m.
_MIN_HEIGHT_M = 50.0
_MAP = MapParameters()
#: Prefix of the columns of the rendered image.
RENDERED = "rendered."
#: Standard deviation of the position of a registered image, map pixels (assumed).
_REGISTRATION_SD_PX = 2.0


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
        update={"bits": bits, "gain_e_dn": LANDER_DETECTOR.full_well_e / 2**bits, "offset_dn": 2.0 ** (bits - 7)}
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


class MapOutcome(Enum):
    """Outcome of an image over a map."""

    MATCHED = "the landmarks of the map agree on the pose of the image"
    TOO_FEW_LANDMARKS = "the image has a pose, but too few landmarks of the map agree on it"
    TOO_FEW_MATCHES = "too few features of the image and of the map agree on a pose"


class OverMapParameters(MeasuredParameters):
    """Parameters of the comparison of images with a map."""

    task_name = "map"

    position_sd_m: Annotated[
        NonNegative, Field(description="SD of a measured position per axis, m: range of the landmarks' search")
    ] = 100.0
    lvs: Annotated[LvsOptions, Field(description="options of the landmarks")] = LvsOptions()
    rendered: Annotated[CounterpartParameters, Field(description="rendered images")] = CounterpartParameters()


class OverMapScenario(TypedScenario[OverMapParameters]):
    """Comparison of a recorded image with a map, and of a rendered image of the same kind with its own map."""

    name = "measured-map"
    parameters_type = OverMapParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Run one case. Without a pose of the recorded image, there is no rendered image."""
        p = self.check_parameters(parameters)
        record, (image,) = p.case.images[0], store.load_images(p.cases, p.case)
        row: dict[str, Scalar] = {"measured_case": p.case.name, "image_hash": hash_images([image.counts])}
        products: dict[str, object] = {"recorded_image": image.counts}
        inliers = record.registration_inliers
        if record.world_from_body_xyzw is None:
            row["registration_inliers"] = 0
            return CaseResult(MapOutcome.TOO_FEW_MATCHES.name, False, row, products)
        map_product = load_map(p.cases)
        posed = PosedImage.from_detector(image, np.asarray(record.pose.translation), record.attitude)
        sd_m = p.position_sd_m if inliers is None else _REGISTRATION_SD_PX * map_product.pixel_m
        comparison = compare_with_map(posed, map_product, sd_m, p.lvs)
        row |= {"registration_inliers": np.nan if inliers is None else inliers, **_describe(comparison, map_product)}
        products |= _products(comparison, "recorded")
        stored_map, detector = p.cases.stored.map, p.cases.stored.detector
        counterpart = render_counterpart(
            comparison.image,
            map_product,
            detector.full_scale_dn,
            record.bits_per_pixel,
            p.rendered,
            streams,
            is_level=stored_map is not None and stored_map.is_level,
        )
        rendered_row, rendered_products = _compare_counterpart(counterpart, p.lvs)
        row |= {RENDERED + name: value for name, value in rendered_row.items()}
        outcome = MapOutcome.MATCHED if len(comparison.landmarks) else MapOutcome.TOO_FEW_LANDMARKS
        return CaseResult(outcome.name, outcome is MapOutcome.MATCHED, row, products | rendered_products)


def _compare_counterpart(counterpart: Counterpart, options: LvsOptions) -> tuple[dict[str, Scalar], dict[str, object]]:
    """Register a rendered image on its map, like a recorded one, and return the columns and products."""
    image, map_product = counterpart.image, counterpart.map_product
    solution = register_on_map(image, map_product, extract_features(map_product))
    products: dict[str, object] = {"rendered_image": image.counts}
    if solution is None:
        return {"outcome": MapOutcome.TOO_FEW_MATCHES.name, "registration_inliers": 0}, products
    comparison = compare_with_map(solution.image, map_product, _REGISTRATION_SD_PX * map_product.pixel_m, options)
    outcome = MapOutcome.MATCHED if len(comparison.landmarks) else MapOutcome.TOO_FEW_LANDMARKS
    row: dict[str, Scalar] = {
        "outcome": outcome.name,
        "registration_inliers": solution.inliers,
        **_describe(comparison, map_product),
        "pose_error_px": pose_error_px(comparison, image.camera.transform(counterpart.world_from_body)),
    }
    return row, products | _products(comparison, "rendered")


def _describe(comparison: MapComparison, map_product: MapProduct) -> dict[str, Scalar]:
    """Return the columns of an image with a pose."""
    image = comparison.image
    camera = image.world_camera
    height_m = float(camera.c[2]) - elevation_at(map_product, camera.c[:2])
    return {
        "height_m": height_m,
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(-camera.boresight()[2], -1.0, 1.0)))),
        "ground_pixel_m": height_m * image.camera.pixel_angle_rad,
        **comparison.row,
    }


def pose_error_px(comparison: MapComparison, true_camera: CameraModel) -> float:
    """Return the median distance between the pixels of the landmarks by found and true pose; NaN without landmarks.

    - true_camera: camera model in the world frame
    """
    points = comparison.landmarks.points_m
    found_px, true_px = (camera.project(points)[0] for camera in (comparison.image.world_camera, true_camera))
    return float(np.median(np.linalg.norm(found_px - true_px, axis=1))) if len(points) else np.nan


def _products(comparison: MapComparison, kind: str) -> dict[str, object]:
    """Return the map below an image, north up, and the matched landmarks, for figures.

    Columns of the landmarks: (u, v) in the image, (column, row) on that map, and correlation.
    """
    footprint, landmarks = comparison.footprint, comparison.landmarks
    if footprint is None:
        return {}
    on_map = comparison.landmark_pixels - footprint.corner
    on_map[:, 1] = len(footprint.appearance) - 1 - on_map[:, 1]
    return {
        f"{kind}_map": np.ascontiguousarray(footprint.appearance[::-1]),
        f"{kind}_landmarks": np.column_stack([landmarks.measured_px, on_map, landmarks.scores]),
    }
