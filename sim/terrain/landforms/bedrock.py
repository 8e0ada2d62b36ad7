"""Bedrock: level layers that end in scarps, and patches of polygonal slabs between joints with sand in the gaps."""

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.ground import TerrainGround, resample
from marsyard.sim.terrain.landforms.kernels.bedrock import LOG_ALBEDO, Slabs, add_slabs, expose_strata
from marsyard.sim.terrain.landforms.random_fields import draw_smooth_fields

_ROWS_PER_STRATUM = 32  #: Rows of the table of a stratum of mean thickness.
#: Sizes of the slabs of the two generations of joints, relative to the parameter, and their relative heights (assumed).
_SIZES, _HEIGHTS = (1.0, 0.37), (1.0, 0.4)
#: Range of a slab's height around the mean, and depth of joints, in heights of the slabs; rise of the bedrock from its
#: boundary into a patch, in heights per standard deviation of the field (assumed).
_HEIGHT_RANGE, _JOINT_DEPTH, _RISE = 0.6, 1.3, 4.0
#: Amplitude of undulations of the sand in heights of the slabs, and their length in sizes of the slabs; displacement of
#: the joints, and length of their bends, in sizes; height above the sand over which dust covers a slab, in heights;
#: fraction of the large slabs that the second generation divides (assumed).
_SAND_HEIGHT, _SAND_LENGTH, _DISPLACEMENT, _BEND_LENGTH, _DUSTY_EDGE, _FRACTURED = 0.5, 2.5, 0.15, 0.6, 0.35, 0.6
#: Mean logarithm of the albedo of sand between slabs, divided by that of other ground (calibrated: see `Outcrop`).
_SAND_TONE = -0.2


