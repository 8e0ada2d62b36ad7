"""Read pictures (PNG, PGM and TIFF of one band with 8 or 16 bits) and flat fields."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.measured.layout import IngestError
from marsyard.sim.files import npy_header, open_regular

#: Bytes that hold the header of a PGM file with comments.
_HEADER_BYTES = 4096
#: Largest number of pixels along a side of a flat field.
_MAX_SIDE = 16384
#: Largest relative response: noise makes that of the brightest pixel a little more than 1.
_MAX_RESPONSE = 1.5
_PGM = re.compile(rb"\AP[25]\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s")
_ALLOWED = "allowed: PNG, PGM or TIFF of one band with 8 or 16 bits, or a PDS3 product"


def file_head(path: Path) -> bytes:
    """Read the file's first bytes. Raises IngestError where the file is missing, empty or unreadable."""
    try:
        with open_regular(path) as file:
            head = file.read(_HEADER_BYTES)
    except OSError as error:
        raise IngestError(f"{path}: {error.strerror or error}") from error
    if not head:
        raise IngestError(f"{path}: is empty (0 bytes)")
    return head


def read_counts(path: Path, size: tuple[int, int]) -> UInt16[np.ndarray, "rows columns"]:
    """Decode a picture after its header has confirmed the size (columns, rows).

    Raises IngestError where the file is unreadable, or of another format or size.
    """
    columns, rows = picture_size(path)
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


def picture_size(path: Path) -> tuple[int, int]:
    """Read (columns, rows) from the header. Raises IngestError for other formats."""
    head = file_head(path)
    if head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) >= 24:
        return struct.unpack(">II", head[16:24])
    pgm = _PGM.match(head)
    if pgm is not None:
        return int(pgm[1]), int(pgm[2])
    if head[:4] in (b"II*\0", b"MM\0*"):
        return _tiff_size(path, "<" if head.startswith(b"II") else ">")
    raise IngestError(f"{path}: is no picture that is read; {_ALLOWED}")


def _tiff_size(path: Path, order: str) -> tuple[int, int]:
    """Read tags 256 (width) and 257 (length) of the first directory, each a number of 16 or 32 bits."""
    extents: dict[int, int] = {}
    try:
        with path.open("rb") as file:
            file.seek(4)
            file.seek(struct.unpack(f"{order}I", file.read(4))[0])
            (entries,) = struct.unpack(f"{order}H", file.read(2))
            for _ in range(entries):
                tag, kind, _count, value = struct.unpack(f"{order}HHI4s", file.read(12))
                if tag in (256, 257):
                    (extents[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", value)
    except (OSError, struct.error) as error:
        raise IngestError(f"{path}: is a damaged TIFF: {error}") from error
    if len(extents) != 2:
        raise IngestError(f"{path}: is a damaged TIFF: its first directory states no size")
    return extents[256], extents[257]


def read_flat_field(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """Read a relative response: an array as it is, a picture divided by its largest count. Raises IngestError."""
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
    if not np.all(np.isfinite(response)) or response.min() <= 0.0 or response.max() > _MAX_RESPONSE:
        raise IngestError(f"{path}: is no flat field; allowed: two dimensions, numbers above 0, about 1 at the largest")
    return response
