"""The surface of rocks, finer than their triangles: grain, bedding, fractures, and the margin of the dust on them.

Grain and fractures follow the frame and the size of each rock. They change shading and albedo, but not the geometry.
"""

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray
from jaxtyping import Int64

from marsyard.sim.render.arrays import Values, clip, larger
from marsyard.sim.render.device import Array3f, Array3f64, Float, Float64, UInt32
from marsyard.sim.render.noise import noise_in_space
from marsyard.sim.render.texture import MIN_SLOPE_CELLS, SLOPE_FADING, fade_octave
from marsyard.sim.terrain.sites import ROCK_TEXTURE_M

#: Cells of the coarsest octave of the grain and of the albedo texture as fractions of a rock's size, and number of
#: octaves of the grain; slope of each octave of the grain, for a noise of one unit per cell (assumed).
GRAIN_CELL, TEXTURE_CELL, OCTAVES, GRAIN_SLOPE = 0.2, 0.3, 6, 0.12
#: Fraction of bedded rocks, and maximum ratio of the length of their grain along the beds to that across (assumed).
BEDDED_FRACTION, MAX_BED_RATIO = 0.5, 3.5
#: Cells of the network of fractures as a fraction of a rock's size, half width of a fracture in cells, and logarithm of
#: the albedo of its middle (assumed).
FRACTURE_CELL, FRACTURE_WIDTH, FRACTURE_LOG_ALBEDO = 0.6, 0.016, -0.4
#: Cells of the noise in the margin of the dust as a fraction of a rock's size, and its effect on the vertical component
#: of the normal (assumed): dust reaches further down in some directions.
MARGIN_CELL, MARGIN = 0.25, 0.5
#: Angles between a rock's face and the horizontal, radians, up to which dust stays on it (about the angle of repose),
#: and from which it is bare: a thin, cohesive film stays on steep faces (the first assumed, the second fitted to the
#: darkest parts of mast images).
MAX_DUSTY_TILT, MIN_BARE_TILT = math.radians(30.0), math.radians(115.0)
#: Finer fractures: cells and depth as fractions of those of the network (assumed).
_FINE_FRACTURE = 0.3
#: Seeds of the noise of fractures, finer fractures and dust margin; those of the grain are the numbers of its octaves.
_FRACTURE_SEED, _FINE_FRACTURE_SEED, _MARGIN_SEED = 7, 8, 11
#: Step of the finite differences of the grain, in cells; minimum size of a rock, metres.
_STEP_CELLS, _MIN_SIZE_M = 0.1, 1e-3
#: Texture of users' meshes as a fraction of that of rocks: slight wear (assumed).
WEAR = 0.15
#: A rover has wrinkled fabric, dents, seams and dust: the grain of a rock of this size, metres, and this fraction of a
#: rock's dust (assumed).
WRINKLED_M, ROVER_DUST = 0.25, 0.4


def describe_grain(
    names: Int64[np.ndarray, "bodies"], sizes_m: FloatArray[np.ndarray, "bodies"]
) -> FloatArray[np.ndarray, "bodies 4"]:
    """Choose the grain of each rock by its name: bedding vector x, y, z, and size, metres.

    The square of the vector's length is the ratio of the lengths along and across the beds minus 1. The numbers are a
    low-discrepancy sequence (Roberts 2018: powers of the real root of x**4 = x + 1).
    """
    u, v, w = (np.mod(names * 1.2207440846**-power, 1.0) for power in (1.0, 2.0, 3.0))
    ratio = 1.0 + (MAX_BED_RATIO - 1.0) * np.maximum(w - 1.0 + BEDDED_FRACTION, 0.0) / BEDDED_FRACTION
    # beds are nearer to the horizontal than to the vertical
    z, azimuth = 0.5 + 0.5 * u, 2.0 * np.pi * v
    level = np.sqrt(1.0 - z * z)
    axis = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), z], axis=1)
    return np.column_stack([np.sqrt(ratio - 1.0)[:, None] * axis, sizes_m])


@dataclass(eq=False)
class RockSurface:
    """Slopes of the grain as a vector, logarithm of the relative albedo of fractures, and dust on a face, 0 to 1."""

    slope: Values
    log_albedo: Values
    dust: Values


def dust_cover(normal_z: Values) -> Values:
    """Fraction of the dust on level faces that stays on a face: all below `MAX_DUSTY_TILT`, none above `MIN_BARE_TILT`.

    Between them it is linear in the vertical component of the unit normal.
    """
    bare, dusty = math.cos(MIN_BARE_TILT), math.cos(MAX_DUSTY_TILT)
    return clip((normal_z - bare) / (dusty - bare), 0.0, 1.0)


def texture_frame(grain: Values, position: Values, footprint: Values) -> tuple[Values, Values]:
    """Positions and footprints for the albedo texture, scaled to the size of the rock and stretched along its beds.

    `grain` is that of `describe_grain`, with the size as w.
    """
    scale = ROCK_TEXTURE_M / (TEXTURE_CELL * larger(grain.w, _MIN_SIZE_M))
    return _stretch(grain, position) * Float64(scale), footprint * scale


def _stretch(grain: Values, vector: Values) -> Values:
    """Stretch a vector across the beds."""
    bedding = type(vector)(grain.x, grain.y, grain.z)
    return vector + dr.dot(bedding, vector) * bedding


def rock_surface(grain: Values, position: Values, normal: Values, footprint: Values) -> RockSurface:
    """Compute the surface of rocks at positions with these normals and footprints; `grain`: see `texture_frame`."""
    size = larger(grain.w, _MIN_SIZE_M)
    stretched = _stretch(grain, position)
    first_cell = Float64(GRAIN_CELL * size)
    min_cell = Float64(MIN_SLOPE_CELLS * footprint)

    def add_octave(octave: Values, cell: Values, total: Values) -> tuple[Values, Values, Values]:
        gain = GRAIN_SLOPE * fade_octave(footprint, cell, SLOPE_FADING)
        # the position itself, and a step along each axis
        steps = [(0.0, 0.0, 0.0), (_STEP_CELLS, 0.0, 0.0), (0.0, _STEP_CELLS, 0.0), (0.0, 0.0, _STEP_CELLS)]
        here, *ahead = (noise_in_space(list(stretched + Array3f64(*step) * cell), cell, octave) for step in steps)
        return octave + 1, 0.5 * cell, total + gain / _STEP_CELLS * Array3f(*(value - here for value in ahead))

    _, _, slope = dr.while_loop(
        (UInt32(0), first_cell, Array3f(0.0)),
        lambda octave, cell, total: (octave < OCTAVES) & (cell > min_cell),
        add_octave,
    )
    # across the beds the slope is that of a rock without beds
    slope = _stretch(grain, slope) / (1.0 + grain.x**2 + grain.y**2 + grain.z**2)
    cell = Float64(FRACTURE_CELL * size)
    depth = noise_in_space(list(stretched), cell, UInt32(_FRACTURE_SEED)) + _FINE_FRACTURE * noise_in_space(
        list(stretched), _FINE_FRACTURE * cell, UInt32(_FINE_FRACTURE_SEED)
    )
    width = larger(FRACTURE_WIDTH, footprint / Float(cell))
    fractures = FRACTURE_LOG_ALBEDO * FRACTURE_WIDTH / width * dr.exp(-dr.square(depth / width))
    margin = MARGIN * noise_in_space(list(position), Float64(MARGIN_CELL * size), UInt32(_MARGIN_SEED))
    return RockSurface(slope, fractures, dust_cover(normal.z + margin))