class Strata(Parameters):
    """Level layers of different brightness, which end in scarps where the ground cuts them.

    A stratum has a gently sloping tread and a steep scarp: the fraction `scarp_height` of its thickness is compressed
    to the fraction `scarp_width` of its outcrop. Thicknesses have a gamma distribution with the shape 3 (assumed).
    """

    thickness_m: Annotated[Positive, Field(description="mean thickness, m")] = 15.0
    log_albedo_rms: Annotated[Fraction, Field(description="RMS of the strata's log albedo")] = 0.08
    scarp_height: Annotated[Fraction, Field(description="fraction of the thickness that is in the scarp")] = 0.6
    scarp_width: Annotated[float, Field(gt=0.0, le=1.0, description="fraction of the outcrop that is the scarp")] = 0.2
    scarp_log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of scarps / of their strata)")] = 0.0

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Replace the heights by those of treads and scarps, and add the albedo of the strata."""
        lowest, highest = float(ground.height.min()), float(ground.height.max())
        count = int(2.0 * (highest - lowest) / self.thickness_m) + 8
        thickness = self.thickness_m * rng.gamma(3.0, 1.0 / 3.0, count)
        base = lowest - rng.uniform(0.0, thickness[0]) + np.concatenate([[0.0], np.cumsum(thickness)])
        log_albedo = self.log_albedo_rms * rng.standard_normal(count)
        rows = int((highest - lowest) / self.thickness_m * _ROWS_PER_STRATUM) + 2
        height = np.linspace(lowest, highest, rows)
        stratum = np.clip(np.searchsorted(base, height, side="right") - 1, 0, count - 1)
        fraction = (height - base[stratum]) / thickness[stratum]
        # the scarp is the lower end of a stratum's outcrop
        knots = [0.0, self.scarp_width, 1.0]
        exposed = base[stratum] + thickness[stratum] * np.interp(fraction, knots, [0.0, self.scarp_height, 1.0])
        scarp = self.scarp_log_albedo * (fraction < self.scarp_width)
        table = np.column_stack([exposed, log_albedo[stratum] + scarp])
        step = (highest - lowest) / (rows - 1) if highest > lowest else 1.0
        expose_strata(ground.height, ground.log_albedo, lowest, step, table)


class Outcrop(Parameters):
    """Patches of bedrock, divided by joints into domed polygonal slabs, partly below sand.

    The bedrock is above the sand inside the level set of a smooth random field, and dips below it at the boundary.
    Slabs are cells of a Voronoi diagram with curved borders. Each has its own height, tilt and albedo. A second, finer
    generation of joints divides most of them. Joints differ in width and depth, and have a level floor of sand. At the
    boundary they are wide, and all slabs are divided: fragments lie apart. Undulations of sand cover low slabs. The
    brightness of slabs and sand, and the width of joints are calibrated to the last images of Mars 2020's landing
    camera.
    """

    fraction: Annotated[Fraction, Field(description="fraction of the ground in patches of bedrock")] = 0.3
    patch_m: Annotated[Positive, Field(description="correlation length of the patches, m")] = 15.0
    slab_m: Annotated[Positive, Field(description="mean width of the large slabs, m")] = 0.8
    height_m: Annotated[NonNegative, Field(description="mean height of the large slabs above the sand, m")] = 0.05
    tilt_deg: Annotated[float, bounded_field(0.0, 30.0, "RMS tilt of the slabs along one axis, deg")] = 4.0
    joint_m: Annotated[Positive, Field(description="mean half width of the sand-filled joints between slabs, m")] = 0.04
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "mean logarithm of albedo divided by the sand's")] = 0.2
    log_albedo_sd: Annotated[float, bounded_field(0.0, 1.0, "standard deviation of this logarithm")] = 0.1
    sand_log_albedo_sd: Annotated[
        float, bounded_field(0.0, 1.0, "the same of the sand between slabs, which varies from patch to patch")
    ] = 0.08

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the slabs of both generations."""
        layer = ground.coarser(0.5 * self.joint_m)
        patches = draw_smooth_fields(ground.period_m, self.patch_m, self.patch_m, 0.0, rng)
        sand_m, bend_m = _SAND_LENGTH * self.slab_m, _BEND_LENGTH * self.slab_m
        sand = draw_smooth_fields(ground.period_m, sand_m, sand_m, 0.0, rng)[..., 0]
        bends = _DISPLACEMENT * self.slab_m * draw_smooth_fields(ground.period_m, bend_m, bend_m, 0.0, rng)
        rows = min(len(bends), layer.side)
        patch, tone, sand, bend_x, bend_y = (
            resample(np.ascontiguousarray(field), rows)
            for field in (*np.moveaxis(patches, -1, 0), sand, *np.moveaxis(bends, -1, 0))
        )
        # the components of a smooth field have the variance 1/2
        depth = np.sqrt(2.0) * _RISE * (patch - np.quantile(patch, 1.0 - self.fraction))
        bedrock = self.height_m * (np.minimum(depth, 1.0) - np.sqrt(2.0) * _SAND_HEIGHT * sand)
        sand_tone = _SAND_TONE + np.sqrt(2.0) * self.sand_log_albedo_sd * tone
        generations = [
            self._draw_slabs(ground.period_m, size, height, rng) for size, height in zip(_SIZES, _HEIGHTS, strict=True)
        ]
        generations[0].slabs[..., LOG_ALBEDO] += self.log_albedo
        fields = np.stack([bedrock, sand_tone, bend_x, bend_y], axis=-1).astype(np.float32)
        edge = max(_DUSTY_EDGE * self.height_m, 1e-6)
        add_slabs(layer.height, layer.log_albedo, layer.spacing_m, fields, *generations, _FRACTURED, edge)
        ground.add(layer)

    def _draw_slabs(self, period_m: float, size: float, height: float, rng: Generator) -> Slabs:
        """Draw the slabs of a generation with this size and height relative to the parameters."""
        # a Voronoi cell needs neighbours on all sides
        cells = max(round(period_m / (size * self.slab_m)), 3)
        rise = _HEIGHT_RANGE * height * self.height_m
        slabs = np.stack(
            [
                rise * rng.uniform(-1.0, 1.0, (cells, cells)),
                *(height * np.tan(np.radians(self.tilt_deg)) * rng.standard_normal((2, cells, cells))),
                height * self.log_albedo_sd * rng.standard_normal((cells, cells)),
                rng.random((cells, cells)),
            ],
            axis=-1,
        )
        joint, depth = size * self.joint_m, _JOINT_DEPTH * height * self.height_m
        positions = locate_points(rng.uniform(0.02, 0.98, (cells, cells, 2)))
        return Slabs(
            positions, np.pad(slabs, ((1, 1), (1, 1), (0, 0)), mode="wrap"), period_m / cells, joint, depth, rise
        )


def locate_points(points: Float64[np.ndarray, "count count 2"]) -> Float64[np.ndarray, "margin margin 2"]:
    """Return the positions of the points of a periodic grid in units of its squares, with a margin of one square.

    `points` contains the position of each point within its square, from 0 to 1; rows are along y.
    """
    squares = np.arange(-1.0, len(points) + 1.0)
    corners = np.stack(np.meshgrid(squares, squares), axis=-1)
    return np.asarray(np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="wrap") + corners)
