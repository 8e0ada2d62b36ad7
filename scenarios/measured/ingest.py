"""Convert a folder of recorded images into stored cases and their campaign: `marsyard ingest`."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.dimes.views import binned_size_for
from marsyard.algorithms.exchange.files import write_counts
from marsyard.scenarios.measured import store
from marsyard.scenarios.measured.image_files import lossy_bits_per_pixel, read_counts, read_flat_field, read_header
from marsyard.scenarios.measured.image_table import ImageRow, read_table
from marsyard.scenarios.measured.label_poses import describe_frame, is_mars_fixed, is_same_world, label_pose, world_from
from marsyard.scenarios.measured.layout import (
    INGEST_FILE,
    LANDING,
    MAP,
    TABLE_FILE,
    VELOCITY,
    IngestError,
    IngestFile,
    SunTable,
    read_ingest_file,
)
from marsyard.scenarios.measured.map_matching import TOLERANCE_PX
from marsyard.scenarios.measured.map_registration import add_map, describe_poses
from marsyard.scenarios.systems import Ingested
from marsyard.scenarios.template import toml_environment
from marsyard.scenarios.user_tables import format_problems
from marsyard.sim.camera import CameraModel, LabelFrame, mount_looking_down, read_framed_cameras, read_pds3_product
from marsyard.sim.camera.pds3 import is_pds3
from marsyard.sim.frames import compose

#: Columns of a position.
_POSITION = ("x_m", "y_m", "z_m")
#: Maximum number of rows that a detector sums, and maximum relative deviation of the ratio of the focal lengths from a
#: whole number. Calibrated focal lengths are accurate to 1 %; the next whole number after 8 differs by 12 %.
_MAX_SUMMED_ROWS, _RATIO_TOLERANCE = 64, 0.05
#: Default description of a campaign, by task.
_DESCRIPTIONS = {
    "velocity": "Real descents: horizontal velocity from three images.",
    "landing": "Real flights: landing sites from two images.",
    "matching": "Real images, compared with their measured poses.",
    "map": "Real images over a map, next to rendered images of the same camera, heights and attitudes.",
}


def ingest_campaign(source: Path, target: Path, final: Path) -> Ingested:
    """Write the cases of a folder, and return their campaign.

    - source: folder with `ingest.toml`, `images.csv` and images (docs/real-images.md)
    - target: folder for the new cases
    - final: folder to which `target` is moved afterwards

    Raises ValueError if the folder is invalid: the message contains the file, and the line or key. Raises OSError if
    the cases cannot be written.
    """
    path, stored_cases = ingest(source, target)
    file = read_ingest_file(source)
    rows_summed, note, binned_size = stored_cases.detector.rows_summed, "", None
    if rows_summed > 1 and file.detector.rows_summed is None:
        note = (
            f"rows_summed = {rows_summed}: computed from the camera, whose pixels are longer than wide by "
            f"that factor; rows_summed under [detector] of {INGEST_FILE} overrides it"
        )
    if stored_cases.task == VELOCITY:
        # DIMES bins delivered images, whose rows are already summed; without square bins, a bin is one pixel
        columns, rows = stored_cases.cases[0].images[0].size
        binned_size = binned_size_for(columns, rows * rows_summed)
        binned_size = binned_size if rows % binned_size[1] == 0 else (columns, rows)
    if stored_cases.task == MAP:
        note = describe_poses(stored_cases)
    template = toml_environment(Path(__file__).parent).get_template("campaign.toml.j2")
    text = template.render(
        **stored_cases.model_dump(include={"folder", "name", "task"}),
        description=stored_cases.description or _DESCRIPTIONS[stored_cases.task],
        cases=len(stored_cases.cases),
        file=str(final / path.name),
        binned_size=binned_size,
        numbers=list(range(len(stored_cases.cases))),
        is_level=file.map is not None and file.map.elevation is None,
        tolerance_px=TOLERANCE_PX,
        suns={"sun": file.sun, "map_sun": file.map and file.map.sun},
        velocity_is_known=any(case.truth.velocity_m_s is not None for case in stored_cases.cases),
    )
    return Ingested(text, len(stored_cases.cases), sum(len(case.images) for case in stored_cases.cases), note)


def ingest(source: Path, target: Path) -> tuple[Path, store.StoredCases]:
    """Write the cases of a folder into an existing folder; return the path of `cases.json` and its contents.

    Raises IngestError if the folder is invalid: the message contains the file, and the line or key. Raises OSError if
    the cases cannot be written.
    """
    file, table = read_ingest_file(source), source / TABLE_FILE
    reader = _FolderReader(source, file, target)
    cases: list[store.StoredCase] = []
    problems: list[str] = []
    for number, (name, rows) in enumerate(read_table(table, file.task).items()):
        try:
            cases.append(reader.store_case(number, name, rows))
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise IngestError(format_problems(table, problems))
    detector, first_camera = file.detector, next(iter(reader.cameras))
    stored_cases = store.StoredCases(
        schema_version=store.SCHEMA,
        name=file.name,
        description=file.description,
        task=file.task,
        folder=str(source.resolve()),
        detector=store.StoredDetector(
            **detector.model_dump(include={"offset_dn", "transfer_row_s", "clear_row_s"}),
            full_scale_dn=(1 << detector.bits) - 1,
            rows_summed=infer_summed_rows(first_camera) if detector.rows_summed is None else detector.rows_summed,
        ),
        cases=tuple(cases),
    )
    path = store.write_cases(target, stored_cases)
    if file.map is None:
        return path, stored_cases
    stored_cases = add_map(source, file.map, store.CasesFile(file=str(path)))
    return store.write_cases(target, stored_cases), stored_cases


def infer_summed_rows(camera: CameraModel) -> int:
    """Infer the number of detector rows in a delivered row from the ratio of the focal lengths.

    Returns 1 if the ratio is not near a whole number: then the pixels are not sums of square pixels.
    """
    ratio = camera.focal_lengths[0] / camera.focal_lengths[1]
    divisor = round(ratio)
    is_whole = 1 < divisor <= _MAX_SUMMED_ROWS and abs(ratio - divisor) <= _RATIO_TOLERANCE * divisor
    return divisor if is_whole else 1


@dataclass(frozen=True)
class _RecordedImage:
    """An image as read, with its pose in the world axes of Marsyard.

    - attitude: None for an image over a map without a measured pose
    - frame: frame of the pose in the image's label; None for a pose from the table
    - world_from_frame: transform from the label's frame
    """

    row: ImageRow
    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    time_s: float
    attitude: Rotation | None
    position_m: Float64[np.ndarray, "3"] | None
    frame: LabelFrame | None = None
    world_from_frame: RigidTransform | None = None


@dataclass
class _FolderReader:
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
            measurements["interval_velocities_m_s"] = tuple(map(self._mean_velocity, images, images[1:]))
            angles, sun = rows[0].vector("sun_azimuth_deg", "sun_elevation_deg"), self.file.sun
            if angles is not None:
                azimuth, elevation = angles.tolist()
                if not 0.0 < elevation <= 90.0:
                    raise rows[0].error(f"sun_elevation_deg is {elevation:g}; allowed: above 0, at most 90")
                sun = SunTable.model_construct(azimuth_deg=azimuth, elevation_deg=elevation)
            if sun is None:
                raise rows[0].error(f"no sun: neither sun_azimuth_deg and sun_elevation_deg nor {INGEST_FILE}'s [sun]")
            measurements["sun_direction"] = _to_vector(sun.direction)
        elif self.file.task == LANDING:
            measurements["slant_range_m"] = rows[0].numbers.get("slant_range_m")
            measurements["site_m"] = self._apriori_site(images[0], measurements["slant_range_m"])
        elif len({image.position_m is None for image in images}) > 1:
            raise rows[0].error(f"case '{name}': some images have a position and some have none")
        return store.StoredCase(name=name, images=tuple(stored_images), truth=truth, **measurements)

    def _read_image(self, row: ImageRow, first: _RecordedImage | None) -> _RecordedImage:
        """Read a row's image and its camera in the body frame; a PDS3 label supplies missing values of the row.

        `first` is the case's first image, whose world is that of all images; None for itself.
        """
        path, table = self.source / row.texts["file"], self.file.camera
        is_product = is_pds3(read_header(path))
        camera_name = row.texts.get("camera", table.file)
        if camera_name is None and not is_product:
            raise row.error(f"no camera: the column camera and camera.file of {INGEST_FILE} are both empty")
        camera_file = path if camera_name is None else self.source / camera_name
        cameras = read_framed_cameras(str(camera_file), subframe_folded_in=table.subframe_folded_in)
        if table.number >= len(cameras):
            raise row.error(f"{camera_file}: contains {len(cameras)} cameras; camera.number is {table.number}")
        framed, rotation = cameras[table.number], row.rotation()
        camera = framed.camera
        if not table.pose_in_file and rotation is not None:  # the row's attitude is that of a camera looking down
            camera = mount_looking_down(camera)
        elif not framed.frame.is_vehicle and (rotation is not None or camera_name is not None):
            raise row.error(
                f"{camera_file}: the camera model is in the frame {framed.frame}, without the transform to the rover's "
                "frame; allowed: a model in the rover's frame"
            )
        product = read_pds3_product(path) if is_product else None
        is_map = self.file.task == MAP
        counts = read_counts(path, camera.size, is_published=is_map) if product is None else product.counts
        max_count = (1 << self.file.detector.bits) - 1
        if counts.max() > max_count:
            raise row.error(
                f"{path}: has counts up to {counts.max()}; detector.bits = {self.file.detector.bits} allows {max_count}"
            )
        frame, world_from_frame = None, None
        attitude: Rotation | None = None
        position = None
        map_origin = self.file.map and self.file.map.origin_mars_fixed_m
        if rotation is not None:
            attitude, position = self._body_pose(row, rotation, row.vector(*_POSITION))
            if is_map and position is None:
                raise row.error("x_m, y_m, z_m are empty; map needs them with an attitude")
        elif is_map and (map_origin is None or not is_mars_fixed(framed, product)):
            camera = mount_looking_down(camera)
        else:
            camera, frame, frame_from_body = label_pose(row, framed, product)
            world_from_frame = None if first is None else first.world_from_frame
            if world_from_frame is None:
                origin = np.asarray(frame_from_body.translation if map_origin is None else map_origin)
                world_from_frame = world_from(row, frame, origin)
            world_from_body = compose(world_from_frame, frame_from_body)
            attitude, position = world_from_body.rotation, np.asarray(world_from_body.translation)
        if first is not None and not is_same_world(frame, first.frame):
            raise row.error(
                f"the pose is in {describe_frame(frame)}, that of the case's first image in "
                f"{describe_frame(first.frame)}; allowed: one frame in a case"
            )
        up = -1.0 if attitude is None else float(attitude.apply(camera.boresight())[2])
        if self.file.task in (VELOCITY, LANDING) and up >= 0.0:
            elevation = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
            raise row.error(
                f"the camera looks up, {elevation:.1f} deg above the horizon; allowed: down ({INGEST_FILE}: "
                "poses.axes, attitude_of and mounting define the axes)"
            )
        time_s = row.numbers.get("time_s", None if product is None else product.time_s)
        if time_s is None and is_map:
            time_s = 0.0  # each case has one image
        if time_s is None:
            raise row.error("time_s is empty, and no label contains it")
        return _RecordedImage(row, counts, camera, time_s, attitude, position, frame, world_from_frame)

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
        row, camera, counts = image.row, image.camera, image.counts
        if camera not in self.cameras:
            self.cameras[camera] = store.write_camera(self.target, len(self.cameras), camera)
        if self.file.task == LANDING and image.position_m is None:
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
        return store.StoredImage(
            source=row.texts["file"],
            size=camera.size,
            counts=store.write_file(self.target, "images", f"{name}.png", lambda path: write_counts(path, counts)),
            camera=self.cameras[camera],
            flat_field=flat_field,
            time_s=image.time_s,
            exposure_s=row.numbers.get("exposure_s", self.file.detector.exposure_s),
            world_from_body_xyzw=None if image.attitude is None else _to_quaternion(image.attitude),
            position_m=None if image.position_m is None else _to_vector(image.position_m),
            altitude_m=row.numbers.get("altitude_m"),
            altitude_time_s=row.numbers.get("altitude_time_s"),
            bits_per_pixel=lossy_bits_per_pixel(self.source / row.texts["file"]) if self.file.task == MAP else None,
        )

    def _mean_velocity(self, earlier: _RecordedImage, later: _RecordedImage) -> store.Vector:
        """Return the mean velocity between two images: the inertial velocity, or computed from measured positions."""
        inertial = later.row.vector("vx_m_s", "vy_m_s", "vz_m_s")
        if inertial is not None:
            return _to_vector(self._to_world(later.row, inertial))
        if earlier.position_m is None or later.position_m is None:
            raise later.row.error("vx_m_s to vz_m_s and the positions are empty; velocity needs one of them")
        return _to_vector((later.position_m - earlier.position_m) / (later.time_s - earlier.time_s))

    def _apriori_site(self, image: _RecordedImage, slant_range_m: float | None) -> store.Vector:
        """Return the a-priori site: as recorded, or the ground on the first image's optical axis."""
        site = image.row.vector("site_x_m", "site_y_m", "site_z_m")
        if site is not None:
            return _to_vector(self._to_world(image.row, site))
        if slant_range_m is None or image.position_m is None or image.attitude is None:
            raise image.row.error("slant_range_m and site_x_m to site_z_m are empty; landing needs one of them")
        ground = image.camera.c + slant_range_m * image.camera.a
        return _to_vector(image.position_m + image.attitude.apply(ground))

    def _read_truth(self, images: Sequence[_RecordedImage]) -> store.StoredTruth:
        """Read true poses and, for a descent, the true mean velocity from the second to the third image."""
        rows = [image.row for image in images]
        poses = [self._true_pose(row) for row in rows]
        last, velocity = images[-1], None
        if self.file.task == VELOCITY:
            components = last.row.vector("true_vx_m_s", "true_vy_m_s")
            earlier, later = poses[-2:]
            mean = None
            if components is not None:
                mean = self._to_world(last.row, np.array([*components, 0.0]))
            elif earlier is not None and later is not None:
                mean = (later[1] - earlier[1]) / (last.time_s - images[-2].time_s)
            velocity = None if mean is None else (float(mean[0]), float(mean[1]))
        has_pose = [
            row.rotation("true_") is not None and pose is not None for row, pose in zip(rows, poses, strict=True)
        ]
        if not any(has_pose):
            return store.StoredTruth(velocity_m_s=velocity)
        if not all(has_pose):
            raise rows[0].error("some images have a true pose and some have none")
        true_poses = tuple(
            (_to_vector(position), _to_quaternion(attitude)) for attitude, position in filter(None, poses)
        )
        return store.StoredTruth(velocity_m_s=velocity, poses=true_poses)

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
