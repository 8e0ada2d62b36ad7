"""Read digital terrain models (DTM) and orthoimages from files: heights and brightness on grids, missing values NaN."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field

from marsyard.sim.files import report_damage
from marsyard.sim.parameters import Parameters

Grid = Float64[np.ndarray, "rows columns"]
Coordinates = Float64[np.ndarray, "n"]
Mask = Bool[np.ndarray, "rows columns"]
#: Luminance weights of red, green and blue (ITU-R BT.601), as in OpenCV and Pillow.
LUMINANCE = {"red": 0.299, "green": 0.587, "blue": 0.114}
#: Maximum error of a position after a full turn of longitude, deg.
_MAX_TURN_ERROR_DEG = 1e-6


class TerrainFileError(ValueError):
    """A terrain file cannot be used; the message contains the file, the reason and the allowed values."""


class RealTerrain(Parameters):
    """A digital terrain model (DTM) from a file; it replaces the synthetic ground inside its borders.

    The file is a GeoTIFF (rows from north to south, projected, metres; needs the extra `geo`) or an ``.npz`` with
    ``dem`` (heights, m, row 0 in the north) and ``dem_gsd`` (m), and optionally ``ortho``, ``ortho_gsd`` and
    ``ortho_valid``. Its centre is the centre of the periodic terrain. Azimuths, including the sun's, are relative to
    grid north (y axis), which differs from true north away from the projection's central meridian.

    Missing heights are interpolated, up to a fraction `max_hole_fraction`. Filled samples are excluded from statistics.
    The orthoimage must have a brightness at the posts, except for a fraction `max_ortho_hole_fraction`. Missing pixels
    are interpolated; beyond the edges of the image the synthetic albedo remains.
    """

    dtm: Annotated[Path, Field(description="GeoTIFF, PDS3 or ISIS product (.img, .cub), or .npz with the heights")]
    ortho: Annotated[Path | None, Field(description="GeoTIFF with the orthoimage; an .npz can contain it")] = None
    use_ortho: Annotated[bool, Field(description="whether the orthoimage determines the albedo")] = True
    ortho_east_m: Annotated[float, Field(description="eastward offset of the orthoimage from the DTM, m")] = 0.0
    ortho_north_m: Annotated[float, Field(description="northward offset of the orthoimage from the DTM, m")] = 0.0
    border_m: Annotated[float, Field(gt=0.0, description="width of the blending zone inside the DTM, m")] = 20.0
    max_hole_fraction: Annotated[float, Field(ge=0.0, lt=1.0, description="maximum fraction without height")] = 0.05
    max_ortho_hole_fraction: Annotated[
        float, Field(ge=0.0, lt=1.0, description="maximum fraction of posts without brightness in the orthoimage")
    ] = 0.2
    roughen: Annotated[bool, Field(description="add fractal detail finer than twice the DTM's posting")] = True

    def input_files(self) -> tuple[str, ...]:
        """Return the paths of the DTM's files."""
        return tuple(str(path) for path in (self.dtm, self.ortho) if path is not None)


@dataclass(frozen=True)
class Raster:
    """A grid of values, row 0 in the south, NaN where missing.

    - posting_m: distance between the grid points (posts)
    - west_m, south_m: position of post (0, 0)
    """

    values: Grid
    posting_m: float
    west_m: float
    south_m: float


def read_rasters(source: RealTerrain) -> tuple[Raster, Raster | None]:
    """Read heights, and brightness if an orthoimage is used. Raises TerrainFileError."""
    if not source.dtm.exists():
        raise TerrainFileError(f"terrain file {source.dtm} does not exist")
    with report_damage(source.dtm, TerrainFileError, "is damaged"):
        if source.dtm.suffix == ".npz":
            heights, ortho = _read_npz(source.dtm)
        else:
            heights, ortho = _read_geotiff(source.dtm, is_dtm=True)[0], None
    check_holes(source, heights.values)
    if not source.use_ortho:
        return heights, None
    if source.ortho is not None:
        if not source.ortho.exists():
            raise TerrainFileError(f"ortho image {source.ortho} does not exist")
        with report_damage(source.ortho, TerrainFileError, "is damaged"):
            ortho, full_turn_m = _read_geotiff(source.ortho, is_dtm=False)
        if full_turn_m is not None:
            ortho = replace(ortho, west_m=ortho.west_m - full_turn_m * _full_turns(heights, ortho, full_turn_m))
    if ortho is not None:
        _check_coverage(source, heights, ortho)
    return heights, ortho


