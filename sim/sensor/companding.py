"""Companding of counts to 8-bit codes with steps that grow with the square root of the count, as shot noise does.

``code = round(a (sqrt(count + b) - sqrt(b)))`` with ``a = 2 sqrt(b)``, so that the smallest step is one count. b is
chosen such that full scale has code 255. A code is expanded to the centre of its range of counts.
"""

from functools import cache

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
