"""Small images of the products of a case."""

import base64

import cv2
import numpy as np

from marsyard.reports.products import Products

#: Size of thumbnails, pixels, and their JPEG quality.
_THUMBNAIL_PX, _THUMBNAIL_QUALITY = 96, 70
#: Minimum size of an image, pixels. An image that is wider by a larger ratio than this has summed rows.
_MIN_IMAGE_PX, _MAX_ASPECT = 48, 2.0


def thumbnail(products: Products) -> str:
    """Return a square preview of a case's last image as a data URI; empty if the products contain no image.

    An image is a product at the top level with integer values and two dimensions.
    """
    images = [value for value in products.values() if isinstance(value, np.ndarray) and _is_image(value)]
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


def _is_image(value: np.ndarray) -> bool:
    return value.ndim == 2 and np.issubdtype(value.dtype, np.integer) and min(value.shape) >= _MIN_IMAGE_PX