def _full_turns(heights: Raster, ortho: Raster, full_turn_m: float) -> int:
    """Return the number of full turns of longitude from the DTM's centre to that of its orthoimage."""
    heights_m, ortho_m = (
        raster.west_m + 0.5 * raster.posting_m * raster.values.shape[1] for raster in (heights, ortho)
    )
    return round(float(ortho_m - heights_m) / full_turn_m)


def ortho_origin(source: RealTerrain, heights: Raster, ortho: Raster) -> tuple[float, float]:
    """Return the position of the orthoimage's south-western pixel relative to the DTM's south-western post, m."""
    east_m = ortho.west_m - heights.west_m - source.ortho_east_m
    return east_m, ortho.south_m - heights.south_m - source.ortho_north_m


def brightness_at_posts(source: RealTerrain, heights: Raster, ortho: Raster) -> tuple[Mask, Mask]:
    """Return whether the orthoimage covers each post of the DTM, and whether it has a brightness there.

    A pixel covers its square. Brightness is positive; black is missing.
    """
    pixels = []
    for start, posts, count in zip(
        ortho_origin(source, heights, ortho), heights.values.shape[::-1], ortho.values.shape[::-1], strict=True
    ):
        positions = (heights.posting_m * np.arange(posts) - start) / ortho.posting_m
        # rounding of map coordinates of many kilometres is far below a thousandth of a pixel
        is_covered = np.abs(positions - 0.5 * (count - 1)) <= 0.5 * count + 1e-3
        pixels.append((np.clip(np.rint(positions).astype(np.int64), 0, count - 1), is_covered))
    (columns, covers_column), (rows, covers_row) = pixels
    is_covered = covers_row[:, None] & covers_column[None, :]
    return is_covered, is_covered & (ortho.values[np.ix_(rows, columns)] > 0.0)


def _check_coverage(source: RealTerrain, heights: Raster, ortho: Raster) -> None:
    """Raise TerrainFileError if the orthoimage has no brightness at more posts of the DTM than the source allows."""
    path = source.dtm if source.ortho is None else source.ortho
    is_covered, has_brightness = brightness_at_posts(source, heights, ortho)
    fraction, uncovered = 1.0 - float(has_brightness.mean()), 1.0 - float(is_covered.mean())
    if fraction <= source.max_ortho_hole_fraction:
        return
    (east_m, north_m), (rows, columns) = ortho_origin(source, heights, ortho), ortho.values.shape
    if source.ortho is not None and source.dtm.suffix == ".npz":
        advice = f"{source.dtm} has no map position: store the image in it (ortho, ortho_gsd)"
    else:
        advice = "Clip the DTM to the image (rio clip --like), or set use_ortho = false or max_ortho_hole_fraction"
    raise TerrainFileError(
        f"{path}: the orthoimage has no brightness at {fraction:.1%} of the DTM's posts ({uncovered:.1%} are outside "
        f"the image); allowed: up to {source.max_ortho_hole_fraction:.1%}. The south-western pixel of the image is "
        f"{east_m:.10g} m east and {north_m:.10g} m north of that of the DTM, and the image extends over "
        f"{columns * ortho.posting_m:g} m x {rows * ortho.posting_m:g} m. {advice}"
    )


