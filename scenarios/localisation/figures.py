"""Arrays and timeline of a localisation case, for its figures in the report and the exports of `marsyard replay`."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import PositionEstimate
from marsyard.scenarios.localisation.camera import true_camera
from marsyard.scenarios.localisation.score import compute_errors
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.scenarios.timeline import (
    CameraPose,
    Ellipsoids,
    InertialData,
    Path,
    Series,
    SurfacePatch,
    TimedImage,
    TimedPoints,
    Timeline,
)
from marsyard.scenarios.timeline_surface import grey_values, surface_from_above

#: Side of the stored map, pixels, and quantiles of its appearance that become black and white.
_THUMBNAIL_PX, _BLACK_QUANTILE, _WHITE_QUANTILE = 512, 0.005, 0.995
#: Step between the map's pixels for these quantiles.
_QUANTILE_STEP = 4
#: Half width of the shown ground divided by the altitude at the start.
_HALF_WIDTH_RATIO = 1.2
#: Time between the poses of the true path, s, and maximum side of the shown map, pixels.
_STEP_S, _MAP_PX = 0.1, 384


def case_products(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> Mapping[str, Any]:
    """Return the arrays for a case's figures.

    ::

        track               per estimate: time, error east, north, up, sd east, north, up (m); NaN for a refusal
        outcomes            outcome of each estimate
        inliers             per estimate: landmarks used; NaN without a match
        true_xy_m           true positions on the map at the images; estimated_xy_m: estimates, NaN for a refusal
        initial_xy_m        initial position (east, north) of inertial navigation
        map                 appearance of the map, reduced; map_extent_m: west, east, south, north
        image_1, image_2    first and last image
        landmarks_px        measured pixels of the landmarks in the last image; landmarks_residual_px: their residuals;
                            landmarks_used: whether the position uses them
    """
    errors = compute_errors(descent, answers)
    refusal = np.full(1 + 3 + 3, np.nan)  # time, position error and its standard deviation
    track = np.stack(
        [refusal if error is None else np.array([error.time_s, *error.position_m, *error.sd_m]) for error in errors]
    )
    estimates = answers.estimates
    details = [estimate.details for estimate in estimates]
    estimated = [np.full(2, np.nan) if item.position_m is None else item.position_m[:2] for item in estimates]
    map_product = descent.measurements.map_product
    side_px = min(_THUMBNAIL_PX, *map_product.appearance.shape)
    sampled = map_product.appearance[::_QUANTILE_STEP, ::_QUANTILE_STEP]
    low, high = np.quantile(sampled, (_BLACK_QUANTILE, _WHITE_QUANTILE))
    scaled = np.clip(255.0 * (map_product.appearance - low) / max(float(high - low), 1e-9), 0.0, 255.0)
    thumbnail = cv2.resize(scaled.astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_AREA)
    west, south = map_product.origin_m - 0.5 * map_product.pixel_m
    rows, columns = map_product.appearance.shape
    values: dict[str, Any] = {
        "track": track,
        "outcomes": [estimate.outcome.name for estimate in estimates],
        "inliers": np.array(
            [
                np.nan if not isinstance(item, LocalisationDetails) or item.inliers is None else float(item.inliers)
                for item in details
            ]
        ),
        "true_xy_m": descent.map_truth.map_position(np.array([state.position_m[:2] for state in descent.states])),
        "estimated_xy_m": np.stack(estimated),
        "initial_xy_m": descent.measurements.initial.position_m[:2],
        "map": thumbnail.astype(np.uint8),
        "map_extent_m": np.array(
            [west, west + columns * map_product.pixel_m, south, south + rows * map_product.pixel_m]
        ),
    }
    if descent.images:
        values |= {"image_1": descent.images[0].counts, "image_2": descent.images[-1].counts}
    last = _details_by_image(descent, answers).get(len(descent.images) - 1)
    if isinstance(last, LocalisationDetails) and last.measured_px is not None:
        values |= {
            "landmarks_px": last.measured_px,
            "landmarks_residual_px": last.residuals_px,
            "landmarks_used": last.used,
        }
    return values


def _details_by_image(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> dict[int, object]:
    """Return the details of the estimates by the index of the image; estimators answer in the order of time tags."""
    by_tag = np.argsort([image.time_s for image in descent.images], kind="stable")
    return {int(index): answer.details for index, answer in zip(by_tag, answers.after_images, strict=True)}


def localisation_timeline(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate] | None) -> Timeline:
    """Create the timeline of a descent: images with landmarks, estimates with covariance, map and ground.

    Estimates are relative to the map. Here they are in the world: the displacement of the map is subtracted, so that
    their distance from the true path is the error. Their time tags are those of the inertial unit; its offset is
    subtracted.
    """
    flight, surface = descent.flight, descent.world.surface
    first, last_s = descent.states[0], descent.states[-1].time_s
    motion = flight.motion(np.append(np.arange(first.time_s, last_s, _STEP_S), last_s))
    altitudes = motion.positions_m[:, 2] - surface.height(*motion.positions_m.T[:2])
    centre = (float(first.position_m[0]), float(first.position_m[1]))
    half_width_m = _HALF_WIDTH_RATIO * descent.p.flight.altitude_start_m
    initial = descent.measurements.initial
    estimated_path, ellipsoids = _reported_states(descent, answers)
    return Timeline(
        surfaces={
            "ground": surface_from_above(descent.world.scene, centre, half_width_m, descent.p.render.backend),
            "map": _map_surface(descent),
        },
        paths={"true": Path.from_motion(motion), **estimated_path},
        images=_images(descent, answers),
        points={
            "initial position": TimedPoints(
                np.array([initial.time_s - descent.imu_offset_s]), _to_world(descent, initial.position_m[None])
            )
        },
        ellipsoids=ellipsoids,
        series={
            "altitude, m": Series(motion.times_s, np.asarray(altitudes)),
            **({} if answers is None else _error_series(descent, answers)),
        },
        inertial=InertialData.from_increments(descent.measurements.increments, descent.imu_offset_s),
    )


def _to_world(descent: LocalisedDescent, positions_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Subtract the displacement of the map from positions on the map."""
    return np.column_stack([descent.map_truth.world_position(positions_m[:, :2]), positions_m[:, 2]])


