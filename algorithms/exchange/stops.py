"""What a target tracker is given, as files and JSON: the mast as calibrated, a stop's pictures, poses, designations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.exchange.files import read_picture, reading, write_json, write_picture
from marsyard.sim.camera import HEAD_FRAME, read_cahvor, write_cahvor
from marsyard.sim.frames import rigid
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

MAST_FILE, STOP_FILE = "mast.json", "stop.json"
_OFFSETS, _LIMITS = ("base_m", "elbow_m", "head_m"), ("azimuth_limits_rad", "elevation_limits_rad")


def write_mast(folder: Path, mast: MastCalibration) -> None:
    """Writes a mast and its two cameras into a folder that is there."""
    for name, camera in (("left", mast.left), ("right", mast.right)):
        write_cahvor(camera, folder / f"{name}.cahvor", frame=HEAD_FRAME)
    geometry = mast.geometry
    content = {
        **{name: getattr(geometry, name).tolist() for name in _OFFSETS},
        **{name: list(getattr(geometry, name)) for name in _LIMITS},
        "left": {"camera": "left.cahvor", "columns": mast.left.size[0], "rows": mast.left.size[1]},
        "right": {"camera": "right.cahvor", "columns": mast.right.size[0], "rows": mast.right.size[1]},
    }
    write_json(folder / MAST_FILE, content)


def read_mast(folder: Path) -> MastCalibration:
    """Reads what `write_mast` wrote. Raises ValueError where the folder holds no mast."""
    with reading(folder / MAST_FILE, "mast") as content:
        left, right = (read_cahvor(folder / content[name]["camera"]) for name in ("left", "right"))
        base, elbow, head = (np.array(content[name], dtype=np.float64) for name in _OFFSETS)
        azimuths, elevations = ((content[name][0], content[name][1]) for name in _LIMITS)
        return MastCalibration(MastGeometry(base, elbow, head, azimuths, elevations), left, right)


def write_stop(folder: Path, measurements: RoverMeasurements) -> None:
    """Writes a stop's pictures and angles into a folder that is there; the mast has a file of its own."""
    content: dict[str, Any] = {
        "azimuth_rad": measurements.azimuth_rad,
        "elevation_rad": measurements.elevation_rad,
        "world_from_rover": encode_pose(measurements.world_from_rover),
    }
    for name, image in (("left", measurements.left), ("right", measurements.right)):
        write_picture(folder / f"{name}.pgm", image.counts)
        rows, columns = image.counts.shape
        content[name] = {"file": f"{name}.pgm", "corner": list(image.corner), "columns": columns, "rows": rows}
    write_json(folder / STOP_FILE, content)


def read_stop(folder: Path, mast: MastCalibration) -> RoverMeasurements:
    """Reads what `write_stop` wrote. Raises ValueError where the folder holds no stop."""
    with reading(folder / STOP_FILE, "stop") as content:
        left, right = (
            MastImage(
                read_picture(folder / content[name]["file"]),
                (int(content[name]["corner"][0]), int(content[name]["corner"][1])),
            )
            for name in ("left", "right")
        )
        azimuth, elevation = float(content["azimuth_rad"]), float(content["elevation_rad"])
        return RoverMeasurements(left, right, mast, azimuth, elevation, read_pose(content["world_from_rover"]))


def encode_pose(pose: RigidTransform) -> dict[str, list[float]]:
    """A rover's pose: position in the world and unit quaternion, scalar last."""
    return {
        "position_world_m": np.asarray(pose.translation).tolist(),
        "world_from_rover_xyzw": pose.rotation.as_quat().tolist(),
    }


def read_pose(content: Mapping[str, Any]) -> RigidTransform:
    """Read what `encode_pose` wrote."""
    return rigid(
        Rotation.from_quat(content["world_from_rover_xyzw"]), np.array(content["position_world_m"], dtype=np.float64)
    )


def encode_target(target: TargetDesignation) -> dict[str, Any]:
    """A designation, in one of the three ways."""
    match target:
        case PixelTarget():
            angles = {"azimuth_rad": target.azimuth_rad, "elevation_rad": target.elevation_rad}
            return {"pixel": target.pixel.tolist(), **angles}
        case RoverTarget():
            return {"position_rover": target.position_rover.tolist()}
        case SiteTarget():
            return {"position_site": target.position_site.tolist()}


def read_target(content: Mapping[str, Any]) -> TargetDesignation:
    """Read what `encode_target` wrote."""
    if "pixel" in content:
        return PixelTarget(
            np.array(content["pixel"], dtype=np.float64), content["azimuth_rad"], content["elevation_rad"]
        )
    if "position_rover" in content:
        return RoverTarget(np.array(content["position_rover"], dtype=np.float64))
    return SiteTarget(np.array(content["position_site"], dtype=np.float64))