def check_holes(source: RealTerrain, heights: Grid) -> None:
    """Raise TerrainFileError if more heights are missing (not finite) than the source allows."""
    fraction = float(np.mean(~np.isfinite(heights)))
    if fraction == 1.0:
        raise TerrainFileError(f"{source.dtm}: has no valid height at all")
    if fraction > source.max_hole_fraction:
        raise TerrainFileError(
            f"{source.dtm}: {fraction:.1%} of its posts have no height; allowed: up to {source.max_hole_fraction:.1%}. "
            "Clip the file to a part without holes (rio clip --bounds), or increase max_hole_fraction "
            "(marsyard terrain stats and render: --max-holes) to fill the holes by interpolation"
        )


def _read_npz(path: Path) -> tuple[Raster, Raster | None]:
    with np.load(path, allow_pickle=False) as file:
        missing = [key for key in ("dem", "dem_gsd") if key not in file]
        if missing:
            allowed = "dem, dem_gsd, ortho, ortho_gsd, ortho_valid"
            raise TerrainFileError(f"{path} does not contain {', '.join(missing)}; allowed: {allowed}")
        heights = _create_raster(file["dem"], float(file["dem_gsd"]), path)
        if "ortho" not in file:
            return heights, None
        brightness = np.asarray(file["ortho"], dtype=np.float64)
        if "ortho_valid" in file:
            brightness = np.where(file["ortho_valid"], brightness, np.nan)
        return heights, _create_raster(brightness, float(file["ortho_gsd"]), path)


