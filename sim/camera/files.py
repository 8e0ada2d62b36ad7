"""Reading a camera from any file that holds one."""

from __future__ import annotations

from pathlib import Path

from marsyard.sim.camera.assembly import CameraFileError, Source
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibrations import is_calibration, read_calibrations
from marsyard.sim.camera.pds4_labels import is_xml, read_pds4
from marsyard.sim.camera.pds_labels import is_pds3, read_pds3
from marsyard.sim.camera.text_files import read_cahvor

__all__ = ["CameraFileError", "read_camera", "read_cameras"]

#: So much of a file tells what it is.
_HEAD = 4096


def read_cameras(
    path: str | Path, *, subframe_folded_in: bool = False, size: tuple[int, int] | None = None
) -> tuple[CameraModel, ...]:
    """Every camera model of a file, whichever of these it is.

    A PDS3 label or product (`read_pds3`), a PDS4 label (`read_pds4`), a JPL text file (`read_cahvor`), or a calibration
    of OpenCV, ROS, Kalibr or EuRoC in YAML (`read_calibrations`, which says how near the models are).

    Parameters
    ----------
    path
        The file.
    subframe_folded_in
        Of PDS labels: takes the model of a subframe, or of averaged pixels, to describe the stored picture.
    size
        (columns, rows) of the pictures, for JPL text files without the line Dimensions.

    Raises
    ------
    CameraFileError
        If the file cannot be read or is wrong; it names file, field and what is allowed.
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
    """The one camera model of a file, as `read_cameras`.

    Raises
    ------
    CameraFileError
        Also if the file holds several.
    """
    cameras = read_cameras(path, subframe_folded_in=subframe_folded_in)
    if len(cameras) != 1:
        raise Source(str(path)).error("camera models", f"{len(cameras)} of them", "one, or use read_cameras")
    return cameras[0]
