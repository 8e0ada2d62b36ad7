"""Readers of camera files of any format, which detect the format."""

from pathlib import Path

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibrations import HEAD_BYTES, is_calibration, read_calibrations
from marsyard.sim.camera.file_reading import FORMATS, Source, is_xml, refuse_foreign, xml_root
from marsyard.sim.camera.jpl_files import read_cahvor
from marsyard.sim.camera.label_frames import ROVER_FRAME, FramedCamera
from marsyard.sim.camera.pds3 import is_pds3, read_pds3
from marsyard.sim.camera.pds4 import read_pds4

#: Start of the names of root elements of PDS4 labels.
_PDS4_ROOT = "Product_"


def read_cameras(
    path: str | Path, *, subframe_folded_in: bool = False, size: tuple[int, int] | None = None
) -> tuple[CameraModel, ...]:
    """Detect the format of a file and read every camera model in it.

    Formats: a PDS3 label or product, a PDS4 label, a JPL text file (`read_cahvor`), or a calibration of OpenCV, ROS,
    Kalibr, EuRoC, COLMAP or Ames Stereo Pipeline (`read_calibrations`, which also reports the residuals).

    - subframe_folded_in: accept PDS labels of subframes and averaged pixels; the vectors are assumed to describe the
      stored image
    - size: (columns, rows) of the image, required for files that do not contain it: JPL text files without the line
      Dimensions, and models of Ames Stereo Pipeline; a camera of other files must have this size

    Models of PDS labels are returned in the vehicle's frame if the label contains the transform to it, else in the
    site's or the Mars-fixed frame; `read_framed_cameras` also returns the frame. Raises CameraFileError if the file
    cannot be read or is wrong. The message contains file, field and allowed values.
    """
    return tuple(
        framed.camera for framed in read_framed_cameras(path, subframe_folded_in=subframe_folded_in, size=size)
    )


def read_framed_cameras(
    path: str | Path, *, subframe_folded_in: bool = False, size: tuple[int, int] | None = None
) -> tuple[FramedCamera, ...]:
    """Read every camera model as `read_cameras` does, with its frame.

    Files other than PDS labels do not name the frame; their models are assumed to be in the vehicle's frame.
    """
    source = Source(str(path))
    cameras = _read_any_format(source, subframe_folded_in, size)
    sizes = sorted({framed.camera.size for framed in cameras})
    if size is not None and size not in sizes:
        allowed = " or ".join(f"{columns} x {rows}" for columns, rows in sizes)
        raise source.error("size", f"{size[0]} x {size[1]}", f"{allowed}, the size in the file")
    return cameras


def _read_any_format(
    source: Source, subframe_folded_in: bool, size: tuple[int, int] | None
) -> tuple[FramedCamera, ...]:
    """Detect the format of a file and read its cameras; `size` is used only for files without the image's size."""
    path, leading_bytes = source.path, source.read_head(HEAD_BYTES)
    if is_pds3(leading_bytes):
        return read_pds3(path, subframe_folded_in=subframe_folded_in)
    refuse_foreign(source, leading_bytes)
    if is_calibration(leading_bytes):
        calibrations = read_calibrations(path, size=size)
        return tuple(FramedCamera(calibration.camera, ROVER_FRAME) for calibration in calibrations)
    if is_xml(leading_bytes):
        root = xml_root(leading_bytes)
        if not root.startswith(_PDS4_ROOT):
            raise source.error("file", f"is XML with the root element {root!r}", FORMATS)
        return read_pds4(path, subframe_folded_in=subframe_folded_in)
    if b"\0" in leading_bytes:
        raise source.error("file", "is binary and no PDS3 product", FORMATS)
    return (FramedCamera(read_cahvor(path, size=size), ROVER_FRAME),)


def read_camera(path: str | Path, *, subframe_folded_in: bool = False) -> CameraModel:
    """Read a file with one camera model, as `read_cameras` does. Raises CameraFileError also if it has several."""
    cameras = read_cameras(path, subframe_folded_in=subframe_folded_in)
    if len(cameras) != 1:
        raise Source(str(path)).error("camera models", f"{len(cameras)} of them", "one, or use read_cameras")
    return cameras[0]
