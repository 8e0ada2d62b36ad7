"""Own terrain looked at before it is used: a file that cannot be meant is refused by its header, at once.

`marsyard.sim.terrain` reads what passes here. A GeoTIFF must state a projection in metres (or another length, by which
it is scaled) that keeps lengths, square cells with grid north up, a value that means no data where it has any, and
heights in metres. An .npz archive is checked in the same way, from its headers before anything is expanded.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.scenarios.map_projection import map_scale
from marsyard.sim.files import ARCHIVE_ERRORS, ArrayHeader, check_regular, npz_headers
from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.imported import RealTerrain, TerrainFileError, check_holes, read_rasters

#: Most posts of a DTM and pixels of a picture along a side: what the largest terrain holds, and what memory does.
MOST_POSTS, MOST_PIXELS = 5461, 8192
#: By how much a projection may stretch lengths where the file lies.
MOST_STRETCH = 0.02
#: Heights that no ground of Earth, Moon or Mars has: Mariana Trench to Olympus Mons.
HEIGHTS_M = (-11_500.0, 22_000.0)
_METRES = ("", "m", "metre", "metres", "meter", "meters")
#: Arrays of an .npz, and how many dimensions each has.
_ARRAYS = {"dem": 2, "dem_gsd": 0, "ortho": 2, "ortho_gsd": 0, "ortho_valid": 2}


def check_terrain(terrain: TerrainParameters) -> None:
    """Raises TerrainFileError where a terrain's files cannot be used; the message names file and fault."""
    if terrain.source is not None:
        check_source(terrain.source)


def check_source(source: RealTerrain) -> None:
    """Raises TerrainFileError where these files cannot be used; the message names file and fault."""
    paths = [path for path in (source.dtm, source.ortho) if path is not None]
    _check(source, tuple(_present(path).stat().st_mtime_ns for path in paths))


@lru_cache(maxsize=16)
def _check(source: RealTerrain, _changed_ns: tuple[int, ...]) -> None:
    """Looked at once: a campaign's cases all ask."""
    dtm = source.dtm
    if dtm.suffix == ".npz":
        _check_npz(source)
        dtm_crs = None
    else:
        dtm_crs = _check_geotiff(dtm, MOST_POSTS, heights_of=source)
    if source.ortho is None:
        return
    ortho_crs = _check_geotiff(source.ortho, MOST_PIXELS)
    if dtm_crs is not None and ortho_crs != dtm_crs:
        raise TerrainFileError(
            f"{source.ortho}: its projection is not that of {source.dtm}; bring it there with "
            f"rio warp {source.ortho.name} OUT --like {source.dtm.name} --res METRES"
        )


def _present(path: Path) -> Path:
    try:
        about = check_regular(path)
    except FileNotFoundError:
        raise TerrainFileError(f"{path}: no such file") from None
    except OSError as fault:
        raise TerrainFileError(f"{path}: {fault.strerror}") from fault
    if about.st_size == 0:
        raise TerrainFileError(f"{path}: is empty (0 bytes)")
    return path


def _check_npz(source: RealTerrain) -> None:
    """Checks the headers of an archive, and then its heights."""
    path = source.dtm
    try:
        headers = npz_headers(path)
    except ARCHIVE_ERRORS as fault:
        raise TerrainFileError(f"{path}: is no .npz archive of arrays ({fault})") from fault
    missing = [name for name in ("dem", "dem_gsd") if name not in headers]
    if missing:
        raise TerrainFileError(f"{path}: lacks {', '.join(missing)}; needed: dem (m, row 0 in the north), dem_gsd (m)")
    if "ortho" in headers and "ortho_gsd" not in headers:
        raise TerrainFileError(f"{path}: has an ortho, but lacks ortho_gsd (m between its pixels)")
    for name, header in headers.items():
        if name in _ARRAYS:
            _check_array(path, name, header)
    if "ortho_valid" in headers and headers["ortho_valid"][0] != headers.get("ortho", headers["ortho_valid"])[0]:
        raise TerrainFileError(f"{path}: ortho_valid has another shape than ortho")
    with np.load(path, allow_pickle=False) as file:
        for name in [name for name in ("dem_gsd", "ortho_gsd") if name in headers]:
            posting = float(file[name].reshape(()))
            if not (np.isfinite(posting) and posting > 0.0):
                raise TerrainFileError(f"{path}: {name} is {posting}; allowed: metres between posts, above 0")
    _check_values(path, read_rasters(source)[0].values, source, "mark posts without height with NaN")


def _check_array(path: Path, name: str, header: ArrayHeader) -> None:
    """Checks what the header of an archive's array says, before the array is expanded."""
    shape, dtype = header
    if dtype.kind not in "biuf":
        raise TerrainFileError(f"{path}: {name} holds values of type {dtype}; allowed: real numbers")
    if _ARRAYS[name] == 0:
        if np.prod(shape, dtype=np.float64) != 1:
            raise TerrainFileError(f"{path}: {name} has the shape {shape}; one number is needed")
        return
    most = MOST_POSTS if name == "dem" else MOST_PIXELS
    if len(shape) != 2 or min(shape) < 4 or max(shape) > most:
        raise TerrainFileError(
            f"{path}: {name} has a grid of shape {shape}; two dimensions of 4 to {most} values are needed"
        )


