"""Twelve bits in eight: counts through a square-root table and back.

A step of the table grows with the square root of the count, as shot noise does. The table is

    code = round(a (sqrt(count + b) - sqrt(b))),   a = 2 sqrt(b)

so that the steps begin with one count, with b such that the full scale has code 255; every code is used. A code is
expanded to the middle of its counts.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import UInt8, UInt16
from scipy.optimize import brentq

CODES = 256


@cache
def compression_table(full_scale_dn: int) -> UInt8[np.ndarray, "counts"]:
    """Code of every count from 0 to the full scale.

    Raises
    ------
    ValueError
        If the full scale is below 255: there is nothing to compress.
    """
    if full_scale_dn < CODES - 1:
        raise ValueError(f"counts up to {full_scale_dn} need no companding; allowed: {CODES - 1} or more")
    if full_scale_dn == CODES - 1:
        return np.arange(CODES, dtype=np.uint8)
    b = brentq(lambda x: 2.0 * (np.sqrt(x * (full_scale_dn + x)) - x) - (CODES - 1), 1e-3, 1e12)
    counts = np.arange(full_scale_dn + 1)
    table: UInt8[np.ndarray, "counts"] = np.rint(2.0 * (np.sqrt(b * (counts + b)) - b)).astype(np.uint8)
    table.setflags(write=False)
    return table


@cache
def expansion_table(full_scale_dn: int) -> UInt16[np.ndarray, "codes"]:
    """Count of every code."""
    table = compression_table(full_scale_dn)
    first = np.searchsorted(table, np.arange(CODES), side="left")
    last = np.searchsorted(table, np.arange(CODES), side="right") - 1
    counts: UInt16[np.ndarray, "codes"] = ((first + last) // 2).astype(np.uint16)
    counts.setflags(write=False)
    return counts


def compand(counts: UInt16[np.ndarray, "rows columns"], full_scale_dn: int) -> UInt8[np.ndarray, "rows columns"]:
    """Eight-bit codes of counts."""
    return np.asarray(compression_table(full_scale_dn)[counts])


def expand(codes: UInt8[np.ndarray, "rows columns"], full_scale_dn: int) -> UInt16[np.ndarray, "rows columns"]:
    """Counts of eight-bit codes."""
    return np.asarray(expansion_table(full_scale_dn)[codes])
