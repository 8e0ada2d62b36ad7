"""Recording for the Rerun viewer (https://rerun.io): a case in space and on its time line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.reports.timeline.mesh import colour, ground_width_m, triangulate, vertex_colours
from marsyard.scenarios.timeline import Ellipsoids, TimedImage, Timeline
from marsyard.scenarios.timeline_surface import grey_values

#: Name of the time line, seconds.
_TIME = "time"
#: Quality of the images, and distance of an image from its camera divided by the width of the ground.
_JPEG_QUALITY, _IMAGE_DISTANCE_RATIO = 90, 0.1
#: Radius of points, divided by the width of the ground; of marks, pixels.
_POINT_RATIO, _MARK_PX = 0.003, 2.0
#: Standard deviations shown by an ellipsoid.
_SIGMAS = 3.0


def write_rerun(path: Path, timeline: Timeline, name: str) -> None:
    """Write a timeline as a recording (.rrd) with the arrangement of its views. Raises OSError on failure.

    name: title of the recording
    """
    path.write_bytes(b"")  # OSError if the file cannot be written; the recording would raise another exception
    recording = rr.RecordingStream("marsyard", recording_id=name)
    recording.save(path)
    recording.send_recording_name(name)
    width_m = ground_width_m(timeline)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_geometry(recording, timeline, width_m)
    for image in timeline.images:
        _log_image(recording, image, width_m)
    for key, ellipsoids in timeline.ellipsoids.items():
        _log_ellipsoids(recording, _entity("world", "estimates", key), ellipsoids)
    _log_series(recording, timeline)
    recording.send_blueprint(_create_blueprint(timeline))
    recording.disconnect()


def _entity(*parts: str) -> str:
    """Return the entity path of names, which may contain blanks and slashes."""
    return str(rr.new_entity_path([*parts]))


def _log_geometry(recording: rr.RecordingStream, timeline: Timeline, width_m: float) -> None:
    """Log surfaces, paths with moving bodies, and points."""
    for name, patch in timeline.surfaces.items():
        mesh = rr.Mesh3D(
            vertex_positions=np.nan_to_num(patch.points_m.reshape(-1, 3)),
            triangle_indices=triangulate(patch),
            vertex_colors=vertex_colours(patch),
        )
        recording.log(_entity("world", "surfaces", name), mesh, static=True)
    for name, track in timeline.paths.items():
        entity = _entity("world", "paths", name)
        lines = rr.LineStrips3D([track.positions_m], colors=[colour(name)], radii=0.3 * _POINT_RATIO * width_m)
        recording.log(entity, lines, static=True)
        body = rr.Boxes3D(half_sizes=[np.full(3, 2.0 * _POINT_RATIO * width_m)], colors=[colour(name)])
        recording.log(f"{entity}/body", body, static=True)
        poses = rr.Transform3D.columns(translation=track.positions_m, quaternion=track.quaternions_xyzw)
        recording.send_columns(f"{entity}/body", [rr.TimeColumn(_TIME, duration=track.times_s)], poses)
    for name, points in timeline.points.items():
        is_permanent = np.isnan(points.times_s)
        style = {"colors": [colour(name)], "radii": _POINT_RATIO * width_m}
        if is_permanent.any():
            permanent = rr.Points3D(points.positions_m[is_permanent], labels=[name], show_labels=False, **style)
            recording.log(_entity("world", "points", name), permanent, static=True)
        for time_s in np.unique(points.times_s[~is_permanent]):
            recording.set_time(_TIME, duration=float(time_s))
            recording.log(
                _entity("world", "points", name), rr.Points3D(points.positions_m[points.times_s == time_s], **style)
            )


def _log_image(recording: rr.RecordingStream, image: TimedImage, width_m: float) -> None:
    """Log a camera with its image, and the marks and boxes in it."""
    recording.set_time(_TIME, duration=image.time_s)
    entity, pose, (rows, columns) = _entity("world", "cameras", image.camera), image.pose, image.counts.shape
    recording.log(entity, rr.Transform3D(translation=pose.position_m, quaternion=pose.quaternion_xyzw))
    # the centre of Rerun's upper left pixel is (0.5, 0.5)
    pinhole = rr.Pinhole(
        focal_length=_pinhole_focal_px(image),
        principal_point=pose.centre_px + 0.5,
        resolution=(columns, rows),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_IMAGE_DISTANCE_RATIO * width_m,
    )
    _, encoded = cv2.imencode(
        ".jpg", grey_values(image.counts.astype(np.float32)), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    recording.log(entity, pinhole, rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"))
    for name, pixels in image.marks.items():
        finite = pixels[np.isfinite(pixels).all(axis=1)] + 0.5
        recording.log(
            f"{entity}/{rr.escape_entity_path_part(name)}", rr.Points2D(finite, colors=[colour(name)], radii=_MARK_PX)
        )
    for name, boxes in image.boxes.items():
        finite = boxes[np.isfinite(boxes).all(axis=1)]
        left_upper, width_height = np.split(finite, 2, axis=1)
        rectangles = rr.Boxes2D(mins=left_upper + 0.5, sizes=width_height, colors=[colour(name)])
        recording.log(f"{entity}/{rr.escape_entity_path_part(name)}", rectangles)


def _pinhole_focal_px(image: TimedImage) -> Float64[np.ndarray, "2"]:
    """Return the focal lengths of a pinhole camera with the field of view of the image's corners."""
    rows, columns = image.counts.shape
    corners = np.array([(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)])
    slopes = image.pose.corner_rays[:, :2] / image.pose.corner_rays[:, 2:]
    return np.asarray(np.mean((corners - image.pose.centre_px) / slopes, axis=0))


