"""Pebbles and granules on the ground: half spheroids at random positions of nested grids, with their shadows.

Each octave of diameters has a square grid, turned against those of the others, whose cells are twice the largest
diameter wide. A hash of the cell decides whether it contains a pebble, and its position, diameter, outline and albedo.
Like texture, pebbles belong to the ground: they change normals, albedo and shadows, but not the range. A pixel has one
ray and sees means over its footprint: outlines are blurred, normals of small pebbles flattened, and pebbles fade where
they become smaller than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import drjit as dr

from marsyard.sim.render.arrays import Values, clip, larger, smaller
from marsyard.sim.render.device import Array3f, Float, Float64, Int32, UInt32
from marsyard.sim.render.noise import hash_cell, mix_bits
from marsyard.sim.terrain.sites import SitePebbles

#: Width of a cell divided by the largest diameter of its octave: a pebble and its shadow touch at most four cells.
CELL_DIAMETERS = 2.0
#: Smallest diameter of an octave, divided by its largest.
_SMALLEST = 0.5
#: Range of the ratio of the axes of the outline (assumed), and diameter in footprints at which an octave vanishes.
_MIN_AXIS_RATIO, _MIN_FOOTPRINTS = 0.6, 0.5
#: Light that the sides of a pebble take from the mean over its outline (fitted, see the test); its shadow takes that of
#: half an ellipse beyond the outline.
SIDE_LOSS = 0.25
#: Sides of patches of equal density, in cells, and half the range of the relative density, where cells have room for
#: more pebbles (assumed).
_PATCH_CELLS, _PATCHINESS = (3, 11), 0.7
#: Angle between the grids of successive octaves, radians: no two of ten octaves are nearly parallel.
_TURN = math.pi * (3.0 - math.sqrt(5.0))
#: Maximum length of a shadow, in diameters, so that it ends in a neighbouring cell.
_MAX_SHADOW = 1.0


@dataclass(frozen=True, eq=False)
class PebbleField:
    """Pebbles on the device; see `marsyard.sim.terrain.sites.SitePebbles`.

    - largest: largest diameter of the coarsest octave, metres; halved with each octave
    - octaves: number of octaves
    - probability, patchiness: mean probability that a cell contains a pebble, and half the range of its relative values
    - coverage: fraction of the ground that one octave covers
    - height_ratio, log_albedo, log_albedo_sd: of a pebble
    """

    largest: Values
    octaves: Values
    probability: Values
    patchiness: Values
    coverage: Values
    height_ratio: Values
    log_albedo: Values
    log_albedo_sd: Values

    @classmethod
    def of(cls, pebbles: SitePebbles) -> PebbleField:
        """Copy pebbles to the device."""
        p = pebbles
        octaves = max(math.ceil(math.log2(p.largest_m / p.smallest_m) - 1e-9), 1)
        # mean area of an outline relative to a cell; the diameter, and the ratio of axes, are distributed uniformly
        mean_square = (1.0 - _SMALLEST**3) / (3.0 * (1.0 - _SMALLEST))
        area = 0.25 * math.pi * mean_square * 0.5 * (1.0 + _MIN_AXIS_RATIO) / CELL_DIAMETERS**2
        probability = min(p.coverage / octaves / area, 1.0)
        patchiness = min(_PATCHINESS, 1.0 / max(probability, 1e-6) - 1.0)
        densities = (probability, patchiness, p.coverage / octaves)
        numbers = map(Float, (*densities, p.height_ratio, p.log_albedo, p.log_albedo_sd))
        return cls(Float64(p.largest_m), UInt32(octaves), *numbers)


@dataclass(eq=False)
class PebbleSurface:
    """The pebbles that a pixel sees: normal relative to level ground, log albedo, shaded fraction, and lost light.

    `loss` is the mean fraction of direct sunlight that the visible pebbles and their shadows take from the ground.
    The normal, not of unit length, and the log albedo are means over the pixel: those of ground without pebbles are
    (0, 0, 1) and 0.
    """

    normal: Values
    log_albedo: Values
    shadow: Values
    loss: Values


def _uniform(h: Values, shift: int) -> Values:
    """Convert eight bits of a hash to a number between 0 and 1."""
    return (Float((h >> shift) & 255) + 0.5) * (1.0 / 256.0)


def _local_probability(pebbles: PebbleField, cell: list[Values], octave: Values) -> Values:
    """Probability that a cell contains a pebble: it differs between patches of cells of two sizes."""
    numbers = [
        _uniform(hash_cell([component // side for component in cell], octave + UInt32(side << 8)), 0)
        for side in _PATCH_CELLS
    ]
    return pebbles.probability * (1.0 + pebbles.patchiness * (numbers[0] + numbers[1] - 1.0))


def _evaluate_cell(
    pebbles: PebbleField,
    octave: Values,
    diameter: Values,
    cell: list[Values],
    offset: list[Values],
    footprint: Values,
    sun: Values,
) -> tuple[Values, PebbleSurface]:
    """Evaluate the pebble of one cell: covered fraction of the pixel, and its surface.

    - cell: column and row of the cell
    - offset: position relative to the cell's corner, metres
    """
    width, first = CELL_DIAMETERS * diameter, hash_cell(cell, octave)
    second = mix_bits(first + UInt32(0x9E3779B1))
    number = Float(((first >> 24) << 8) | (second >> 24)) * (1.0 / 65536.0)
    exists = number < _local_probability(pebbles, cell, octave)
    size = diameter * (_SMALLEST + (1.0 - _SMALLEST) * _uniform(first, 0))
    centre = [0.5 * size + (width - size) * _uniform(second, shift) for shift in (0, 8)]
    # offset from the centre in radii, stretched along a random axis of the outline
    x, y = (2.0 * (position - middle) / size for position, middle in zip(offset, centre, strict=True))
    axis_y, axis_x = dr.sincos(math.pi * _uniform(first, 8))
    stretch = 1.0 / (_MIN_AXIS_RATIO + (1.0 - _MIN_AXIS_RATIO) * _uniform(second, 16)) - 1.0
    across = stretch * (x * axis_x + y * axis_y)
    x, y = x + across * axis_x, y + across * axis_y
    squared = x * x + y * y
    # the mean over a pixel is a ramp across the outline, divided by 1 + edge**2 / 12 to preserve the outline's area
    edge = larger(2.0 * footprint / size, 1e-3)
    visible = dr.select(exists, 1.0 / (1.0 + edge * edge * (1.0 / 12.0)), 0.0)
    covered = visible * clip((1.0 - dr.sqrt(squared)) / edge + 0.5, 0.0, 1.0)
    # half spheroid: the normal is in proportion to (x / r, y / r, z / h**2)
    height = 2.0 * pebbles.height_ratio
    upwards = dr.sqrt(larger(1.0 - squared, 0.04))
    # mean over the covered part of the footprint (fitted, see the test)
    slope = height / (1.0 + 0.25 * edge * edge)
    normal = dr.normalize(Array3f(x * slope, y * slope, upwards))
    log_albedo = pebbles.log_albedo + pebbles.log_albedo_sd * 3.464 * (_uniform(first, 16) - 0.5)
    # nearest distance of the ray to the sun from the axis of the spheroid, in units in which it is a sphere
    sun_across = stretch * (sun.x * axis_x + sun.y * axis_y)
    sun_x, sun_y = sun.x + sun_across * axis_x, sun.y + sun_across * axis_y
    along = (x * sun_x + y * sun_y) / (sun_x * sun_x + sun_y * sun_y + (sun.z / height) ** 2)
    miss = dr.sqrt(larger(squared - along * (x * sun_x + y * sun_y), 0.0))
    shadow = dr.select(along < 0.0, visible * clip((1.0 - miss) / edge + 0.5, 0.0, 1.0), 0.0) * (1.0 - covered)
    return covered, PebbleSurface(normal, log_albedo, shadow, Float(0.0))


def pebble_surface(pebbles: PebbleField, position: Values, footprint: Values, sun: Values) -> PebbleSurface:
    """Compute the pebbles at positions on the ground for pixels with a footprint, metres, under a sun (unit vector)."""
    limit = Float64(_MIN_FOOTPRINTS * footprint)
    # a low sun is raised, so that no shadow is longer than `_MAX_SHADOW` diameters
    horizontal = larger(dr.sqrt(sun.x * sun.x + sun.y * sun.y), 1e-6)
    sun_z = larger(sun.z, horizontal * pebbles.height_ratio / _MAX_SHADOW)
    stretch = 2.0 * pebbles.height_ratio * horizontal / sun_z
    loss = pebbles.coverage * (SIDE_LOSS + 0.5 * (dr.sqrt(1.0 + stretch * stretch) - 1.0))

    def add_octave(octave: Values, diameter: Values, total: PebbleSurface) -> tuple[Values, Values, PebbleSurface]:
        width = CELL_DIAMETERS * diameter
        sine, cosine = dr.sincos(Float64(octave) * _TURN)
        turned = [position.x * cosine + position.y * sine, position.y * cosine - position.x * sine]
        sin, cos = Float(sine), Float(cosine)
        light = Array3f(sun.x * cos + sun.y * sin, sun.y * cos - sun.x * sin, sun_z)
        step_x, step_y = (dr.select(component > 0.0, Int32(1), -1) for component in (light.x, light.y))
        columns, offsets = [], []
        for coordinate in turned:
            floor = dr.floor(coordinate / width)
            columns.append(Int32(floor))
            offsets.append(Float(coordinate - floor * width))
        # an octave vanishes where its largest pebbles are smaller than the limit
        ratio = smaller(_MIN_FOOTPRINTS * footprint / Float(diameter), 1.0)
        fade = (1.0 - ratio * ratio) * (1.0 - ratio * ratio)
        shadow = Float(0.0)
        for j, i in product((0, 1), repeat=2):
            cell = [columns[0] + i * step_x, columns[1] + j * step_y]
            offset = [offsets[0] - Float(i * step_x) * Float(width), offsets[1] - Float(j * step_y) * Float(width)]
            covered, surface = _evaluate_cell(pebbles, octave, Float(diameter), cell, offset, footprint, light)
            shadow = larger(shadow, surface.shadow)
            if (i, j) == (0, 0):
                weight = fade * covered
                x, y, z = surface.normal
                normal = dr.lerp(total.normal, Array3f(x * cos - y * sin, x * sin + y * cos, z), weight)
                log_albedo = dr.lerp(total.log_albedo, surface.log_albedo, weight)
        shaded = dr.lerp(total.shadow * (1.0 - weight), 1.0, fade * shadow)
        return octave + 1, 0.5 * diameter, PebbleSurface(normal, log_albedo, shaded, total.loss + fade * loss)

    state = (
        UInt32(0),
        Float64(pebbles.largest),
        PebbleSurface(Array3f(0.0, 0.0, 1.0), Float(0.0), Float(0.0), Float(0.0)),
    )
    return dr.while_loop(
        state, lambda octave, diameter, total: (octave < pebbles.octaves) & (diameter > limit), add_octave
    )[2]
