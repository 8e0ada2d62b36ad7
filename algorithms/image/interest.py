"""Interest operators for the selection of templates and features: structure tensor and Harris interest."""

import cv2
import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Raster


def structure_tensor(image: Raster, support: int) -> tuple[Raster, Raster, Raster]:
    """Mean products of the image gradients over a square of side `support` (pixels) around every pixel.

    Returns the means of g_u g_u, g_v g_v and g_u g_v for the gradient g, squared counts per squared pixel. The Sobel
    gradient is scaled to 1 for a ramp of one count per pixel; image borders are mirrored.
    """
    values = image.astype(np.float32, copy=False)
    gradient_u = cv2.Sobel(values, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    gradient_v = cv2.Sobel(values, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    size = (support, support)
    return (
        np.asarray(cv2.sqrBoxFilter(gradient_u, cv2.CV_32F, size)),
        np.asarray(cv2.sqrBoxFilter(gradient_v, cv2.CV_32F, size)),
        np.asarray(cv2.boxFilter(gradient_u * gradient_v, cv2.CV_32F, size)),
    )


def harris_interest(
    uu: Float[np.ndarray, "*shape"], vv: Float[np.ndarray, "*shape"], uv: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Harris interest from the entries of `structure_tensor`, in counts per pixel.

    This is Noble's form of the Harris operator, ``determinant / trace`` of the mean structure tensor, which has no free
    constant. The returned ``sqrt(2 determinant / trace)`` is the root mean square gradient per axis if the texture is
    isotropic; it is near zero without texture or with texture in one direction only.
    """
    determinant = np.maximum(uu * vv - uv * uv, 0.0)
    trace = uu + vv
    ratio = np.divide(2.0 * determinant, trace, out=np.zeros_like(trace), where=trace > 0)
    return np.asarray(np.sqrt(ratio))
