"""Products of a case (arrays and texts that it stores for its figures): reading by type and shape, and a preview."""

import base64
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

Products = Mapping[str, Any]


def numeric_product(value: object) -> Float[np.ndarray, "..."] | None:
    """Convert a product to float64; None if it is not numeric."""
    if value is None:
        return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def to_matrix(value: object) -> Float[np.ndarray, "_ _"] | None:
    """Convert a product to a non-empty array of two dimensions; None if it is not one."""
    values = numeric_product(value)
    return values if values is not None and values.ndim == 2 and values.size else None


#: Shape of a product: lengths, names of lengths that are equal in products read together, and None for any length.
Shape = tuple[int | str | None, ...]


def check_shape(value: object, *shape: int | None) -> Float[np.ndarray, "..."] | None:
    """Convert a product to an array of a shape, where None is any length; None if it has another shape."""
    arrays = read_arrays({"value": value}, {"value": shape})
    return None if arrays is None else arrays[0]


def read_arrays(
    products: Products, shapes: Mapping[str, Shape], *, finite: bool = False
) -> list[Float[np.ndarray, "..."]] | None:
    """Read products by name and shape; None if a product is missing, invalid, or not finite if `finite` is set."""
    arrays, lengths = [], dict[str, int]()
    for name, shape in shapes.items():
        values = numeric_product(products.get(name))
        if values is None or values.ndim != len(shape) or (finite and not np.isfinite(values).all()):
            return None
        for required, length in zip(shape, values.shape, strict=True):
            expected = lengths.setdefault(required, length) if isinstance(required, str) else required
            if expected not in (None, length):
                return None
        arrays.append(values)
    return arrays


#: Size of thumbnails, pixels, and their JPEG quality.
_THUMBNAIL_PX, _THUMBNAIL_QUALITY = 96, 70
#: Minimum size of an image, pixels. From this ratio of its sides, an image has binned rows or columns: it is scaled to
#: a square, not cropped.
_MIN_IMAGE_PX, _MAX_ASPECT = 48, 2.0


def thumbnail(products: Products) -> str:
    """Return a square preview of a case's last image as a data URI; empty if the products contain no image.

    An image is a product at the top level with integer values and two dimensions.
    """
    images = [value for value in products.values() if isinstance(value, np.ndarray) and value.ndim == 2]
    images = [image for image in images if np.issubdtype(image.dtype, np.integer) and min(image.shape) >= _MIN_IMAGE_PX]
    if not images:
        return ""
    image = images[-1].astype(np.float32)
    rows, columns = image.shape
    if columns < _MAX_ASPECT * rows and rows < _MAX_ASPECT * columns:
        size = min(rows, columns)
        top, left = (rows - size) // 2, (columns - size) // 2
        image = image[top : top + size, left : left + size]
    low, high = np.percentile(image, (1.0, 99.0))
    small = cv2.resize(image, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    grey = np.clip((small - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode()}"