def _check_geotiff(path: Path, most: int, *, heights_of: RealTerrain | None = None) -> Any:
    """Checks what the header says and, of a DTM, its heights; returns the projection."""
    with _opened(path) as file:
        _check_grid(path, file, most)
        _check_projection(path, file)
        if heights_of is not None:
            _check_heights(path, file, heights_of)
        return file.crs


def _opened(path: Path) -> Any:
    """A GeoTIFF, open. Raises TerrainFileError."""
    _present(path)
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(f"{path}: reading GeoTIFF needs rasterio: pip install rasterio (extra 'geo')") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without a position is refused by `_check_projection`
        try:
            return rasterio.open(path)
        except rasterio.errors.RasterioError as fault:
            raise TerrainFileError(f"{path}: is no GeoTIFF ({fault})") from fault


def _check_grid(path: Path, file: Any, most: int) -> None:
    if min(file.width, file.height) < 4:
        raise TerrainFileError(f"{path}: has {file.width} x {file.height} values; at least 4 x 4 are needed")
    if max(file.width, file.height) > most:
        raise TerrainFileError(
            f"{path}: has {file.width} x {file.height} values; at most {most} along a side are used: cut a part "
            "out with rio clip --bounds, or make it coarser with rio warp --res"
        )
    cell = file.transform
    if not (np.isfinite(cell.a) and cell.a > 0.0):
        raise TerrainFileError(f"{path}: its cells are {cell.a:g} wide; north up and east right are needed (rio warp)")
    if cell.b or cell.d or abs(cell.a + cell.e) > 1e-6 * abs(cell.a):
        raise TerrainFileError(
            f"{path}: has rotated or oblong cells; square ones, north up, are needed (rio warp --res)"
        )


def _check_projection(path: Path, file: Any) -> None:
    crs = file.crs
    if crs is None:
        raise TerrainFileError(f"{path}: states no projection; state it with rio edit-info --crs")
    if crs.is_geographic:
        raise TerrainFileError(f"{path}: is in degrees; project it to metres with rio warp --dst-crs")
    if not crs.is_projected:
        raise TerrainFileError(f"{path}: its coordinates are no map projection's; project it with rio warp --dst-crs")
    scale = map_scale(file)
    if scale is None:  # a projection whose inverse is not known is believed
        return
    if max(scale.largest - 1.0, 1.0 - scale.smallest) > MOST_STRETCH:
        raise TerrainFileError(
            f"{path}: its projection stretches lengths by {scale.smallest:.3f} to {scale.largest:.3f}, depending on "
            f"their direction; allowed: within {MOST_STRETCH:g} of 1: project it about its own middle with "
            "rio warp --dst-crs"
        )


def grid_north_deg(path: Path) -> float | None:
    """Azimuth of a GeoTIFF's grid north in its middle, clockwise from true north, degrees; None where it is not known.

    Raises TerrainFileError where the file cannot be opened.
    """
    if path.suffix == ".npz":
        return None
    with _opened(path) as file:
        scale = map_scale(file)
    return None if scale is None else scale.grid_north_deg


def _check_heights(path: Path, file: Any, source: RealTerrain) -> None:
    if file.dtypes[0] == "uint8":
        raise TerrainFileError(f"{path}: holds 8-bit values, which are a picture's; heights in metres are needed")
    unit = (file.units[0] or "").strip().lower()
    if unit not in _METRES:
        raise TerrainFileError(f"{path}: its heights are in {file.units[0]!r}; metres are needed (rio calc)")
    if file.scales[0] != 1.0 or file.offsets[0] != 0.0:
        raise TerrainFileError(
            f"{path}: states scale {file.scales[0]:g} and offset {file.offsets[0]:g}; apply them with rio calc"
        )
    values = file.read(1, masked=True)
    if values.dtype.kind not in "iuf":
        raise TerrainFileError(f"{path}: holds values of type {values.dtype}; heights in metres are needed")
    stated = "states no nodata value" if file.nodata is None else f"states nodata {file.nodata:g}"
    advice = f"it {stated}; state the value that means no data with rio edit-info --nodata"
    _check_values(path, values.astype(np.float64).filled(np.nan), source, advice)


def _check_values(path: Path, values: np.ndarray, source: RealTerrain, advice: str) -> None:
    """Checks heights, NaN where there is none: how many are missing, and that the others can be some."""
    check_holes(source, values)
    valid = values[np.isfinite(values)]
    low, high = float(valid.min()), float(valid.max())
    if not (HEIGHTS_M[0] <= low and high <= HEIGHTS_M[1]):
        wrong = low if low < HEIGHTS_M[0] else high
        raise TerrainFileError(
            f"{path}: holds heights of {wrong:g} m; allowed: {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m; {advice}"
        )
