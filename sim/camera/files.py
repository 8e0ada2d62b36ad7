"""Reading cameras from a file of any supported format."""

from __future__ import annotations

from pathlib import Path

from marsyard.sim.camera.assembly import Source
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibrations import is_calibration, read_calibrations
from marsyard.sim.camera.pds3 import is_pds3, read_pds3
from marsyard.sim.camera.pds4 import is_xml, read_pds4
from marsyard.sim.camera.text_files import read_cahvor

#: Number of bytes that identify a format.
_HEAD = 4096


def read_cameras(
    path: str | Path, *, subframe_folded_in: bool = False, size: tuple[int, int] | None = None
) -> tuple[CameraModel, ...]:
    """Read every camera model of a file, by its format.

    Formats: a PDS3 label or product (`read_pds3`), a PDS4 label (`read_pds4`), a JPL text file (`read_cahvor`), a
    calibration of OpenCV, ROS, Kalibr or EuRoC in YAML (`read_calibrations`, which also reports the residuals).

    - subframe_folded_in: PDS labels: the model of a subframe, or of averaged pixels, describes the stored picture
    - size: (columns, rows) of the pictures, for JPL text files without the line Dimensions

    Raises CameraFileError if the file cannot be read or is wrong; it names file, field and allowed values.
    """
    head = Source(str(path)).head(_HEAD)
    if is_pds3(head):
        return read_pds3(path, subframe_folded_in=subframe_folded_in)
    if is_xml(head):
        return read_pds4(path, subframe_folded_in=subframe_folded_in)
    if is_calibration(head):
        return tuple(one.camera for one in read_calibrations(path))
    return (read_cahvor(path, size=size),)


def read_camera(path: str | Path, *, subframe_folded_in: bool = False) -> CameraModel:
    """Read the only camera model of a file, as `read_cameras`. Raises CameraFileError also if it has several."""
    cameras = read_cameras(path, subframe_folded_in=subframe_folded_in)
    if len(cameras) != 1:
        raise Source(str(path)).error("camera models", f"{len(cameras)} of them", "one, or use read_cameras")
    return cameras[0]
