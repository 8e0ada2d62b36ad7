"""Files of real terrain: a terrain model and an optional picture of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from marsyard.sim.parameters import Parameters


class TerrainFileError(ValueError):
    """A terrain file cannot be used; the message says which, why, and what is allowed."""


class RealTerrain(Parameters):
    """A digital terrain model (DTM) from a file, in place of the fractal ground where it reaches.

    The file is a GeoTIFF (rows from north to south, projected, metres; needs the extra `geo`) or an ``.npz`` with
    ``dem`` (heights, m, row 0 in the north) and ``dem_gsd`` (m), and optionally ``ortho``, ``ortho_gsd`` and
    ``ortho_valid``. Its middle lies at the middle of the periodic terrain, whose y axis is the grid's north: azimuths,
    the sun's too, count from there, which is not true north off a projection's central meridian.

    Posts without height are filled smoothly, up to `max_hole_fraction` of them; ground that is filled is not real.
    """

    dtm: Annotated[Path, Field(description="GeoTIFF or .npz with the heights")]
    ortho: Annotated[Path | None, Field(description="GeoTIFF with the picture; an .npz has its own")] = None
    use_ortho: Annotated[bool, Field(description="whether brightness is taken from the picture")] = True
    ortho_east_m: Annotated[
        float, Field(description="how far east of the DTM the picture lies, m; it is moved back")
    ] = 0.0
    ortho_north_m: Annotated[float, Field(description="how far north of the DTM the picture lies, m")] = 0.0
    border_m: Annotated[
        float, Field(gt=0.0, description="width of the seam within the DTM over which it blends into its surround, m")
    ] = 20.0
    max_hole_fraction: Annotated[
        float,
        Field(ge=0.0, lt=1.0, description="fraction of the DTM's posts without height above which it is refused"),
    ] = 0.05
    roughen: Annotated[
        bool, Field(description="add the fractal ground's detail finer than twice the DTM's posting")
    ] = True

    def input_files(self) -> tuple[str, ...]:
        """Paths of the files that the terrain is made from."""
        return tuple(str(path) for path in (self.dtm, self.ortho) if path is not None)


@dataclass(frozen=True)
class Raster:
    """A grid of values, row 0 in the south, NaN where there is none.

    Attributes
    ----------
    values
        Shape (rows, columns).
    posting_m
        Distance between values.
    west_m, south_m
        Place of value (0, 0), the centre of its cell, in the file's own coordinates.
    """

    values: Float64[np.ndarray, "rows columns"]
    posting_m: float
    west_m: float
    south_m: float


def read_rasters(source: RealTerrain) -> tuple[Raster, Raster | None]:
    """Heights, and brightness where there is a picture that is wanted. Raises TerrainFileError."""
    if not source.dtm.exists():
        raise TerrainFileError(f"terrain file {source.dtm} does not exist")
    if source.dtm.suffix == ".npz":
        heights, ortho = _read_npz(source.dtm)
    else:
        heights, ortho = _read_geotiff(source.dtm), None
    if source.ortho is not None:
        if not source.ortho.exists():
            raise TerrainFileError(f"ortho image {source.ortho} does not exist")
        ortho = _read_geotiff(source.ortho)
    check_holes(source, heights.values)
    return heights, ortho if source.use_ortho else None


def check_holes(source: RealTerrain, heights: Float64[np.ndarray, "rows columns"]) -> None:
    """Raises TerrainFileError where more heights are missing (not finite) than the source allows."""
    fraction = float(np.mean(~np.isfinite(heights)))
    if fraction == 1.0:
        raise TerrainFileError(f"{source.dtm}: has no valid height at all")
    if fraction > source.max_hole_fraction:
        raise TerrainFileError(
            f"{source.dtm}: {fraction:.1%} of its posts have no height; allowed: up to {source.max_hole_fraction:.1%}. "
            "Cut out a part without holes (rio clip --bounds), or allow them to be filled smoothly by "
            "max_hole_fraction (marsyard terrain stats and render: --max-holes)"
        )


def _read_npz(path: Path) -> tuple[Raster, Raster | None]:
    with np.load(path, allow_pickle=False) as file:
        missing = [key for key in ("dem", "dem_gsd") if key not in file]
        if missing:
            raise TerrainFileError(
                f"{path} lacks {', '.join(missing)}; allowed: dem, dem_gsd, ortho, ortho_gsd, ortho_valid"
            )
        heights = _from_north(file["dem"], float(file["dem_gsd"]), path)
        if "ortho" not in file:
            return heights, None
        brightness = np.asarray(file["ortho"], dtype=np.float64)
        if "ortho_valid" in file:
            brightness = np.where(file["ortho_valid"], brightness, np.nan)
        return heights, _from_north(brightness, float(file["ortho_gsd"]), path)


def _from_north(values: Any, posting_m: float, path: Path) -> Raster:
    """A raster whose upper left corner, not the centre of its first cell, is the origin."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or min(array.shape) < 4:
        raise TerrainFileError(f"{path} has a grid of shape {array.shape}; at least 4 x 4 values are needed")
    array = np.where(np.isfinite(array), array, np.nan)
    return Raster(array[::-1].copy(), posting_m, 0.5 * posting_m, (0.5 - array.shape[0]) * posting_m)


def _read_geotiff(path: Path) -> Raster:
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(
            f"{path}: reading GeoTIFF needs rasterio, which is not installed: pip install rasterio (extra 'geo')"
        ) from error
    with rasterio.open(path) as file:
        values = file.read(1, masked=True).astype(np.float64).filled(np.nan)
        transform, crs = file.transform, file.crs
    if crs is not None and crs.is_geographic:
        raise TerrainFileError(f"{path} is in degrees ({crs}); project it to metres first, with rio warp --dst-crs")
    if transform.b or transform.d or abs(transform.a + transform.e) > 1e-6 * abs(transform.a):
        raise TerrainFileError(f"{path} has rotated or oblong cells; square cells, north up, are needed")
    factor = 1.0 if crs is None else float(crs.linear_units_factor[1])
    posting = float(transform.a) * factor
    raster = _from_north(values, posting, path)
    return Raster(raster.values, posting, transform.c * factor + raster.west_m, transform.f * factor + raster.south_m)


def filled(values: Float64[np.ndarray, "rows columns"]) -> tuple[Float64[np.ndarray, "rows columns"], int]:
    """Values with each hole filled smoothly from its rim, and the number of values that were missing.

    Every missing value starts as its nearest valid one; then the holes are relaxed towards a membrane (Laplace).
    """
    missing: Bool[np.ndarray, "rows columns"] = np.isnan(values)
    holes = int(missing.sum())
    if holes == 0:
        return values, 0
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    whole = values[tuple(nearest)]
    for _ in range(200):
        padded = np.pad(whole, 1, mode="edge")
        around = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
        whole[missing] = around[missing]
    return whole, holes