def _reported_states(
    descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate] | None
) -> tuple[dict[str, Path], dict[str, Ellipsoids]]:
    """Return the path through the reported states, and the positions with their covariances; empty without a state."""
    reported = [
        (answer.time_s, answer.position_m, answer.world_from_body.as_quat(), answer.covariance[:3, :3])
        for answer in (() if answers is None else answers.estimates)
        if answer.position_m is not None and answer.world_from_body is not None and answer.covariance is not None
    ]
    if not reported:
        return {}, {}
    tags_s, positions, quaternions, covariances = (
        np.array(values, dtype=np.float64) for values in zip(*reported, strict=True)
    )
    times_s, world_m = tags_s - descent.imu_offset_s, _to_world(descent, positions)
    return (
        {"estimated": Path(times_s, world_m, quaternions)},
        {"estimated position": Ellipsoids(times_s, world_m, covariances)},
    )


def _error_series(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate]) -> dict[str, Series]:
    """Return horizontal error and its standard deviation at the reported states, and the inliers of each image."""
    errors = [error for error in compute_errors(descent, answers) if error is not None]
    times = np.array([error.time_s for error in errors], dtype=np.float64) - descent.imu_offset_s
    series = {
        "horizontal error, m": np.array([error.horizontal_m for error in errors], dtype=np.float64),
        "3 sigma of the horizontal error, m": np.array([3.0 * np.hypot(*error.sd_m[:2]) for error in errors]),
    }
    counted = [
        (answer.time_s - descent.imu_offset_s, float(answer.details.inliers))
        for answer in answers.estimates
        if isinstance(answer.details, LocalisationDetails) and answer.details.inliers is not None
    ]
    named = {name: Series(times, values) for name, values in series.items() if len(values)}
    if counted:
        named["landmarks used"] = Series(*np.array(counted, dtype=np.float64).T)
    return named


def _images(descent: LocalisedDescent, answers: StreamAnswers[PositionEstimate] | None) -> list[TimedImage]:
    """Return the delivered images at the true times of their exposures, with the landmarks that were matched."""
    camera, images = true_camera(descent.p.camera), []
    details_by_image = {} if answers is None else _details_by_image(descent, answers)
    for number, (image, state) in enumerate(zip(descent.images, descent.image_states, strict=True)):
        details, marks = details_by_image.get(number), {}
        if isinstance(details, LocalisationDetails) and details.measured_px is not None and details.used is not None:
            marks = {
                "landmarks used": details.measured_px[details.used],
                "landmarks rejected": details.measured_px[~details.used],
            }
        pose = CameraPose.from_camera(camera, state.world_from_body)
        images.append(TimedImage("descent camera", state.time_s, image.counts, descent.p.detector.bits, pose, marks))
    return images


def _map_surface(descent: LocalisedDescent) -> SurfacePatch:
    """Return the map product with reduced resolution, without the displacement of the whole map."""
    product = descent.measurements.map_product
    stride = -(-max(product.appearance.shape) // _MAP_PX)
    appearance, elevation = product.appearance[::stride, ::stride], product.elevation_m[::stride, ::stride]
    rows, columns = np.indices(appearance.shape) * stride
    east, north = (product.origin_m[axis] + product.pixel_m * index for axis, index in ((0, columns), (1, rows)))
    shift_east, shift_north = descent.map_truth.shift_m
    points = np.stack([east - shift_east, north - shift_north, elevation], axis=-1).astype(np.float32)
    # row 0 of the map is the southernmost
    return SurfacePatch(points[::-1], grey_values(appearance)[::-1])
