"""Pebbles and granules on the ground: flattened stones at random positions of nested grids, with their shadows.

The number of pebbles larger than D is in proportion to a power of D. Each grid, turned against the others, contains the
pebbles of one octave of the diameter; its cells are twice the largest diameter wide. A hash of the cell decides whether
it contains a pebble, and its position, diameter, outline, height and albedo. Pebbles are many where the ground is
darker than its mean (lag in hollows, coarse grains on crests), and rare where it is brighter (dust). They are many in
rough surface units, and rare in smooth ones. Like texture, pebbles belong to the ground: they change normals, albedo
and shadows, but not the range. A pixel has one ray and sees means over its footprint: outlines are blurred, normals of
small pebbles flattened, and pebbles fade where they become smaller than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values, clip, larger, smaller
from marsyard.sim.render.device import Array3f, Float, Float64, Int32, UInt32
from marsyard.sim.render.noise import hash_cell, mix_bits
from marsyard.sim.terrain.sites import SitePebbles
from marsyard.sim.terrain.surface import ROUGHNESS, Surface

#: Width of a cell divided by the largest diameter of its octave: a pebble and its shadow, together not longer than a
#: cell, lie in the four cells nearest to the middle between them.
CELL_DIAMETERS = 2.0
#: Maximum length of a shadow, in diameters.
_MAX_SHADOW = 1.0
#: Range of the ratio of the axes of the outline, half the relative range of the height, depth of the three corners of
#: the outline, and maximum slope of the random tilt of a pebble, divided by that of its side (all assumed).
_MIN_AXIS_RATIO, _HEIGHT_SPREAD, _CORNERS, _TILT = 0.5, 0.5, 0.3, 0.4
_MEAN_AXIS_RATIO = 0.5 * (1.0 + _MIN_AXIS_RATIO)
#: Diameter in footprints at which an octave vanishes.
_MIN_FOOTPRINTS = 0.5
#: Light that the sides of a pebble take from the mean over its outline (fitted, see the test); its shadow takes that of
#: half an ellipse beyond the outline.
SIDE_LOSS = 0.25
#: Natural logarithm of the density of pebbles where the logarithm of the albedo is one standard deviation below its
#: mean, relative to that at the mean, and maximum of the density relative to its mean (assumed).
PATCHINESS, MAX_DENSITY = 1.2, 8.0
#: Width of a uniform distribution divided by its standard deviation: the square root of 12.
_UNIFORM_WIDTH = 3.464
#: Minimum of the squared height of a half spheroid, divided by that of its top, for its normal: edges are not vertical.
_MIN_UPWARDS = 0.04
#: Numbers that are added to a cell's hash for its second and third hash.
_SECOND_HASH, _THIRD_HASH = 0x9E3779B1, 0x7F4A7C15
#: Angle between the grids of successive octaves, radians: no two of ten octaves are nearly parallel.
_TURN = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class PebbleField:
    """Pebbles on the device; see `marsyard.sim.terrain.sites.SitePebbles`.

    - largest: largest diameter of the coarsest octave, metres; halved with each octave
    - octaves: number of octaves
    - probability: mean probability that a cell of the coarsest octave contains a pebble
    - ratio, growth, root: with the exponent q of the cumulative number of pebbles, 2**q - 1, 2**(q - 2) and -1 / q
    - cell_coverage: fraction of a cell that its pebble covers in the mean
    - height_ratio, log_albedo, log_albedo_sd: of a pebble
    - ground_mean, ground_sd: mean and standard deviation of the logarithm of the ground's albedo
    - roughness: mean roughness of the surface units
    """

    largest: Values
    octaves: Values
    probability: Values
    ratio: Values
    growth: Values
    root: Values
    cell_coverage: Values
    height_ratio: Values
    log_albedo: Values
    log_albedo_sd: Values
    ground_mean: Values
    ground_sd: Values
    roughness: Values

    @classmethod
    def of(cls, pebbles: SitePebbles, ground: Surface) -> PebbleField:
        """Copy pebbles to the device."""
        p, q = pebbles, pebbles.exponent
        octaves = max(math.ceil(math.log2(p.largest_m / p.smallest_m) - 1e-9), 1)
        # mean square of the diameters of an octave relative to the largest, from their density q D**-(q+1) / (2**q - 1)
        excess = q - 2.0
        mean_square = (q * math.log(2.0) if excess == 0.0 else q * (2.0**excess - 1.0) / excess) / (2.0**q - 1.0)
        cell_coverage = 0.25 * math.pi * mean_square * _MEAN_AXIS_RATIO / CELL_DIAMETERS**2
        # the coverage of successive octaves, largest pebbles first, increases by 2**excess
        probability = p.coverage / cell_coverage / sum(2.0 ** (excess * octave) for octave in range(octaves))
        numbers = (probability, 2.0**q - 1.0, 2.0**excess, -1.0 / q, cell_coverage)
        roughness = float(ground.factors[..., ROUGHNESS].mean(dtype=np.float64))
        properties = (p.height_ratio, p.log_albedo, p.log_albedo_sd, *ground.log_albedo_moments, roughness)
        return cls(Float64(p.largest_m), UInt32(octaves), *map(Float, numbers), *map(Float, properties))

    def density_at(self, albedo: Values, roughness: Values) -> Values:
        """Density of pebbles divided by the mean density: log-normal on ground of an albedo, with the mean 1.

        It is in proportion to the roughness of the surface unit, relative to the mean roughness of the terrain.
        """
        deviation = (dr.log(larger(albedo, 1e-6)) - self.ground_mean) / larger(self.ground_sd, 1e-6)
        deviation = dr.select(self.ground_sd > 1e-6, deviation, -0.5 * PATCHINESS)
        density = dr.exp(-PATCHINESS * (deviation + 0.5 * PATCHINESS)) * roughness / self.roughness
        return smaller(density, MAX_DENSITY)


@dataclass(eq=False)
class PebbleSurface:
    """The pebbles that a pixel sees: normal relative to level ground, log albedo, covered and shaded fractions, loss.

    `loss` is the mean fraction of direct sunlight that the visible pebbles and their shadows take from the ground.
    The normal, not of unit length, and the log albedo are means over the pixel: those of ground without pebbles are
    (0, 0, 1) and 0.
    """

    normal: Values
    log_albedo: Values
    covered: Values
    shadow: Values
    loss: Values

    @classmethod
    def bare(cls) -> PebbleSurface:
        """Ground without pebbles."""
        return cls(Array3f(0.0, 0.0, 1.0), Float(0.0), Float(0.0), Float(0.0), Float(0.0))


def _uniform(h: Values, shift: int) -> Values:
    """Convert eight bits of a hash to a number between 0 and 1."""
    return (Float((h >> shift) & 255) + 0.5) * (1.0 / 256.0)


def _rotate(x: Values, y: Values, cosine: Values, sine: Values) -> tuple[Values, Values]:
    """Components of a vector along axes that are turned counter-clockwise."""
    return x * cosine + y * sine, y * cosine - x * sine


def _evaluate_cell(
    pebbles: PebbleField,
    probability: Values,
    octave: Values,
    diameter: Values,
    cell: list[Values],
    offset: list[Values],
    footprint: Values,
    sun: Values,
) -> PebbleSurface:
    """Evaluate the pebble of one cell, without loss.

    - probability: probability that the cell contains a pebble
    - diameter: largest diameter of the octave, metres
    - cell: column and row of the cell
    - offset: position relative to the cell's corner, metres
    """
    first = hash_cell(cell, octave)
    second, third = (mix_bits(first + UInt32(added)) for added in (_SECOND_HASH, _THIRD_HASH))
    # the pebble's rank among those of its octave, by diameter: where the density changes, pebbles grow or shrink
    rank = (Float(first >> 8) + 0.5) * 2.0**-24 / probability
    size = diameter * dr.power(1.0 + rank * pebbles.ratio, pebbles.root)
    # offset from the centre in radii, along the axes of the outline
    axis_y, axis_x = dr.sincos(2.0 * math.pi * _uniform(second, 16))
    stretch = 1.0 / (_MIN_AXIS_RATIO + (1.0 - _MIN_AXIS_RATIO) * _uniform(second, 24))
    centre = [CELL_DIAMETERS * diameter * _uniform(second, shift) for shift in (0, 8)]
    x, y = (2.0 * (position - middle) / size for position, middle in zip(offset, centre, strict=True))
    x, y = _rotate(x, y, axis_x, axis_y)
    x *= stretch
    squared = x * x + y * y
    # outline r**2 + c r**3 cos(3 angle) = 1, with three corners
    corners = _CORNERS * _uniform(third, 24)
    outline = squared + corners * x * (x * x - 3.0 * y * y) / (0.5 + 0.5 * squared)
    # the mean over a pixel is a ramp across the outline, divided by 1 + edge**2 / 12 to preserve the outline's area
    edge = larger(2.0 * footprint / size, 1e-3)
    visible = dr.select(rank < 1.0, 1.0 / (1.0 + edge * edge * (1.0 / 12.0)), 0.0)
    covered = visible * clip((1.0 - dr.sqrt(larger(outline, 0.0))) / edge + 0.5, 0.0, 1.0)
    # half spheroid, tilted: its normal is in proportion to (x / r, y / r, z / h**2)
    height = 2.0 * pebbles.height_ratio * (1.0 - _HEIGHT_SPREAD + 2.0 * _HEIGHT_SPREAD * _uniform(third, 8))
    upwards = dr.sqrt(larger(1.0 - outline, _MIN_UPWARDS))
    tilt_x, tilt_y = (2.0 * _uniform(bits, shift) - 1.0 for bits, shift in ((first, 0), (third, 16)))
    # mean over the covered part of the footprint (fitted, see the test)
    slope = height / (1.0 + 0.25 * edge * edge)
    normal_x, normal_y = ((component + _TILT * tilt) * slope for component, tilt in ((x, tilt_x), (y, tilt_y)))
    normal = dr.normalize(Array3f(*_rotate(normal_x, normal_y, axis_x, -axis_y), upwards))
    log_albedo = pebbles.log_albedo + pebbles.log_albedo_sd * _UNIFORM_WIDTH * (_uniform(third, 0) - 0.5)
    # nearest distance of the ray to the sun from the axis of the spheroid, in units in which it is a sphere
    sun_x, sun_y = _rotate(sun.x, sun.y, axis_x, axis_y)
    horizontal = dr.sqrt(sun_x * sun_x + sun_y * sun_y)
    sun_x *= stretch
    # a low sun is raised, so that the shadow is not longer than `_MAX_SHADOW` diameters
    sun_z = larger(sun.z / height, horizontal * (0.5 / _MAX_SHADOW))
    along = (x * sun_x + y * sun_y) / (sun_x * sun_x + sun_y * sun_y + sun_z * sun_z)
    miss = dr.sqrt(larger(squared - along * (x * sun_x + y * sun_y), 0.0))
    shadow = dr.select(along < 0.0, visible * clip((1.0 - miss) / edge + 0.5, 0.0, 1.0), 0.0) * (1.0 - covered)
    return PebbleSurface(normal, log_albedo, covered, shadow, Float(0.0))


def pebble_surface(
    pebbles: PebbleField, position: Values, footprint: Values, sun: Values, density: Values
) -> PebbleSurface:
    """Compute the pebbles at positions on the ground.

    - footprint: of the pixels, metres
    - sun: unit vector to the sun
    - density: number of pebbles divided by its mean (`PebbleField.density_at`)
    """
    limit = Float64(_MIN_FOOTPRINTS * footprint)
    horizontal = larger(dr.sqrt(sun.x * sun.x + sun.y * sun.y), 1e-6)
    # length of a shadow in diameters; the mean squared extent of an outline along the sun's azimuth is the product of
    # its half axes
    length = smaller(pebbles.height_ratio * horizontal / larger(sun.z, 1e-6), _MAX_SHADOW)
    lost = SIDE_LOSS + 0.5 * (dr.sqrt(1.0 + 4.0 / _MEAN_AXIS_RATIO * length * length) - 1.0)
    # middle between pebble and shadow, in diameters towards the sun
    middle_x, middle_y = (0.5 * length / horizontal * component for component in (sun.x, sun.y))

    def add_octave(
        octave: Values, diameter: Values, probability: Values, total: PebbleSurface
    ) -> tuple[Values, Values, Values, PebbleSurface]:
        width, size = CELL_DIAMETERS * diameter, Float(diameter)
        sine, cosine = dr.sincos(Float64(octave) * _TURN)
        sin, cos = Float(sine), Float(cosine)
        light = Array3f(*_rotate(sun.x, sun.y, cos, sin), sun.z)
        columns, offsets = [], []
        turned, shifts = _rotate(position.x, position.y, cosine, sine), _rotate(middle_x, middle_y, cos, sin)
        for coordinate, shift in zip(turned, shifts, strict=True):
            floor = dr.floor((coordinate + Float64(shift) * diameter) / width - 0.5)
            columns.append(Int32(floor))
            offsets.append(Float(coordinate - floor * width))
        # an octave vanishes where its largest pebbles are smaller than the limit
        ratio = smaller(_MIN_FOOTPRINTS * footprint / size, 1.0)
        fade = (1.0 - ratio * ratio) * (1.0 - ratio * ratio)
        local = smaller(probability * density, 1.0)
        shadow, covered, normal, log_albedo = Float(0.0), total.covered, total.normal, total.log_albedo
        for j, i in product((0, 1), repeat=2):
            cell = [columns[0] + i, columns[1] + j]
            offset = [offsets[0] - i * CELL_DIAMETERS * size, offsets[1] - j * CELL_DIAMETERS * size]
            surface = _evaluate_cell(pebbles, local, octave, size, cell, offset, footprint, light)
            shadow = larger(shadow, surface.shadow)
            # large pebbles hide small ones
            weight = fade * surface.covered * (1.0 - covered)
            x, y, z = surface.normal
            normal = dr.lerp(normal, Array3f(*_rotate(x, y, cos, -sin), z), weight)
            log_albedo = dr.lerp(log_albedo, surface.log_albedo, weight)
            covered = covered + weight
        shaded = dr.lerp(total.shadow, 1.0, fade * shadow * (1.0 - total.covered))
        loss = total.loss + fade * lost * pebbles.cell_coverage * local
        total = PebbleSurface(normal, log_albedo, covered, shaded, loss)
        return octave + 1, 0.5 * diameter, probability * pebbles.growth, total

    state = (UInt32(0), Float64(pebbles.largest), Float(pebbles.probability), PebbleSurface.bare())
    return dr.while_loop(
        state, lambda octave, diameter, probability, total: (octave < pebbles.octaves) & (diameter > limit), add_octave
    )[3]
