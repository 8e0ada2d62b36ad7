"""Lossy coding of delivered images: companding to 8 bits in the camera, and wavelet compression for the downlink.

Companding: ``code = round(a (sqrt(count + b) - sqrt(b)))`` with ``a = 2 sqrt(b)``. The steps grow with the square root
of the count, as shot noise does, and the smallest step is one count. b is chosen such that full scale has code 255. A
code is expanded to the centre of its range of counts.

Compression: the Mars Exploration Rovers compress images with ICER, a wavelet coder, to about 1 to 3 bits per pixel
(Kiely & Klimesh 2003, IPN Progress Report 42-155). Here ICER is replaced by JPEG 2000, which is also a wavelet coder.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from scipy.optimize import brentq

Counts = UInt16[np.ndarray, "rows columns"]
CODES = 256  #: Number of 8-bit codes.


@cache
def compression_table(full_scale_dn: int) -> UInt8[np.ndarray, "counts"]:
    """Compute the companding code of every count. Raises ValueError if the full scale is below 255."""
    if full_scale_dn < CODES - 1:
        raise ValueError(f"the full scale of companded counts is {full_scale_dn}; allowed: {CODES - 1} or more")
    if full_scale_dn == CODES - 1:
        return np.arange(CODES, dtype=np.uint8)
    b = brentq(lambda x: 2.0 * (np.sqrt(x * (full_scale_dn + x)) - x) - (CODES - 1), 1e-3, 1e12)
    counts = np.arange(full_scale_dn + 1)
    table: UInt8[np.ndarray, "counts"] = np.rint(2.0 * (np.sqrt(b * (counts + b)) - b)).astype(np.uint8)
    table.setflags(write=False)
    return table


@cache
def expansion_table(full_scale_dn: int) -> UInt16[np.ndarray, "codes"]:
    """Compute the expanded count of every code."""
    table = compression_table(full_scale_dn)
    first = np.searchsorted(table, np.arange(CODES), side="left")
    last = np.searchsorted(table, np.arange(CODES), side="right") - 1
    counts: UInt16[np.ndarray, "codes"] = ((first + last) // 2).astype(np.uint16)
    counts.setflags(write=False)
    return counts


def compand(counts: Counts, full_scale_dn: int) -> UInt8[np.ndarray, "rows columns"]:
    """Compress counts to 8-bit codes (`compression_table`)."""
    return np.asarray(compression_table(full_scale_dn)[counts])


def expand(codes: UInt8[np.ndarray, "rows columns"], full_scale_dn: int) -> Counts:
    """Expand 8-bit codes to counts (`expansion_table`)."""
    return np.asarray(expansion_table(full_scale_dn)[codes])


#: Allowed compressed sizes, bits per pixel; minimum side of an image, which the coder halves five times.
MIN_BITS, MAX_BITS, MIN_SIDE_PX = 0.1, 16.0, 32


def compress_and_decompress(
    counts: UInt16[np.ndarray, "rows columns"], bits_per_pixel: float, full_scale_dn: int
) -> UInt16[np.ndarray, "rows columns"]:
    """Compress an image to `bits_per_pixel` and decompress it; no change if lossless coding needs fewer bits.

    Counts above `full_scale_dn`, from ringing at edges, are clipped. Raises ValueError if `bits_per_pixel` is not
    within `MIN_BITS` and `MAX_BITS`, or a side of the image is below `MIN_SIDE_PX`.
    """
    if min(counts.shape) < MIN_SIDE_PX:
        columns, rows = counts.shape[::-1]
        raise ValueError(
            f"an image of {columns} x {rows} pixels; allowed for compression: from {MIN_SIDE_PX} on each side"
        )
    if not MIN_BITS <= bits_per_pixel <= MAX_BITS:
        raise ValueError(f"{bits_per_pixel:g} bits per pixel; allowed: {MIN_BITS:g} to {MAX_BITS:g}")
    # the unit of this option is 16/1000 bits per pixel
    options = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, max(1, round(1000.0 * bits_per_pixel / 16.0))]
    _, encoded = cv2.imencode(".jp2", counts, options)
    decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED), dtype=np.uint16)
    return np.minimum(decoded, np.uint16(full_scale_dn))
