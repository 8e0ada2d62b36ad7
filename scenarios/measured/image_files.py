"""Read the files of `marsyard ingest`: images, maps and flat fields as PNG, PGM or TIFF of one band with 8 or 16 bits.

Images and maps of the task `map` can also be JPEG, and in colour: published copies usually are. Elevations, and flat
fields of real numbers, are `.npy` arrays.
"""

import warnings
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt16
from PIL import ExifTags, Image, UnidentifiedImageError

from marsyard.scenarios.measured.layout import IngestError
from marsyard.scenarios.missing_heights import find_missing_value
from marsyard.sim.camera.pds3 import is_pds3
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
#: Lossy formats, and the bands of colours, for the task `map`.
LOSSY_FORMATS = ("JPEG", "JPEG2000")
_ALLOWED_PUBLISHED = "allowed: PNG, PGM, TIFF or JPEG with 8 or 16 bits"
_COLOURS = 3
#: Tag of the meaning of counts in a TIFF, and its value for negative images. OpenCV inverts those of 8 bits only.
_PHOTOMETRIC, _WHITE_IS_ZERO = ExifTags.Base.PhotometricInterpretation, 0


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


def read_counts(
    path: Path, size: tuple[int, int] | None = None, *, is_published: bool = False
) -> UInt16[np.ndarray, "rows columns"]:
    """Decode an image after its header has confirmed the size (columns, rows); None for any size.

    A published image can be in a lossy format and in colour; its bands are averaged. Raises IngestError if the file is
    unreadable, of another format or size, or rotated.
    """
    read_header(path)
    allowed = _ALLOWED_PUBLISHED if is_published else _ALLOWED
    read_format(path, size, is_published=is_published)
    counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if counts is None:
        raise IngestError(f"{path}: cannot be decoded; {allowed}")
    if counts.dtype not in (np.uint8, np.uint16):
        raise IngestError(f"{path}: its counts are {counts.dtype}; {allowed}")
    if is_published and counts.ndim == 3 and counts.shape[2] >= _COLOURS:
        counts = np.rint(counts[..., :_COLOURS].mean(axis=2, dtype=np.float32))
    if counts.ndim != 2:
        raise IngestError(f"{path}: has {counts.shape[2]} bands; {allowed}")
    return np.asarray(counts, dtype=np.uint16)


def lossy_bits_per_pixel(path: Path) -> float | None:
    """Return the size of an image file in a lossy format, bits per pixel; None for other formats."""
    if is_pds3(read_header(path)):
        return None
    name, (columns, rows) = read_format(path, is_published=True)
    return 8.0 * path.stat().st_size / (columns * rows) if name in LOSSY_FORMATS else None


def read_elevation(path: Path, size: tuple[int, int], pixel_m: float) -> Float32[np.ndarray, "rows columns"]:
    """Read an array of elevations, and interpolate it to a number of columns and rows. Raises IngestError.

    - pixel_m: size of a pixel after the interpolation
    """
    elevation = _read_array(path, "array of elevations").astype(np.float32)
    if not np.all(np.isfinite(elevation)):
        raise IngestError(f"{path}: has elevations that are not finite; allowed: metres, without holes")
    missing = find_missing_value(elevation.astype(np.float64), pixel_m * size[0] / elevation.shape[1])
    if missing is not None:
        raise IngestError(
            f"{path}: the elevation {missing.height_m:g} m at {missing.posts} points is probably a value for missing "
            "data; allowed: metres, without holes"
        )
    return np.asarray(cv2.resize(elevation, size, interpolation=cv2.INTER_LINEAR))


def read_format(path: Path, size: tuple[int, int] | None = None, *, is_published: bool) -> tuple[str, tuple[int, int]]:
    """Return the format of an image and its size (columns, rows).

    Raises IngestError for another format or size, or a rotated image.

    The camera model of a rotated image can describe the stored or the displayed image. Pillow refuses images that are
    too large to be decoded.
    """
    allowed = _ALLOWED_PUBLISHED if is_published else _ALLOWED
    formats = (*_FORMATS, *LOSSY_FORMATS) if is_published else _FORMATS
    with (
        report_damage(path, IngestError, "cannot be decoded", f"; {allowed}"),
        warnings.catch_warnings(action="ignore"),
        open_regular(path) as file,
    ):
        try:
            image = Image.open(file, formats=formats)
        except UnidentifiedImageError as error:
            raise IngestError(f"{path}: is not a supported image; {allowed}") from error
        except Image.DecompressionBombError as error:
            limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
            raise IngestError(f"{path}: has too many pixels; allowed: at most {limit}") from error
        if image.format == "TIFF" and image.getexif().get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
            raise IngestError(
                f"{path}: its counts are 0 for white (PhotometricInterpretation 0); allowed: 0 for black (1)"
            )
        if image.format in LOSSY_FORMATS:
            image.load()  # OpenCV fills the missing part of a truncated file with grey
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
    return image.format or "", (columns, rows)


def read_flat_field(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """Read a flat field: an array unchanged, or an image divided by its largest count. Raises IngestError."""
    head = read_header(path)
    if head.startswith(b"\x93NUMPY"):
        response = _read_array(path, "flat field")
    else:
        counts = read_counts(path)
        response = counts / max(int(counts.max()), 1)
    if not np.all(np.isfinite(response)) or response.min() <= 0.0 or response.max() > _MAX_RESPONSE:
        raise IngestError(f"{path}: is not a valid flat field; allowed: two dimensions, above 0, maximum about 1")
    return response


def _read_array(path: Path, content: str) -> Float64[np.ndarray, "rows columns"]:
    """Read a `.npy` of numbers with two dimensions. Raises IngestError."""
    read_header(path)
    with report_damage(path, IngestError, f"is not a valid {content}"):
        with path.open("rb") as file:
            shape, dtype = read_npy_header(file)
        if len(shape) != 2 or max(shape) > _MAX_SIDE or dtype.kind not in "iuf":
            raise ValueError(f"contains an array of shape {shape} and type {dtype}")
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
