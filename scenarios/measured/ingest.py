"""Reads a user's folder of real pictures whole, holds it against what a task needs, and writes its cases down."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.spatial.transform import Rotation

from marsyard.algorithms.exchange.files import write_picture
from marsyard.scenarios.measured.layout import (
    INGEST_FILE,
    LANDING,
    TABLE_FILE,
    VELOCITY,
    IngestError,
    IngestFile,
    SunTable,
    read_ingest_file,
)
from marsyard.scenarios.measured.picture_files import file_head, picture_size, read_counts
from marsyard.scenarios.measured.store import (
    SCHEMA,
    Named,
    Quaternion,
    StoredCase,
    StoredCases,
    StoredDetector,
    StoredPicture,
    StoredTruth,
    Vector,
    put_camera,
    put_file,
    write_cases,
)
from marsyard.scenarios.measured.table import CaseRows, PictureRow, read_table
from marsyard.scenarios.own_files import listed
from marsyard.sim.camera import (
    CameraModel,
    Pds3Product,
    looking_down,
    read_cameras,
    read_pds3_product,
)
from marsyard.sim.camera.pds3 import is_pds3
from marsyard.sim.files import npy_header
from marsyard.sim.frames import SITE_FROM_WORLD

POSITION = ("x_m", "y_m", "z_m")
#: Relative response of the brightest pixel, at most: noise makes it a little more than 1.
_MOST_FLAT = 1.5
#: Pixels along a side of the largest camera.
_MAX_SIDE = 16384
#: Most rows that a detector sums, and how near to a whole number the ratio of a camera's scales must be. Calibrations
#: know focal lengths to better than a part in a hundred, and the next whole number of 8 is 12 % away.
_MAX_SUMMED, _WHOLE = 64, 0.05


@dataclass(frozen=True)
class _Taken:
    """A picture as read: when and from where it was taken, in our world's axes."""

    row: PictureRow
    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    time_s: float
    attitude: Rotation
    position_m: Float64[np.ndarray, "3"] | None


@dataclass
class _Folder:
    """The folder that is read, the folder that is written, and what is written once for several pictures."""

    source: Path
    file: IngestFile
    target: Path
    cameras: dict[CameraModel, Named] = field(default_factory=dict)
    flat_fields: dict[Path, tuple[Named, tuple[int, ...]]] = field(default_factory=dict)

    def error(self, row: PictureRow, message: str) -> IngestError:
        """What is wrong with a row of the table."""
        return IngestError(f"line {row.line}: {message}")


def ingest(source: Path, target: Path) -> tuple[Path, StoredCases]:
    """Reads a folder and writes its cases into another, which must be there.

    Returns
    -------
    The path of `cases.json`, and what it holds.

    Raises
    ------
    IngestError
        Where anything in the folder cannot be used; it names the file, and the line or key.
    OSError
        Where the cases cannot be written.
    """
    file = read_ingest_file(source)
    table = source / TABLE_FILE
    rows = read_table(table, file.task)
    folder = _Folder(source, file, target)
    cases: list[StoredCase] = []
    problems: list[str] = []
    for number, case in enumerate(rows):
        try:
            cases.append(_case(folder, number, case))
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise IngestError(listed(table, problems))
    stored = StoredCases(
        schema_version=SCHEMA,
        name=file.name,
        description=file.description,
        task=file.task,
        folder=str(source.resolve()),
        detector=_detector(file, next(iter(folder.cameras))),
        cases=tuple(cases),
    )
    return write_cases(target, stored), stored


def summed_rows(camera: CameraModel) -> int:
    """Physical rows in a delivered one, by how much coarser a camera's pictures are downwards than to the right.

    1 where the ratio of the scales is near no whole number: then the pixels are no sums of square ones.
    """
    to_the_right, down = camera.focal_lengths
    ratio = to_the_right / down
    whole = round(ratio)
    return whole if 1 < whole <= _MAX_SUMMED and abs(ratio - whole) <= _WHOLE * whole else 1


def _detector(file: IngestFile, camera: CameraModel) -> StoredDetector:
    stated = file.detector
    return StoredDetector(
        offset_dn=stated.offset_dn,
        full_scale_dn=(1 << stated.bits) - 1,
        transfer_row_s=stated.transfer_row_s,
        clear_row_s=stated.clear_row_s,
        rows_summed=summed_rows(camera) if stated.rows_summed is None else stated.rows_summed,
    )


