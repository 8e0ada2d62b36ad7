"""Values of GeoTIFF files, as rasterio datasets: heights, brightness of orthoimages, and full turns of longitude."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float64

Grid = Float64[np.ndarray, "rows columns"]

#: Luminance weights of red, green and blue (ITU-R BT.601), as in OpenCV and Pillow.
LUMINANCE = {"red": 0.299, "green": 0.587, "blue": 0.114}
#: Maximum error of a position after a full turn of longitude, deg.
_MAX_TURN_ERROR_DEG = 1e-6


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
        for number, name in zip(file.indexes, names, strict=True):
            weight = LUMINANCE.get(name, 0.0) if is_colour else float(number == 1)
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
