"""Exchange files: images of a descent, landing or rover stop as 16-bit PGM or PNG, cameras as `.cahvor`, and JSON.

The files are written for external programs. Reading restores counts, flat fields and numbers exactly, because JSON
stores the shortest decimal text that reads back as the same float64. Attitudes can differ by rounding errors, because
quaternions are normalised when they are read.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.exchange.values import decode, decode_pose, encode, encode_pose
from marsyard.sim.camera import BODY_FRAME, HEAD_FRAME, read_cahvor, write_cahvor
from marsyard.sim.measurements import (
    DescentFrame,
    DescentMeasurements,
    DetectorCalibration,
    DetectorImage,
    LandingMeasurements,
    MastCalibration,
    MastGeometry,
    MastImage,
    PixelTarget,
    RoverMeasurements,
    RoverTarget,
    SiteTarget,
    TargetDesignation,
)

#: Version of the exchange: of files, request lines and answers.
EXCHANGE_VERSION = 3

#: JSON files of a case and of a single descent image.
CASE_FILE, IMAGE_FILE = "case.json", "image.json"

#: Fields of `DetectorCalibration` except the flat field.
_CALIBRATION_KEYS = tuple(field.name for field in fields(DetectorCalibration) if field.name != "flat_field")
#: Key of the pose of a rover.
_ROVER = "world_from_rover"
#: JSON files of a mast and of a rover stop.
MAST_FILE, STOP_FILE = "mast.json", "stop.json"
#: Fields of `MastGeometry`: offsets between its joints, m, and limits of its angles, rad.
_OFFSET_KEYS, _LIMIT_KEYS = ("base_m", "elbow_m", "head_m"), ("azimuth_limits_rad", "elevation_limits_rad")
#: Image file format.
ImageFormat = Literal["pgm", "png"]


def write_case(
    folder: Path, measurements: DescentMeasurements | LandingMeasurements, image_format: ImageFormat = "pgm"
) -> None:
    """Write the measurements of a case into an existing folder. Raises OSError if that fails."""
    task = "velocity" if isinstance(measurements, DescentMeasurements) else "landing"
    images = write_images(folder, measurements.images, image_format)
    content = {"exchange": EXCHANGE_VERSION, "task": task, **encode(measurements, ["images"]), "images": images}
    write_json(folder / CASE_FILE, content)


def write_image(folder: Path, image: DetectorImage, content: Mapping[str, Any] | None = None) -> None:
    """Write one image and further values into an existing folder. Raises OSError if that fails."""
    (record,) = write_images(folder, [image], "pgm")
    write_json(folder / IMAGE_FILE, {"exchange": EXCHANGE_VERSION, "image": record, **(content or {})})


def write_frame(folder: Path, frame: DescentFrame) -> None:
    """Write one descent image and its measurements into an existing folder. Raises OSError if that fails."""
    write_image(folder, frame.image, encode(frame, ["image"]))


def read_detector_image(folder: Path) -> DetectorImage:
    """Read the image that `write_image` wrote. Raises ValueError if it is missing or has another version."""
    with _open_image(folder) as (image, _):
        return image


def read_frame(folder: Path) -> DescentFrame:
    """Read the frame that `write_frame` wrote. Raises ValueError if it is missing or has another version."""
    with _open_image(folder) as (image, content):
        return decode(DescentFrame, content, image=image)


@contextmanager
def _open_image(folder: Path) -> Iterator[tuple[DetectorImage, Mapping[str, Any]]]:
    """Yield the image that `write_image` wrote, and the table of its further values."""
    with open_json(folder / IMAGE_FILE, "descent image") as content:
        check_version(content)
        yield read_image(folder, content["image"]), content


def read_case(folder: Path) -> DescentMeasurements | LandingMeasurements:
    """Read the case that `write_case` wrote. Raises ValueError if it is missing or has another version."""
    with open_json(folder / CASE_FILE, "case") as content:
        check_version(content)
        images = tuple(read_image(folder, record) for record in content["images"])
        if content["task"] == "velocity":
            return decode(DescentMeasurements, content, images=images)
        return decode(LandingMeasurements, content, images=images)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a table of values as JSON. Raises ValueError if a value is not finite."""
    path.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def open_json(path: Path, kind: str) -> Iterator[Mapping[str, Any]]:
    """Yield the table of a JSON file; errors in the file or its use become a ValueError with the path and `kind`."""
    try:
        yield json.loads(path.read_text(encoding="utf-8"))
    except (OSError, KeyError, TypeError, IndexError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not a valid {kind} file: {error}") from error


def check_version(content: Mapping[str, Any]) -> None:
    """Raise ValueError if the table of a file has another version."""
    if content["exchange"] != EXCHANGE_VERSION:
        raise ValueError(f"exchange version {content['exchange']} is not supported; supported: {EXCHANGE_VERSION}")


def write_images(folder: Path, images: Sequence[DetectorImage], image_format: ImageFormat) -> list[dict[str, Any]]:
    """Write images, cameras and flat fields; equal flat fields are written once. Returns one JSON record per image."""
    records: list[dict[str, Any]] = []
    flat_fields: dict[str, Float[np.ndarray, "rows columns"]] = {}
    for number, image in enumerate(images, start=1):
        names = {"file": f"image_{number}.{image_format}", "camera": f"camera_{number}.cahvor"}
        detector = image.calibration
        write_counts(folder / names["file"], image.counts)
        write_cahvor(image.camera, folder / names["camera"], frame=BODY_FRAME)
        equal_files = (name for name, field in flat_fields.items() if np.array_equal(field, detector.flat_field))
        flat_file = next(equal_files, None)
        if flat_file is None:
            flat_file = f"flat_field_{len(flat_fields) + 1}.f64"
            flat_fields[flat_file] = detector.flat_field
            detector.flat_field.astype("<f8").tofile(folder / flat_file)
        rows, columns = image.counts.shape
        calibration = {"flat_field": flat_file, **{name: getattr(detector, name) for name in _CALIBRATION_KEYS}}
        size = {"columns": columns, "rows": rows}
        records.append({**names, "time_s": image.time_s, **size, "calibration": calibration})
    return records


def read_image(folder: Path, content: Mapping[str, Any]) -> DetectorImage:
    """Read an image from its record by `write_images`."""
    calibration, shape = content["calibration"], (content["rows"], content["columns"])
    flat_field = np.fromfile(folder / calibration["flat_field"], dtype="<f8").reshape(shape).astype(np.float64)
    return DetectorImage(
        counts=read_counts(folder / content["file"]),
        time_s=content["time_s"],
        camera=read_cahvor(folder / content["camera"]),
        calibration=DetectorCalibration(flat_field, **{name: calibration[name] for name in _CALIBRATION_KEYS}),
    )


def write_counts(path: Path, counts: UInt16[np.ndarray, "rows columns"]) -> None:
    """Write image counts as `.pgm` (P5, two bytes per pixel, big-endian) or `.png` (16 bits)."""
    if path.suffix == ".pgm":
        rows, columns = counts.shape
        path.write_bytes(b"P5\n%d %d\n65535\n" % (columns, rows) + counts.astype(">u2").tobytes())
    elif not cv2.imwrite(str(path), counts):
        raise OSError(f"{path} cannot be written")


def read_counts(path: Path) -> UInt16[np.ndarray, "rows columns"]:
    """Read the image counts that `write_counts` wrote; raises ValueError unless the image is single-channel, 16-bit."""
    counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if counts is None or counts.dtype != np.uint16 or counts.ndim != 2:
        raise ValueError(f"{path} is not a single-channel 16-bit image")
    return np.asarray(counts, dtype=np.uint16)


def write_mast(folder: Path, mast: MastCalibration) -> None:
    """Write a mast and its two cameras into an existing folder."""
    content: dict[str, Any] = {
        name: np.asarray(getattr(mast.geometry, name)).tolist() for name in _OFFSET_KEYS + _LIMIT_KEYS
    }
    for name, camera in (("left", mast.left), ("right", mast.right)):
        write_cahvor(camera, folder / f"{name}.cahvor", frame=HEAD_FRAME)
        content[name] = {"camera": f"{name}.cahvor", "columns": camera.size[0], "rows": camera.size[1]}
    write_json(folder / MAST_FILE, content)


def read_mast(folder: Path) -> MastCalibration:
    """Read the mast that `write_mast` wrote. Raises ValueError if it is missing."""
    with open_json(folder / MAST_FILE, "mast") as content:
        left, right = (read_cahvor(folder / content[name]["camera"]) for name in ("left", "right"))
        base, elbow, head = (np.array(content[name], dtype=np.float64) for name in _OFFSET_KEYS)
        azimuths, elevations = ((content[name][0], content[name][1]) for name in _LIMIT_KEYS)
        return MastCalibration(MastGeometry(base, elbow, head, azimuths, elevations), left, right)


def write_stop(folder: Path, measurements: RoverMeasurements) -> None:
    """Write the images and mast angles measured at one rover stop (imaging position), without the mast calibration."""
    content: dict[str, Any] = {name: getattr(measurements, name) for name in ("azimuth_rad", "elevation_rad")}
    content |= encode_rover_pose(measurements.world_from_rover)
    for name, image in (("left", measurements.left), ("right", measurements.right)):
        write_counts(folder / f"{name}.pgm", image.counts)
        rows, columns = image.counts.shape
        content[name] = {"file": f"{name}.pgm", "corner": list(image.corner), "columns": columns, "rows": rows}
    write_json(folder / STOP_FILE, content)


def read_stop(folder: Path, mast: MastCalibration) -> RoverMeasurements:
    """Read the stop that `write_stop` wrote; add the given `mast`. Raises ValueError if the stop is missing."""
    with open_json(folder / STOP_FILE, "stop") as content:
        left, right = (
            MastImage(read_counts(folder / record["file"]), (int(record["corner"][0]), int(record["corner"][1])))
            for record in (content["left"], content["right"])
        )
        azimuth, elevation = float(content["azimuth_rad"]), float(content["elevation_rad"])
        return RoverMeasurements(left, right, mast, azimuth, elevation, read_pose(content[_ROVER]))


def encode_rover_pose(pose: RigidTransform) -> dict[str, dict[str, Any]]:
    """Encode the pose of a rover as a table of a request or file."""
    return {_ROVER: encode_pose(_ROVER, pose)}


def read_pose(content: Mapping[str, Any]) -> RigidTransform:
    """Decode the table of a rover's pose."""
    return decode_pose(_ROVER, content)


def read_target(content: Mapping[str, Any]) -> TargetDesignation:
    """Decode a target designation: pixel, rover or site coordinates."""
    if "pixel" in content:
        return decode(PixelTarget, content)
    if "position_rover" in content:
        return decode(RoverTarget, content)
    return decode(SiteTarget, content)
