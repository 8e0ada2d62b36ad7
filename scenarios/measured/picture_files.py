"""Pictures as they come: PNG, PGM and TIFF of one band with 8 or 16 bits. PDS3 products are read by
`marsyard.sim.camera`.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt16

from marsyard.scenarios.measured.layout import IngestError
from marsyard.sim.files import open_regular

#: A header of a PGM with comments is shorter.
_HEAD = 4096
_PGM = re.compile(rb"\AP[25]\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s")
_ALLOWED = "allowed: PNG, PGM or TIFF of one band with 8 or 16 bits, or a PDS3 product"


def file_head(path: Path) -> bytes:
    """The file's first bytes. Raises IngestError where it is not there, empty, or cannot be read."""
    try:
        with open_regular(path) as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise IngestError(f"{path}: {error.strerror or error}") from error
    if not head:
        raise IngestError(f"{path}: is empty (0 bytes)")
    return head


def read_counts(path: Path, size: tuple[int, int]) -> UInt16[np.ndarray, "rows columns"]:
    """The counts of a picture that must have a size (columns, rows); looked at by its header before it is decoded.

    Raises
    ------
    IngestError
        Where it cannot be read, is of another kind, or of another size.
    """
    found = picture_size(path)
    if found != size:
        raise IngestError(
            f"{path}: has {found[0]} x {found[1]} pixels; its camera has {size[0]} x {size[1]} (columns x rows)"
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
    """(columns, rows) as the header states them. Raises IngestError where it is no picture that is read."""
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
    """From the first directory: tags 256 (width) and 257 (length), each a number of 16 or 32 bits."""
    extents: dict[int, int] = {}
    try:
        with path.open("rb") as file:
            file.seek(4)
            file.seek(struct.unpack(f"{order}I", file.read(4))[0])
            (entries,) = struct.unpack(f"{order}H", file.read(2))
            for _ in range(entries):
                tag, kind, _count, value = struct.unpack(f"{order}HHI4s", file.read(12))
                if tag in (256, 257):
                    extents[tag] = (
                        struct.unpack(f"{order}H", value[:2])[0] if kind == 3 else struct.unpack(f"{order}I", value)[0]
                    )
    except (OSError, struct.error) as error:
        raise IngestError(f"{path}: is a damaged TIFF: {error}") from error
    if len(extents) != 2:
        raise IngestError(f"{path}: is a damaged TIFF: its first directory states no size")
    return extents[256], extents[257]
