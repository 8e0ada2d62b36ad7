"""Outcrops of bedrock: polygonal slabs between joints, with sand in the gaps, as at Meridiani and in Jezero."""

from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.ground import TerrainGround, draw_smooth_fields, resample
from marsyard.sim.terrain.landforms.kernels.bedrock import add_slabs

#: Sizes of the slabs of the two generations of joints, relative to the parameter, and their relative heights (assumed).
_SIZES, _HEIGHTS = (1.0, 0.4), (1.0, 0.35)


class Outcrop(Parameters):
    """Patches of bedrock, divided by joints into polygonal slabs.

    A slab is a cell of a Voronoi diagram whose point lies in a patch: the level set of a smooth random field. It has
    its own height, tilt and albedo. Slabs of a second, finer generation lie on the patches too.
    """

    fraction: Annotated[Fraction, Field(description="fraction of the ground in patches of bedrock")] = 0.3
    patch_m: Annotated[Positive, Field(description="correlation length of the patches, m")] = 15.0
    slab_m: Annotated[Positive, Field(description="mean width of the large slabs, m")] = 0.8
    height_m: Annotated[NonNegative, Field(description="mean height of the large slabs above the sand, m")] = 0.05
    tilt_deg: Annotated[float, bounded_field(0.0, 30.0, "RMS tilt of the slabs along one axis, deg")] = 4.0
    joint_m: Annotated[Positive, Field(description="half width of the sand-filled joints between slabs, m")] = 0.06
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "mean logarithm of albedo divided by the sand's")] = 0.2
    log_albedo_sd: Annotated[float, bounded_field(0.0, 1.0, "standard deviation of this logarithm")] = 0.1

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the slabs of both generations."""
        field = draw_smooth_fields(ground.period_m, self.patch_m, self.patch_m, 0.0, rng)[..., 0]
        layer = ground.coarser(0.5 * self.joint_m)
        patches = resample(np.ascontiguousarray(field), layer.side)
        threshold = np.quantile(patches, 1.0 - self.fraction)
        for size, height in zip(_SIZES, _HEIGHTS, strict=True):
            cells = max(round(ground.period_m / (size * self.slab_m)), 3)
            points = rng.uniform(0.05, 0.95, (cells, cells, 2))
            corner = np.arange(cells)
            columns, rows = (
                ((points[..., axis] + offset) * layer.side / cells).astype(int) % layer.side
                for axis, offset in ((0, corner[None, :]), (1, corner[:, None]))
            )
            exists = patches[rows, columns] > threshold
            slabs = np.stack(
                [
                    height * self.height_m * rng.uniform(0.3, 1.7, exists.shape) * exists,
                    *(np.tan(np.radians(self.tilt_deg)) * rng.standard_normal((2, *exists.shape)) * exists),
                    (self.log_albedo * height + self.log_albedo_sd * rng.standard_normal(exists.shape)) * exists,
                ],
                axis=-1,
            )
            joint = max(size * self.joint_m, layer.spacing_m)
            add_slabs(layer.height, layer.log_albedo, layer.spacing_m, points, slabs, ground.period_m / cells, joint)
        ground.add(layer)
