"""Reading a camera from any file that holds one."""

from __future__ import annotations

from pathlib import Path

from sim.camera.assembly import CameraFileError, Source
from sim.camera.base import CameraModel
from sim.camera.pds_labels import is_pds3, read_pds3
from sim.camera.text_files import read_cahvor

__all__ = ["CameraFileError", "read_camera", "read_cameras"]


def read_cameras(path: str | Path) -> tuple[CameraModel, ...]:
    """Every camera model of a file: of a PDS3 label or product (`read_pds3`), or of a JPL text file (`read_cahvor`).

    Raises
    ------
    CameraFileError
        If the file cannot be read or is wrong; it names file, field and what is allowed.
    """
    if is_pds3(Source(str(path)).head(4096)):
        return read_pds3(path)
    return (read_cahvor(path),)


def read_camera(path: str | Path) -> CameraModel:
    """The one camera model of a file, as `read_cameras`.

    Raises
    ------
    CameraFileError
        Also if the file holds several.
    """
    cameras = read_cameras(path)
    if len(cameras) != 1:
        raise Source(str(path)).error("GEOMETRIC_CAMERA_MODEL", f"{len(cameras)} of them", "one, or use read_cameras")
    return cameras[0]
