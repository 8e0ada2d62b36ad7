"""Lossy compression of delivered images, as on a mission's downlink.

The Mars Exploration Rovers compress images with ICER, a wavelet coder, to about 1 to 3 bits per pixel (Kiely & Klimesh
2003, IPN Progress Report 42-155). Here ICER is replaced by JPEG 2000, which is also a wavelet coder.
"""

import cv2
import numpy as np
from jaxtyping import UInt16

#: Allowed compressed sizes, bits per pixel.
MIN_BITS, MAX_BITS = 0.1, 16.0


def compress_and_decompress(
    counts: UInt16[np.ndarray, "rows columns"], bits_per_pixel: float, full_scale_dn: int
) -> UInt16[np.ndarray, "rows columns"]:
    """Compress an image to `bits_per_pixel` and decompress it; no change if lossless coding needs fewer bits.

    Counts above `full_scale_dn`, from ringing at edges, are clipped. Raises ValueError if `bits_per_pixel` is not
    within `MIN_BITS` and `MAX_BITS`.
    """
    if not MIN_BITS <= bits_per_pixel <= MAX_BITS:
        raise ValueError(f"{bits_per_pixel:g} bits per pixel; allowed: {MIN_BITS:g} to {MAX_BITS:g}")
    # the unit of this option is 16/1000 bits per pixel
    options = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, max(1, round(1000.0 * bits_per_pixel / 16.0))]
    _, encoded = cv2.imencode(".jp2", counts, options)
    decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED), dtype=np.uint16)
    return np.minimum(decoded, np.uint16(full_scale_dn))
