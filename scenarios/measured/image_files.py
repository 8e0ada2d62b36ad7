"""Read the images and flat fields of `marsyard ingest`: PNG, PGM and TIFF of one band with 8 or 16 bits."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt16
from PIL import ExifTags, Image, UnidentifiedImageError

from marsyard.scenarios.measured.layout import IngestError
from marsyard.sim.files import open_regular, read_npy_header, report_damage

#: Number of first bytes that `read_header` reads.
_HEADER_BYTES = 4096
#: Maximum number of pixels along a side of a flat field.
_MAX_SIDE = 16384
#: Maximum relative response: noise raises the response of the brightest pixel slightly above 1.
_MAX_RESPONSE = 1.5
#: Pillow's names of the formats; PPM includes PGM.
_FORMATS = ("PNG", "PPM", "TIFF")
_ALLOWED = "allowed: PNG, PGM or TIFF of one band with 8 or 16 bits, or a PDS3 product"


def read_header(path: Path) -> bytes:
    """Read the file's first bytes. Raises IngestError if the file is missing, empty or unreadable."""
    try:
        with open_regular(path) as file:
            head = file.read(_HEADER_BYTES)
    except OSError as error:
        raise IngestError(f"{path}: {error.strerror or error}") from error
    if not head:
        raise IngestError(f"{path}: is empty (0 bytes)")
    return head


def read_counts(path: Path, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "rows columns"]:
    """Decode an image after its header has confirmed the size (columns, rows); None for any size.

    Raises IngestError if the file is unreadable, of another format or size, or rotated.
    """
    read_header(path)
    _check_metadata(path, size)
    counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if counts is None:
        raise IngestError(f"{path}: cannot be decoded; {_ALLOWED}")
    if counts.ndim != 2:
        raise IngestError(f"{path}: has {counts.shape[2]} bands; {_ALLOWED}")
    if counts.dtype not in (np.uint8, np.uint16):
        raise IngestError(f"{path}: its counts are {counts.dtype}; {_ALLOWED}")
    return np.asarray(counts, dtype=np.uint16)


def _check_metadata(path: Path, size: tuple[int, int] | None) -> None:
    """Raise IngestError for another format or size, or a rotated image.

    The camera model of a rotated image can describe the stored or the displayed image. Pillow refuses images that are
    too large to be decoded.
    """
    with (
        report_damage(path, IngestError, "cannot be decoded", f"; {_ALLOWED}"),
        warnings.catch_warnings(action="ignore"),
        open_regular(path) as file,
    ):
        try:
            image = Image.open(file, formats=_FORMATS)
        except UnidentifiedImageError as error:
            raise IngestError(f"{path}: is not a supported image; {_ALLOWED}") from error
        except Image.DecompressionBombError as error:
            limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
            raise IngestError(f"{path}: has too many pixels; allowed: at most {limit}") from error
        orientation, (columns, rows) = image.getexif().get(ExifTags.Base.Orientation, 1), image.size
    if orientation not in (0, 1):  # 0 is not defined, and written by programs that do not know the orientation
        raise IngestError(
            f"{path}: has the orientation {orientation} (rotated or mirrored); allowed: 1 (row 0 is the top, column 0 "
            "the left side): write the image in the orientation of its camera model, without the tag"
        )
    if size is not None and (columns, rows) != size:
        raise IngestError(
            f"{path}: has {columns} x {rows} pixels; its camera has {size[0]} x {size[1]} (columns x rows)"
        )


def read_flat_field(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """Read a flat field: an array unchanged, or an image divided by its largest count. Raises IngestError."""
    head = read_header(path)
    with report_damage(path, IngestError, "is not a valid flat field"):
        if head.startswith(b"\x93NUMPY"):
            with path.open("rb") as file:
                shape, dtype = read_npy_header(file)
            if len(shape) != 2 or max(shape) > _MAX_SIDE or dtype.kind not in "iuf":
                raise ValueError(f"contains an array of shape {shape} and type {dtype}")
            response = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
        else:
            counts = read_counts(path)
            response = counts / max(int(counts.max()), 1)
    if not np.all(np.isfinite(response)) or response.min() <= 0.0 or response.max() > _MAX_RESPONSE:
        raise IngestError(f"{path}: is not a valid flat field; allowed: two dimensions, above 0, maximum about 1")
    return response
