"""Read the images and flat fields of `marsyard ingest`: PNG, PGM and TIFF of one band with 8 or 16 bits."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.measured.layout import IngestError
from marsyard.sim.files import open_regular, read_npy_header, report_damage

#: Number of first bytes that are read as header: enough for a PGM file with comments.
_HEADER_BYTES = 4096
#: Maximum number of pixels along a side of a flat field.
_MAX_SIDE = 16384
#: Maximum relative response: noise raises the response of the brightest pixel slightly above 1.
_MAX_RESPONSE = 1.5
#: Tags of a TIFF file (image width, image length and orientation), and the type of 16-bit values.
_TIFF_WIDTH, _TIFF_LENGTH, _TIFF_ORIENTATION, _TIFF_SHORT = 256, 257, 274, 3
#: First bytes of a TIFF file in each byte order, and of a PNG file.
_TIFF_STARTS, _PNG_START = (b"II*\0", b"MM\0*"), b"\x89PNG\r\n\x1a\n"
#: Maximum number of chunks of a PNG file that are searched for its orientation.
_MAX_CHUNKS, _MAX_EXIF_BYTES = 100_000, 1 << 16
#: Header of a PGM file: width and height, with comments between them.
_PGM = re.compile(rb"\AP[25]\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s")
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


def read_counts(path: Path, size: tuple[int, int]) -> UInt16[np.ndarray, "rows columns"]:
    """Decode an image after its header has confirmed the size (columns, rows).

    Raises IngestError if the file is unreadable, or of another format or size.
    """
    columns, rows = read_image_size(path)
    if (columns, rows) != size:
        raise IngestError(
            f"{path}: has {columns} x {rows} pixels; its camera has {size[0]} x {size[1]} (columns x rows)"
        )
    counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if counts is None:
        raise IngestError(f"{path}: cannot be decoded; {_ALLOWED}")
    if counts.ndim != 2:
        raise IngestError(f"{path}: has {counts.shape[2]} bands; {_ALLOWED}")
    if counts.dtype not in (np.uint8, np.uint16):
        raise IngestError(f"{path}: its counts are {counts.dtype}; {_ALLOWED}")
    return np.asarray(counts, dtype=np.uint16)


def read_image_size(path: Path) -> tuple[int, int]:
    """Read (columns, rows) from the header. Raises IngestError for other formats."""
    head = read_header(path)
    if head.startswith(_PNG_START) and len(head) >= 24:  # width and height in the IHDR chunk
        metadata = _read_png_exif(path)
        if metadata[:4] in _TIFF_STARTS:
            _check_orientation(path, _read_tiff_tags(path, io.BytesIO(metadata)))
        return struct.unpack(">II", head[16:24])
    pgm = _PGM.match(head)
    if pgm is not None:
        return int(pgm[1]), int(pgm[2])
    if head[:4] in _TIFF_STARTS:
        with open_regular(path) as file:
            tags = _read_tiff_tags(path, file)
        if not {_TIFF_WIDTH, _TIFF_LENGTH} <= set(tags):
            raise IngestError(f"{path}: is a damaged TIFF: its first directory contains no size")
        _check_orientation(path, tags)
        return tags[_TIFF_WIDTH], tags[_TIFF_LENGTH]
    raise IngestError(f"{path}: is not a supported image; {_ALLOWED}")


def _read_tiff_tags(path: Path, file: BinaryIO) -> dict[int, int]:
    """Read the size and the orientation in the first directory of a TIFF file or of metadata in its format."""
    tags: dict[int, int] = {}
    try:
        order = "<" if file.read(4).startswith(b"II") else ">"
        file.seek(struct.unpack(f"{order}I", file.read(4))[0])
        (entries,) = struct.unpack(f"{order}H", file.read(2))
        for _ in range(entries):
            tag, kind, _count, value = struct.unpack(f"{order}HHI4s", file.read(12))
            if tag in (_TIFF_WIDTH, _TIFF_LENGTH, _TIFF_ORIENTATION):
                (tags[tag],) = struct.unpack_from(f"{order}{'H' if kind == _TIFF_SHORT else 'I'}", value)
    except (OSError, struct.error) as error:
        raise IngestError(f"{path}: is a damaged TIFF: {error}") from error
    return tags


def _read_png_exif(path: Path) -> bytes:
    """Read the metadata of a PNG file (chunk eXIf), which can contain an orientation; empty if there are none."""
    with open_regular(path) as file:
        file.seek(len(_PNG_START))
        for _ in range(_MAX_CHUNKS):
            header = file.read(8)
            if len(header) < 8 or header[4:] == b"IEND":
                break
            length = int.from_bytes(header[:4], "big")
            if header[4:] == b"eXIf":
                return file.read(min(length, _MAX_EXIF_BYTES))
            file.seek(length + 4, io.SEEK_CUR)
    return b""


def _check_orientation(path: Path, tags: Mapping[int, int]) -> None:
    """Raise IngestError for a rotated image: the camera model can describe the stored or the displayed image."""
    orientation = tags.get(_TIFF_ORIENTATION, 1)
    if orientation not in (0, 1):  # 0 is not defined, and written by programs that do not know the orientation
        raise IngestError(
            f"{path}: has the orientation {orientation} (rotated or mirrored); allowed: 1 (row 0 is the top, column 0 "
            "the left side): write the image in the orientation of its camera model, without the tag"
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
            counts = read_counts(path, read_image_size(path))
            response = counts / max(int(counts.max()), 1)
    if not np.all(np.isfinite(response)) or response.min() <= 0.0 or response.max() > _MAX_RESPONSE:
        raise IngestError(f"{path}: is not a valid flat field; allowed: two dimensions, above 0, maximum about 1")
    return response
