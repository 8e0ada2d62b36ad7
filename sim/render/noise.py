"""Gradient noise (Perlin, "Improving noise", 2002) in the plane and in space.

Positions have double precision; the offsets from the lattice points, and the noise, have single precision.
"""

import math
from itertools import product

import drjit as dr

from marsyard.sim.render.arrays import Values
from marsyard.sim.render.device import Float, Int32, UInt32

#: Odd factors of the lattice coordinates and of the seed in the hash of a lattice point.
_HASH_FACTORS, _HASH_SEED = (0x8DA6B343, 0xD8163841, 0xCB1AB31F), 0x9E3779B1
#: Components of the gradients in the plane: eight unit vectors, evenly spaced in angle.
_LONG, _SHORT = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)


def _locate(position: list[Values], cell: Values, seed: Values) -> tuple[Values, list[Values]]:
    """Compute the hash sum of the lower corner of each position's lattice cell, and the offset from it, in cells."""
    lattice, offsets = seed * UInt32(_HASH_SEED), []
    for coordinate, factor in zip(position, _HASH_FACTORS, strict=False):
        grid = coordinate / cell
        floor = dr.floor(grid)
        offsets.append(Float(grid - floor))
        lattice = lattice + UInt32(Int32(floor)) * UInt32(factor)
    return lattice, offsets


def hash_cell(cell: list[Values], seed: Values) -> Values:
    """Hash the integer coordinates of a lattice cell."""
    lattice = seed * UInt32(_HASH_SEED)
    for coordinate, factor in zip(cell, _HASH_FACTORS, strict=False):
        lattice = lattice + UInt32(coordinate) * UInt32(factor)
    return mix_bits(lattice)


def mix_bits(h: Values) -> Values:
    """Mix the bits of a hash (the finaliser of MurmurHash3)."""
    h = (h ^ (h >> 16)) * UInt32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * UInt32(0xC2B2AE35)
    return h ^ (h >> 16)


def _fade(t: Values) -> Values:
    """Compute Perlin's interpolation weight 6 t^5 - 15 t^4 + 10 t^3."""
    return t * t * t * dr.fma(t, dr.fma(t, 6.0, -15.0), 10.0)


def _product_with_gradient(h: Values, x: Values, y: Values, z: Values) -> Values:
    """Scalar product of an offset and one of Perlin's twelve gradients, selected by the last four bits of a hash."""
    h = h & 15
    first = dr.select(h < 8, x, y)
    second = dr.select(h < 4, y, dr.select((h & 13) == 12, x, z))
    return dr.select((h & 1) != 0, -first, first) + dr.select((h & 2) != 0, -second, second)


def noise_in_space(position: list[Values], cell: Values, seed: Values) -> Values:
    """Compute smooth noise of mean zero; its wavelengths are one to two cells."""
    lattice, offsets = _locate(position, cell, seed)
    u, v, w = (_fade(offset) for offset in offsets)
    corners = []
    for k, j, i in product((0, 1), repeat=3):
        h = lattice + UInt32((i * _HASH_FACTORS[0] + j * _HASH_FACTORS[1] + k * _HASH_FACTORS[2]) & 0xFFFFFFFF)
        corners.append(_product_with_gradient(mix_bits(h), offsets[0] - i, offsets[1] - j, offsets[2] - k))
    for weight in (u, v, w):
        corners = [dr.fma(weight, b - a, a) for a, b in zip(corners[::2], corners[1::2], strict=True)]
    return corners[0]


def _gradient(h: Values) -> tuple[Values, Values]:
    """Select one of eight gradients in the plane by the last three bits of a hash."""
    is_long = (h & 1) != 0
    x, y = dr.select(is_long, Float(_LONG), Float(_SHORT)), dr.select(is_long, Float(_SHORT), Float(_LONG))
    return dr.select((h & 2) != 0, -x, x), dr.select((h & 4) != 0, -y, y)


def noise_in_plane(position: list[Values], cell: Values, seed: Values) -> tuple[Values, Values, Values]:
    """Compute noise of mean zero, and its derivatives along x and y, per cell."""
    lattice, (x, y) = _locate(position, cell, seed)
    x1, y1 = x - 1.0, y - 1.0
    u, v, du, dv = _fade(x), _fade(y), 30.0 * (x * x1) * (x * x1), 30.0 * (y * y1) * (y * y1)
    factor_x, factor_y = _HASH_FACTORS[:2]
    ax, ay = _gradient(mix_bits(lattice))
    bx, by = _gradient(mix_bits(lattice + UInt32(factor_x)))
    cx, cy = _gradient(mix_bits(lattice + UInt32(factor_y)))
    dx, dy = _gradient(mix_bits(lattice + UInt32((factor_x + factor_y) & 0xFFFFFFFF)))
    a = dr.fma(ax, x, ay * y)
    difference_x = dr.fma(bx, x1, by * y) - a
    difference_y = dr.fma(cx, x, cy * y1) - a
    twist = dr.fma(dx, x1, dy * y1) - a - difference_x - difference_y
    rise_x, rise_y = dr.fma(v, twist, difference_x), dr.fma(u, twist, difference_y)
    return (
        dr.fma(u, rise_x, dr.fma(v, difference_y, a)),
        dr.fma(du, rise_x, _bilinear(ax, bx, cx, dx, u, v)),
        dr.fma(dv, rise_y, _bilinear(ay, by, cy, dy, u, v)),
    )


def _bilinear(a: Values, b: Values, c: Values, d: Values, u: Values, v: Values) -> Values:
    """Interpolate between four corners."""
    below, above = dr.fma(u, b - a, a), dr.fma(u, d - c, c)
    return dr.fma(v, above - below, below)
