"""Read the images of a folder of `marsyard ingest` with their cameras, poses and truth, and store them by case."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.exchange.files import write_counts
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.image_files import lossy_bits_per_pixel, read_counts, read_flat_field, read_header
from marsyard.scenarios.measured.label_poses import describe_frame, is_mars_fixed, is_same_world, label_pose, world_from
from marsyard.scenarios.measured.layout import INGEST_FILE, LANDING, MAP, VELOCITY, ImageRow, IngestFile, SunTable
from marsyard.sim.camera import (
    CameraModel,
    FramedCamera,
    LabelFrame,
    Pds3Product,
    mount_looking_down,
    read_framed_cameras,
    read_pds3_product,
)
from marsyard.sim.camera.pds3 import is_pds3
from marsyard.sim.frames import compose

#: Columns of a position.
_POSITION = ("x_m", "y_m", "z_m")


@dataclass(frozen=True)
class _PosedCamera:
    """The camera of an image in the body frame, with the body's pose in the world axes of Marsyard.

    - attitude: None for an image over a map without a measured pose
    - frame: frame of the pose in the image's label; None for a pose from the table
    - world_from_frame: transform from the label's frame
    """

    camera: CameraModel
    attitude: Rotation | None
    position_m: Float64[np.ndarray, "3"] | None
    frame: LabelFrame | None = None
    world_from_frame: RigidTransform | None = None


@dataclass(frozen=True)
class _RecordedImage:
    """An image as read, with the row that lists it."""

    row: ImageRow
    counts: UInt16[np.ndarray, "rows columns"]
    time_s: float
    posed: _PosedCamera


@dataclass
class FolderReader:
    """Reads the cases of a folder `source` and writes them to `target`; each camera and flat field is written once."""

    source: Path
    file: IngestFile
    target: Path
    cameras: dict[CameraModel, store.StoredFile] = field(default_factory=dict)
    flat_fields: dict[Path, tuple[store.StoredFile, tuple[int, ...]]] = field(default_factory=dict)

    def store_case(self, number: int, name: str, rows: Sequence[ImageRow]) -> store.StoredCase:
        """Read and check the rows of a case, and write its images."""
        images: list[_RecordedImage] = []
        for row in rows:
            images.append(self._read_image(row, images[0] if images else None))
        for earlier, later in itertools.pairwise(images):
            if later.time_s <= earlier.time_s:
                raise later.row.error(f"time goes from {earlier.time_s:g} to {later.time_s:g} s; it must increase")
        stored_images = [
            self._store_image(f"{number:06d}-{index}", image) for index, image in enumerate(images, start=1)
        ]
        measurements: dict[str, Any] = {}
        truth = self._read_truth(images)
        if self.file.task == VELOCITY:
            if len({"vx_m_s" in row.numbers for row in rows[1:]}) > 1:
                raise rows[1].error(
                    f"case '{name}': vx_m_s to vz_m_s are given for one pair of images only; allowed: for both, or for "
                    "none with measured positions"
                )
            measurements["interval_velocities_m_s"] = tuple(map(self._mean_velocity, images, images[1:]))
            measurements["sun_direction"] = _to_vector(self._sun(rows[0]).direction)
        elif self.file.task == LANDING:
            measurements["slant_range_m"] = rows[0].numbers.get("slant_range_m")
            measurements["site_m"] = self._apriori_site(images[0], measurements["slant_range_m"])
        elif len({image.posed.position_m is None for image in images}) > 1:
            raise rows[0].error(f"case '{name}': some images have a position and some have none")
        return store.StoredCase(name=name, images=tuple(stored_images), truth=truth, **measurements)

    def _read_image(self, row: ImageRow, first: _RecordedImage | None) -> _RecordedImage:
        """Read the image of a row; a PDS3 label supplies missing values of the row.

        `first` is the case's first image, whose world is that of all images; None for itself.
        """
        path = self.source / row.texts["file"]
        is_product = is_pds3(read_header(path))
        framed = self._read_camera(row, path, is_product)
        product = read_pds3_product(path) if is_product else None
        counts = self._read_counts(row, path, framed.camera, product)
        posed = self._find_pose(row, framed, product, None if first is None else first.posed)
        if first is not None and not is_same_world(posed.frame, first.posed.frame):
            raise row.error(
                f"the pose is in {describe_frame(posed.frame)}, that of the case's first image in "
                f"{describe_frame(first.posed.frame)}; allowed: one frame in a case"
            )
        up = -1.0 if posed.attitude is None else float(posed.attitude.apply(posed.camera.boresight())[2])
        if self.file.task in (VELOCITY, LANDING) and up >= 0.0:
            elevation = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
            raise row.error(
                f"the camera looks up, {elevation:.1f} deg above the horizon; allowed: down ({INGEST_FILE}: "
                "poses.axes, attitude_of and mounting define the axes)"
            )
        time_s = row.numbers.get("time_s", None if product is None else product.time_s)
        if time_s is None and self.file.task == MAP:
            time_s = 0.0  # each case has one image
        if time_s is None:
            raise row.error("time_s is empty, and no label contains it")
        return _RecordedImage(row, counts, time_s, posed)

    def _read_camera(self, row: ImageRow, path: Path, is_product: bool) -> FramedCamera:
        """Read the camera of a row, by default from the image's label; one that looks down is moved to the body."""
        table = self.file.camera
        camera_name = row.texts.get("camera", table.file)
        if camera_name is None and not is_product:
            raise row.error(f"no camera: the column camera and camera.file of {INGEST_FILE} are both empty")
        camera_file = path if camera_name is None else self.source / camera_name
        cameras = read_framed_cameras(str(camera_file), subframe_folded_in=table.subframe_folded_in)
        if table.number >= len(cameras):
            raise row.error(f"{camera_file}: contains {len(cameras)} cameras; camera.number is {table.number}")
        framed, has_attitude = cameras[table.number], row.rotation() is not None
        if has_attitude and not table.pose_in_file:  # the row's attitude is that of a camera looking down
            return replace(framed, camera=mount_looking_down(framed.camera))
        if not framed.frame.is_vehicle and (has_attitude or camera_name is not None):
            raise row.error(
                f"{camera_file}: the camera model is in the frame {framed.frame}, without the transform to the rover's "
                "frame; allowed: a model in the rover's frame"
            )
        return framed

    def _read_counts(
        self, row: ImageRow, path: Path, camera: CameraModel, product: Pds3Product | None
    ) -> UInt16[np.ndarray, "rows columns"]:
        """Return the counts of an image, which have the size of the camera and the bits of the detector."""
        is_published = self.file.task == MAP
        counts = read_counts(path, camera.size, is_published=is_published) if product is None else product.counts
        rows, columns = counts.shape
        if (columns, rows) != camera.size:
            camera_columns, camera_rows = camera.size
            raise row.error(
                f"{path}: has {columns} x {rows} pixels; its camera has {camera_columns} x {camera_rows} "
                "(columns x rows)"
            )
        max_count = (1 << self.file.detector.bits) - 1
        if counts.max() > max_count:
            raise row.error(
                f"{path}: has counts up to {counts.max()}; detector.bits = {self.file.detector.bits} allows {max_count}"
            )
        return counts

    def _find_pose(
        self, row: ImageRow, framed: FramedCamera, product: Pds3Product | None, first: _PosedCamera | None
    ) -> _PosedCamera:
        """Return the camera with its pose: from the row, else from the label; without one for an image over a map."""
        rotation, is_map = row.rotation(), self.file.task == MAP
        map_origin = self.file.map and self.file.map.origin_mars_fixed_m
        if rotation is not None:
            attitude, position = self._body_pose(row, rotation, row.vector(*_POSITION))
            if is_map and position is None:
                raise row.error("x_m, y_m, z_m are empty; map needs them with an attitude")
            return _PosedCamera(framed.camera, attitude, position)
        if _POSITION[0] in row.numbers:
            raise row.error("x_m, y_m, z_m are given, but qx to qw are not; a position needs an attitude in its row")
        if is_map and (map_origin is None or not is_mars_fixed(framed, product)):
            return _PosedCamera(mount_looking_down(framed.camera), None, None)
        camera, frame, frame_from_body = label_pose(row, framed, product)
        world_from_frame = None if first is None else first.world_from_frame
        if world_from_frame is None:
            origin = np.asarray(frame_from_body.translation if map_origin is None else map_origin)
            world_from_frame = world_from(row, frame, origin)
        pose = compose(world_from_frame, frame_from_body)
        return _PosedCamera(camera, pose.rotation, np.asarray(pose.translation), frame, world_from_frame)

    def _body_pose(
        self, row: ImageRow, rotation: Rotation, position: Float64[np.ndarray, "n"] | None
    ) -> tuple[Rotation, Float64[np.ndarray, "3"] | None]:
        """Compute the body's attitude and position in world axes; the position is None if none was recorded."""
        poses = self.file.poses
        if poses is None:
            raise row.error(f"quaternions require the table [poses] in {INGEST_FILE}, which defines their axes")
        vehicle = poses.enu_from_axes * rotation
        if position is None:
            return poses.body_attitudes(vehicle), None
        return poses.body_attitudes(vehicle), np.asarray(
            poses.enu_from_axes.apply(position) + poses.lever_arms(vehicle)
        )

    def _to_world(self, row: ImageRow, vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """Rotate a vector from the recorded axes to world axes."""
        if self.file.poses is None:
            raise row.error(f"vectors need [poses] in {INGEST_FILE}, which defines their axes")
        return np.asarray(self.file.poses.enu_from_axes.apply(vector))

    def _store_image(self, name: str, image: _RecordedImage) -> store.StoredImage:
        """Write an image with its camera and flat field, and return its record."""
        row, posed, counts = image.row, image.posed, image.counts
        camera = posed.camera
        if camera not in self.cameras:
            self.cameras[camera] = store.write_camera(self.target, len(self.cameras), camera)
        if self.file.task == LANDING and posed.position_m is None:
            raise row.error("x_m, y_m, z_m are empty; landing needs them")
        flat_field, flat_field_name = None, row.texts.get("flat_field", self.file.detector.flat_field)
        if flat_field_name is not None:
            path = self.source / flat_field_name
            if path not in self.flat_fields:
                response, file = read_flat_field(path), f"{len(self.flat_fields):06d}.npy"
                flat_field = store.write_file(
                    self.target, "flat_fields", file, lambda path: np.save(path, response, allow_pickle=False)
                )
                self.flat_fields[path] = flat_field, response.shape
            flat_field, shape = self.flat_fields[path]
            if shape != counts.shape:
                raise row.error(f"{path}: has {shape[1]} x {shape[0]} pixels, unlike {row.texts['file']}")
        detector, exposure_s = self.file.detector, row.numbers.get("exposure_s", self.file.detector.exposure_s)
        if exposure_s == 0.0 and detector.transfer_row_s + detector.clear_row_s > 0.0:
            raise row.error("exposure_s is 0 or empty; a frame transfer (transfer_row_s, clear_row_s) needs it")
        return store.StoredImage(
            source=row.texts["file"],
            size=camera.size,
            counts=store.write_file(self.target, "images", f"{name}.png", lambda path: write_counts(path, counts)),
            camera=self.cameras[camera],
            flat_field=flat_field,
            time_s=image.time_s,
            exposure_s=exposure_s,
            world_from_body_xyzw=None if posed.attitude is None else _to_quaternion(posed.attitude),
            position_m=None if posed.position_m is None else _to_vector(posed.position_m),
            altitude_m=row.numbers.get("altitude_m"),
            altitude_time_s=row.numbers.get("altitude_time_s"),
            bits_per_pixel=lossy_bits_per_pixel(self.source / row.texts["file"]) if self.file.task == MAP else None,
        )

    def _mean_velocity(self, earlier: _RecordedImage, later: _RecordedImage) -> store.Vector:
        """Return the mean velocity between two images: the inertial velocity, or computed from measured positions."""
        inertial = later.row.vector("vx_m_s", "vy_m_s", "vz_m_s")
        if inertial is not None:
            return _to_vector(self._mean_velocity_of_camera(inertial, earlier, later))
        start_m, end_m = earlier.posed.position_m, later.posed.position_m
        if start_m is None or end_m is None:
            raise later.row.error("vx_m_s to vz_m_s and the positions are empty; velocity needs one of them")
        return _to_vector((end_m - start_m) / (later.time_s - earlier.time_s))

    def _mean_velocity_of_camera(
        self, vehicle_m_s: Float64[np.ndarray, "3"], earlier: _RecordedImage, later: _RecordedImage
    ) -> Float64[np.ndarray, "3"]:
        """Convert a mean velocity of the recorded vehicle to that of the camera, in world axes."""
        velocity = self._to_world(later.row, vehicle_m_s)
        rotations = [image.row.rotation() for image in (earlier, later)]
        if self.file.poses is None or None in rotations:
            return velocity
        start_m, end_m = (
            self.file.poses.lever_arms(self.file.poses.enu_from_axes * rotation) for rotation in filter(None, rotations)
        )
        return np.asarray(velocity + (end_m - start_m) / (later.time_s - earlier.time_s))

    def _sun(self, row: ImageRow) -> SunTable:
        """Return the sun of a case: that of its first row, by default that of the folder."""
        angles = row.vector("sun_azimuth_deg", "sun_elevation_deg")
        if angles is None:
            if self.file.sun is None:
                raise row.error(f"no sun: neither sun_azimuth_deg and sun_elevation_deg nor {INGEST_FILE}'s [sun]")
            return self.file.sun
        azimuth, elevation = angles.tolist()
        if not 0.0 < elevation <= 90.0:
            raise row.error(f"sun_elevation_deg is {elevation:g}; allowed: above 0, at most 90")
        return SunTable.model_construct(azimuth_deg=azimuth, elevation_deg=elevation)

    def _apriori_site(self, image: _RecordedImage, slant_range_m: float | None) -> store.Vector:
        """Return the a-priori site: as recorded, or the ground on the first image's optical axis."""
        site = image.row.vector("site_x_m", "site_y_m", "site_z_m")
        if site is not None:
            return _to_vector(self._to_world(image.row, site))
        posed = image.posed
        if slant_range_m is None or posed.position_m is None or posed.attitude is None:
            raise image.row.error("slant_range_m and site_x_m to site_z_m are empty; landing needs one of them")
        ground = posed.camera.c + slant_range_m * posed.camera.a
        return _to_vector(posed.position_m + posed.attitude.apply(ground))

    def _read_truth(self, images: Sequence[_RecordedImage]) -> store.StoredTruth:
        """Read the true mean velocity of a descent from the second to the third image, or the true poses of a landing.

        Raises IngestError for an incomplete truth, which would not be used.
        """
        rows = [image.row for image in images]
        row = next((row for row in rows if any(name.startswith("true_") for name in row.numbers)), None)
        if row is None:
            return store.StoredTruth()
        poses = [self._true_pose(row) for row in rows]
        if self.file.task == VELOCITY:
            components = rows[-1].vector("true_vx_m_s", "true_vy_m_s")
            earlier, later = poses[-2:]
            if components is not None:
                mean = self._mean_velocity_of_camera(np.array([*components, 0.0]), *images[-2:])
            elif earlier is not None and later is not None:
                (_, start_m), (_, end_m) = earlier, later
                mean = (end_m - start_m) / (images[-1].time_s - images[-2].time_s)
            else:
                raise row.error(
                    "a true velocity or position is given, but none for the last two images; allowed: true_vx_m_s and "
                    "true_vy_m_s of the third image, or true positions of the second and third"
                )
            return store.StoredTruth(velocity_m_s=(float(mean[0]), float(mean[1])))
        if None in poses or any(row.rotation("true_") is None for row in rows):
            raise row.error(
                "the truth is incomplete; allowed: true_x_m to true_z_m and true_qx to true_qw of both images"
            )
        true_poses = tuple(
            (_to_vector(position), _to_quaternion(attitude)) for attitude, position in filter(None, poses)
        )
        return store.StoredTruth(poses=true_poses)

    def _true_pose(self, row: ImageRow) -> tuple[Rotation, Float64[np.ndarray, "3"]] | None:
        """Return the body's true attitude (by default the measured attitude) and position; None without a position."""
        true_position = row.vector(*(f"true_{name}" for name in _POSITION))
        if true_position is None:
            return None
        rotation = row.rotation("true_") or row.rotation()
        if rotation is None:
            raise row.error("a true position needs an attitude, measured or true")
        attitude, position = self._body_pose(row, rotation, true_position)
        return None if position is None else (attitude, position)


def _to_vector(values: Float64[np.ndarray, "3"]) -> store.Vector:
    x, y, z = values.tolist()
    return x, y, z


def _to_quaternion(rotation: Rotation) -> store.Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return x, y, z, w
