"""Exchange files of a rover: the mast with its cameras, the images of a stop, poses and targets.

The files are written for external programs (`files` describes their accuracy).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.exchange.files import open_json, read_counts, write_counts, write_json
from marsyard.algorithms.exchange.values import decode, decode_pose, encode_pose
from marsyard.sim.camera import HEAD_FRAME, read_cahvor, write_cahvor
from marsyard.sim.measurements import (
    MastCalibration,
    MastGeometry,
    MastImage,
    PixelTarget,
    RoverMeasurements,
    RoverTarget,
    SiteTarget,
    TargetDesignation,
)

#: Key of the pose of a rover.
_ROVER = "world_from_rover"
#: JSON files of a mast and of a rover stop.
MAST_FILE, STOP_FILE = "mast.json", "stop.json"
#: Fields of `MastGeometry`: offsets between its joints, m, and limits of its angles, rad.
_OFFSET_KEYS, _LIMIT_KEYS = ("base_m", "elbow_m", "head_m"), ("azimuth_limits_rad", "elevation_limits_rad")


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
