"""Comparison of recorded images with a map, and of their rendered counterparts with theirs.

If matchers succeed as often on the rendered counterpart (`marsyard.scenarios.measured.counterparts`) as on the recorded
image, rendered cases are as hard as real ones.
"""

from enum import Enum
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.scenarios.condition_columns import hash_images
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.counterparts import Counterpart, CounterpartParameters, render_counterpart
from marsyard.scenarios.measured.map_matching import MapComparison, compare_with_map
from marsyard.scenarios.measured.map_registration import extract_features, load_map, register_on_map
from marsyard.scenarios.measured.store import RECORDED_CASE, MeasuredParameters
from marsyard.scenarios.typed_scenario import TypedScenario
from marsyard.sim.camera import CameraModel
from marsyard.sim.parameters import NonNegative
from marsyard.sim.streams import Streams

#: Prefix of the columns of the rendered image.
RENDERED = "rendered."
#: Standard deviation of the position of a registered image, map pixels (assumed).
_REGISTRATION_SD_PX = 2.0


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
    recorded_case = RECORDED_CASE

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