def _flat_field(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """Relative response: of numbers as they are, of a picture over its largest count."""
    head = file_head(path)
    try:
        if head.startswith(b"\x93NUMPY"):
            with path.open("rb") as file:
                shape, kind = npy_header(file)
            if len(shape) != 2 or max(shape) > _MAX_SIDE or kind.kind not in "iuf":
                raise ValueError(f"holds an array of shape {shape} and type {kind}")
            response = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
        else:
            counts = read_counts(path, picture_size(path))
            response = counts / max(int(counts.max()), 1)
    except (ValueError, EOFError) as error:
        raise IngestError(f"{path}: is no flat field: {error}") from error
    if response.ndim != 2 or not np.all(np.isfinite(response)) or response.min() <= 0.0 or response.max() > _MOST_FLAT:
        raise IngestError(f"{path}: is no flat field; allowed: two dimensions, numbers above 0, about 1 at the largest")
    return response


def _case(folder: _Folder, number: int, case: CaseRows) -> StoredCase:
    """One case read, checked and its pictures written."""
    taken = [_taken(folder, row) for row in case.rows]
    for before, after in itertools.pairwise(taken):
        if after.time_s <= before.time_s:
            raise folder.error(after.row, f"time goes from {before.time_s:g} to {after.time_s:g} s; allowed: onwards")
    pictures = [_stored(folder, f"{number:06d}-{place}", one) for place, one in enumerate(taken, start=1)]
    truth = _truth(folder, taken)
    if folder.file.task == VELOCITY:
        return StoredCase(
            name=case.name,
            pictures=tuple(pictures),
            interval_velocities_m_s=tuple(_velocities(folder, taken)),
            sun_direction=_sun(folder, case.rows[0]),
            truth=truth,
        )
    if folder.file.task == LANDING:
        return StoredCase(
            name=case.name,
            pictures=tuple(pictures),
            slant_range_m=case.rows[0].number("slant_range_m"),
            site_m=_site(folder, taken[0]),
            truth=truth,
        )
    if len({one.position_m is None for one in taken}) > 1:
        raise folder.error(case.rows[0], f"case '{case.name}': some pictures have a position and some have none")
    return StoredCase(name=case.name, pictures=tuple(pictures), truth=truth)


def _taken(folder: _Folder, row: PictureRow) -> _Taken:
    """A row's picture, with what its own label states where the row does not."""
    path = folder.source / row.texts["file"]
    labelled = is_pds3(file_head(path))
    camera = _camera(folder, row, path if labelled else None)
    product = read_pds3_product(path) if labelled else None
    counts = read_counts(path, camera.size) if product is None else product.counts
    _check_counts(folder, row, path, counts)
    attitude, position = _measured_pose(folder, row, product)
    _check_view(folder, row, camera, attitude)
    return _Taken(row, counts, camera, _time_s(folder, row, product), attitude, position)


def _time_s(folder: _Folder, row: PictureRow, product: Pds3Product | None) -> float:
    """When a picture was taken, by its row or else by its label."""
    stated = row.number("time_s")
    labelled = None if product is None else product.time_s
    if stated is None and labelled is None:
        raise folder.error(row, "time_s is empty, and no label states it")
    return float(stated if stated is not None else labelled or 0.0)


def _measured_pose(
    folder: _Folder, row: PictureRow, product: Pds3Product | None
) -> tuple[Rotation, Float64[np.ndarray, "3"] | None]:
    """Our body's attitude and place, by a picture's row or else by its label, which places the camera in the rover."""
    rotation = row.rotation()
    if rotation is not None:
        return _body_pose(folder, row, rotation, row.vector(POSITION))
    pose = None if product is None else product.site_from_rover
    if pose is None:
        raise folder.error(row, "qx to qw are empty, and no label states them")
    world = SITE_FROM_WORLD.inv()
    return world * pose.rotation, np.asarray(world.apply(pose.translation))


def _body_pose(
    folder: _Folder, row: PictureRow, rotation: Rotation, place: Float64[np.ndarray, "n"] | None
) -> tuple[Rotation, Float64[np.ndarray, "3"] | None]:
    """Our body's attitude and place from what the file holds."""
    poses = folder.file.poses
    if poses is None:
        raise folder.error(row, f"quaternions are given, but {INGEST_FILE} has no [poses] that says in which axes")
    vehicle = poses.world * rotation
    if place is None:
        return poses.bodies(vehicle), None
    return poses.bodies(vehicle), np.asarray(poses.world.apply(place) + poses.levers(vehicle))


def _camera(folder: _Folder, row: PictureRow, product: Path | None) -> CameraModel:
    """The picture's camera in the body frame."""
    stated = folder.file.camera
    named = row.texts.get("camera", stated.file)
    if named is None and product is None:
        raise folder.error(row, f"no camera: neither the column camera nor {INGEST_FILE}'s camera.file names one")
    path = folder.source / named if named is not None else product
    cameras = read_cameras(str(path), subframe_folded_in=stated.subframe_folded_in)
    if stated.number >= len(cameras):
        raise folder.error(row, f"{path}: holds {len(cameras)} cameras; camera.number is {stated.number}")
    camera = cameras[stated.number]
    # the row's own attitude is of a camera that looks down, or of the body that the file places it in
    placed = stated.placed or row.rotation() is None
    return camera if placed else looking_down(camera)


def _check_counts(folder: _Folder, row: PictureRow, path: Path, counts: UInt16[np.ndarray, "rows columns"]) -> None:
    full_scale = (1 << folder.file.detector.bits) - 1
    if counts.max() > full_scale:
        raise folder.error(
            row,
            f"{path}: holds counts up to {counts.max()}; detector.bits = {folder.file.detector.bits} allows "
            f"{full_scale}",
        )


def _flat(folder: _Folder, row: PictureRow, counts: UInt16[np.ndarray, "rows columns"]) -> Named | None:
    """The picture's flat field, written once; None where none is known."""
    stated = row.texts.get("flat_field", folder.file.detector.flat_field)
    if stated is None:
        return None
    path = folder.source / stated
    if path not in folder.flat_fields:
        response = _flat_field(path)
        name = f"{len(folder.flat_fields):06d}.npy"
        named = put_file(folder.target, "flat_fields", name, lambda path: np.save(path, response, allow_pickle=False))
        folder.flat_fields[path] = named, response.shape
    named, shape = folder.flat_fields[path]
    if shape != counts.shape:
        raise folder.error(row, f"{path}: has {shape[1]} x {shape[0]} pixels; {row.texts['file']} has others")
    return named


def _check_view(folder: _Folder, row: PictureRow, camera: CameraModel, attitude: Rotation) -> None:
    """A camera that looks for ground must look down."""
    if folder.file.task not in (VELOCITY, LANDING):
        return
    up = float(attitude.apply(camera.boresight())[2])
    if up >= 0.0:
        elevation = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
        raise folder.error(
            row,
            f"the camera looks up, {elevation:.1f} deg above the horizon; allowed: down ({INGEST_FILE}: "
            "poses.axes, attitude_of and mounting say whose axes are meant)",
        )


def _stored(folder: _Folder, picture: str, taken: _Taken) -> StoredPicture:
    camera = folder.cameras.get(taken.camera)
    if camera is None:
        camera = folder.cameras[taken.camera] = put_camera(folder.target, len(folder.cameras), taken.camera)
    row = taken.row
    if folder.file.task == LANDING and taken.position_m is None:
        raise folder.error(row, "x_m, y_m, z_m are empty; landing needs them")
    exposure = row.number("exposure_s")
    return StoredPicture(
        source=row.texts["file"],
        size=taken.camera.size,
        counts=put_file(folder.target, "pictures", f"{picture}.png", lambda path: write_picture(path, taken.counts)),
        camera=camera,
        flat_field=_flat(folder, row, taken.counts),
        time_s=taken.time_s,
        exposure_s=folder.file.detector.exposure_s if exposure is None else exposure,
        world_from_body_xyzw=_quaternion(taken.attitude),
        position_m=None if taken.position_m is None else _vector(taken.position_m),
        altitude_m=row.number("altitude_m"),
        altitude_time_s=row.number("altitude_time_s"),
    )


def _velocities(folder: _Folder, taken: Sequence[_Taken]) -> list[Vector]:
    """The inertial unit's mean velocities between the pictures, or those of the measured positions."""
    found = []
    for before, after in itertools.pairwise(taken):
        stated = after.row.vector(("vx_m_s", "vy_m_s", "vz_m_s"))
        if stated is not None:
            found.append(_vector(_world(folder, after.row).apply(stated)))
        elif before.position_m is not None and after.position_m is not None:
            found.append(_vector((after.position_m - before.position_m) / (after.time_s - before.time_s)))
        else:
            raise folder.error(after.row, "neither vx_m_s to vz_m_s nor positions are given; velocity needs them")
    return found


def _sun(folder: _Folder, row: PictureRow) -> Vector:
    stated = row.vector(("sun_azimuth_deg", "sun_elevation_deg"))
    sun = folder.file.sun
    if stated is not None:
        if not 0.0 < stated[1] <= 90.0:
            raise folder.error(row, f"sun_elevation_deg is {stated[1]:g}; allowed: above 0, at most 90")
        sun = SunTable.model_construct(azimuth_deg=float(stated[0]), elevation_deg=float(stated[1]))
    if sun is None:
        raise folder.error(row, f"no sun: neither sun_azimuth_deg and sun_elevation_deg nor {INGEST_FILE}'s [sun]")
    return _vector(sun.direction)


def _site(folder: _Folder, taken: _Taken) -> Vector:
    """The a-priori site: as stated, or the ground on the first picture's optical axis."""
    stated = taken.row.vector(("site_x_m", "site_y_m", "site_z_m"))
    if stated is not None:
        return _vector(_world(folder, taken.row).apply(stated))
    slant = taken.row.number("slant_range_m")
    if slant is None or taken.position_m is None:
        raise folder.error(taken.row, "neither slant_range_m nor site_x_m to site_z_m are given; landing needs one")
    place = taken.camera.c + slant * taken.camera.a
    return _vector(taken.position_m + taken.attitude.apply(place))


def _truth(folder: _Folder, taken: Sequence[_Taken]) -> StoredTruth:
    rows = [one.row for one in taken]
    turns = [row.rotation("true_") for row in rows]
    poses = [_true_pose(folder, row) for row in rows]
    places = [None if pose is None else pose[1] for pose in poses]
    velocity = _true_velocity(folder, taken, places) if folder.file.task == VELOCITY else None
    whole = [turn is not None and place is not None for turn, place in zip(turns, places, strict=True)]
    if any(whole) and not all(whole):
        raise folder.error(rows[0], "some pictures have a true pose and some have none")
    if not all(whole):
        return StoredTruth(velocity_m_s=velocity)
    known = tuple((_vector(place), _quaternion(turn)) for turn, place in filter(None, poses))
    return StoredTruth(velocity_m_s=velocity, poses=known)


def _true_pose(folder: _Folder, row: PictureRow) -> tuple[Rotation, Float64[np.ndarray, "3"]] | None:
    """Our body's true attitude and place; the measured attitude where no true one is given; None without a place."""
    place, turn = row.vector([f"true_{name}" for name in POSITION]), row.rotation("true_")
    turn = row.rotation() if turn is None else turn
    if place is None:
        return None
    if turn is None:
        raise folder.error(row, "a true position is given without an attitude, measured or true")
    attitude, position = _body_pose(folder, row, turn, place)
    return None if position is None else (attitude, position)


def _true_velocity(
    folder: _Folder, taken: Sequence[_Taken], places: Sequence[Float64[np.ndarray, "3"] | None]
) -> tuple[float, float] | None:
    """Mean velocity from the second to the third picture, as stated or by true positions."""
    last = taken[-1]
    stated = last.row.vector(("true_vx_m_s", "true_vy_m_s"))
    if stated is not None:
        east, north, _ = _world(folder, last.row).apply(np.array([stated[0], stated[1], 0.0]))
        return float(east), float(north)
    before, after = places[-2:]
    if before is None or after is None:
        return None
    moved = (after - before) / (last.time_s - taken[-2].time_s)
    return float(moved[0]), float(moved[1])


def _world(folder: _Folder, row: PictureRow) -> Rotation:
    if folder.file.poses is None:
        raise folder.error(row, f"vectors are given, but {INGEST_FILE} has no [poses] that says in which axes")
    return folder.file.poses.world


def _vector(values: Float64[np.ndarray, "3"]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _quaternion(rotation: Rotation) -> Quaternion:
    x, y, z, w = (float(value) for value in rotation.as_quat())
    return x, y, z, w