def _create_raster(values: Any, posting_m: float, path: Path) -> Raster:
    """Create a raster from rows in north-to-south order, with the outer corner of the north-western cell at (0, 0)."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or min(array.shape) < 4:
        raise TerrainFileError(f"{path} has a grid of shape {array.shape}; at least 4 x 4 values are needed")
    if not 0.0 < posting_m < np.inf:
        raise TerrainFileError(f"{path} has a distance of {posting_m:g} m between grid points; it must be positive")
    array = np.where(np.isfinite(array), array, np.nan)
    return Raster(array[::-1].copy(), posting_m, 0.5 * posting_m, (0.5 - array.shape[0]) * posting_m)


def _read_geotiff(path: Path, is_dtm: bool) -> tuple[Raster, float | None]:
    """Read heights or brightness; return also the length of a full turn of longitude along x, if x is a longitude."""
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(
            f"{path}: reading GeoTIFF needs rasterio, which is not installed: pip install rasterio (extra 'geo')"
        ) from error
    with rasterio.open(path) as file:
        values = read_heights(file) if is_dtm else read_brightness(file)
        transform, crs, centre = file.transform, file.crs, file.xy(file.height // 2, file.width // 2)
    if crs is not None and crs.is_geographic:
        raise TerrainFileError(f"{path} is in degrees ({crs}); project it to metres with rio warp --dst-crs")
    if transform.b or transform.d or abs(transform.a + transform.e) > 1e-6 * abs(transform.a):
        raise TerrainFileError(f"{path} has rotated or oblong cells; square cells, north up, are needed")
    factor = 1.0 if crs is None else float(crs.linear_units_factor[1])
    posting = float(transform.a) * factor
    raster = _create_raster(values, posting, path)
    raster = Raster(raster.values, posting, transform.c * factor + raster.west_m, transform.f * factor + raster.south_m)
    turn = None if crs is None or is_dtm else full_turn(crs, *centre)
    return raster, None if turn is None else turn * factor


def read_heights(file: Any) -> Grid:
    """Read the first band, rows from north to south, NaN where masked."""
    return np.asarray(file.read(1, masked=True).astype(np.float64).filled(np.nan))


def brightness_problems(file: Any) -> Iterator[str]:
    """Yield the properties of an orthoimage that `read_brightness` does not support."""
    names = [band.name for band in file.colorinterp]
    if np.dtype(file.dtypes[0]).kind not in "iuf":
        yield f"contains values of type {file.dtypes[0]}; allowed: real numbers"
    colours = [name for name in names if name != "alpha"]
    if len(colours) != 1 and colours != list(LUMINANCE):
        yield (
            f"has {file.count} bands ({', '.join(names)}); allowed: one band, or red, green and blue, with or without "
            "alpha: extract one band with rio stack --bidx"
        )
    for number, scale, offset in zip(file.indexes, file.scales, file.offsets, strict=True):
        if not np.isfinite([scale, offset]).all() or scale == 0.0:
            yield f"band {number} has scale {scale:g} and offset {offset:g}; allowed: finite, and a scale other than 0"


def read_brightness(file: Any) -> Grid:
    """Read an orthoimage's brightness, rows from north to south, NaN where missing.

    Values are scaled with scale and offset of their band (GDAL's unscaling). Indices of a palette are replaced by the
    luminance of their colours, and red, green and blue by their luminance. Masked and transparent pixels are missing.
    In a file of integers without mask, nodata value or alpha, pixels with the lowest integer in all bands are missing:
    0 of unsigned integers, -32768 of 16 bits.
    """
    from rasterio.enums import MaskFlags

    names = [band.name for band in file.colorinterp]
    brightness: Grid = np.zeros(file.shape, dtype=np.float64)
    has_no_mask = file.mask_flag_enums[0] == [MaskFlags.all_valid] and "alpha" not in names
    dtype = np.dtype(file.dtypes[0])
    is_lowest = np.full(file.shape, has_no_mask and dtype.kind in "iu" and names[0] != "palette")
    if names[0] == "palette":
        brightness += _palette_luminance(file.colormap(1))[file.read(1)]
    else:
        is_colour = "red" in names
        grey = next((number for number, name in enumerate(names, start=1) if name != "alpha"), 1)
        for number, name in zip(file.indexes, names, strict=True):
            weight = LUMINANCE.get(name, 0.0) if is_colour else float(number == grey)
            if weight == 0.0:
                continue
            band = file.read(number)
            is_lowest &= band == (np.iinfo(dtype).min if dtype.kind in "iu" else 0)
            brightness += weight * (band * float(file.scales[number - 1]) + float(file.offsets[number - 1]))
    is_missing = (file.dataset_mask() == 0) | is_lowest
    if "alpha" in names:  # the mask of rasterio does not contain the opacity of real numbers
        is_missing |= file.read(names.index("alpha") + 1) == 0
    return np.where(is_missing, np.nan, brightness)


def _palette_luminance(colours: dict[int, tuple[int, int, int, int]]) -> Float64[np.ndarray, "65536"]:
    """Return the luminance of each index; NaN for indices that are transparent or have no colour."""
    table = np.full(1 << 16, np.nan)
    for index, (*colour, alpha) in colours.items():
        table[index] = np.dot(list(LUMINANCE.values()), colour) if alpha > 0 else np.nan
    return table


def full_turn(crs: Any, x: float, y: float) -> float | None:
    """Return the length of 360 deg of longitude along x, in units of the projection, near a position.

    None if the projection is not cylindrical: x + full turn is then another position, or none.
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    try:
        terms = crs.to_dict()
        body = {name: terms[name] for name in ("a", "b", "R", "ellps", "datum", "rf") if name in terms}
        degrees = CRS.from_dict({"proj": "longlat", **body, "no_defs": True})
        (longitude,), (latitude,) = transform(crs, degrees, [x], [y])
        xs, _ = transform(degrees, crs, [longitude + step for step in (-1.0, 0.0, 1.0)], [latitude] * 3)
        # the map's edge may lie between two of the three positions
        turn = 360.0 * min(np.diff(xs), key=abs)
        longitudes, latitudes = transform(crs, degrees, [xs[1] + turn, xs[1] - turn], [y] * 2)
    except Exception:  # positions outside the domain of a projection raise private exceptions of rasterio
        return None
    errors = [*(np.mod(np.subtract(longitudes, longitude) + 180.0, 360.0) - 180.0), *np.subtract(latitudes, latitude)]
    return abs(float(turn)) if np.all(np.abs(errors) < _MAX_TURN_ERROR_DEG) else None