def _log_ellipsoids(recording: rr.RecordingStream, entity: str, ellipsoids: Ellipsoids) -> None:
    """Log the ellipsoids of three standard deviations."""
    for time_s, centre, covariance in zip(
        ellipsoids.times_s, ellipsoids.centres_m, ellipsoids.covariances_m2, strict=True
    ):
        variances, axes = np.linalg.eigh(covariance)
        axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
        recording.set_time(_TIME, duration=float(time_s))
        ellipsoid = rr.Ellipsoids3D(
            centers=[centre],
            half_sizes=[_SIGMAS * np.sqrt(np.maximum(variances, 0.0))],
            quaternions=[Rotation.from_matrix(axes).as_quat()],
            colors=[colour("estimated")],
        )
        recording.log(entity, ellipsoid)


def _log_series(recording: rr.RecordingStream, timeline: Timeline) -> None:
    """Log scalars over time, and the measurements of the inertial unit by axis."""
    columns = {_entity("series", name): (series.times_s, series.values) for name, series in timeline.series.items()}
    if timeline.inertial is not None:
        data = timeline.inertial
        for quantity, values in (("rate, rad/s", data.rates_rad_s), ("force, m/s2", data.specific_forces_m_s2)):
            columns |= {
                _entity("inertial", quantity, axis): (data.times_s, values[:, index])
                for index, axis in enumerate("xyz")
            }
    for entity, (times_s, values) in columns.items():
        is_finite = np.isfinite(values)
        times = rr.TimeColumn(_TIME, duration=times_s[is_finite])
        recording.send_columns(entity, [times], rr.Scalars.columns(scalars=values[is_finite]))


def _create_blueprint(timeline: Timeline) -> rrb.Blueprint:
    """Arrange the views: space and maps at the left, images and plots at the right."""
    space = [rrb.Spatial3DView(origin="world", contents=["$origin/**", "- $origin/surfaces/map"], name="space")]
    if "map" in timeline.surfaces:
        contents = ["$origin/**", "- $origin/surfaces/ground", "- $origin/cameras/**"]
        space.append(rrb.Spatial3DView(origin="world", contents=contents, name="map"))
    names = dict.fromkeys(image.camera for image in timeline.images)
    images = [rrb.Spatial2DView(origin=_entity("world", "cameras", name), name=name) for name in names]
    plots = [rrb.TimeSeriesView(origin=_entity("series", name), name=name) for name in timeline.series]
    if timeline.inertial is not None:
        plots += [rrb.TimeSeriesView(origin="inertial", name="inertial unit")]
    right: list[Any] = [rrb.Tabs(*images)] if len(images) > 1 else list(images)
    right += [rrb.Tabs(*plots)] if plots else []
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*space), rrb.Vertical(*right), column_shares=[3, 2]), collapse_panels=True
    )
