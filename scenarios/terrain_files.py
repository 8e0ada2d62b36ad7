"""Own terrain looked at before it is used: a file that cannot be meant is refused by its header, at once.

`sim.terrain` reads what passes here. A GeoTIFF must state a projection in metres (or another length, by which it is
scaled) that keeps lengths, square cells with north up, a value that means no data where it has any, and heights in
metres.
"""

from __future__ import annotations

import warnings
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sim.terrain import TerrainParameters
from sim.terrain.imported import RealTerrain, TerrainFileError

#: Most posts of a DTM and pixels of a picture along a side: what the largest terrain holds, and what memory does.
MOST_POSTS, MOST_PIXELS = 5461, 8192
#: By how much a projection may stretch lengths where the file lies.
MOST_STRETCH = 0.02
#: Heights that no ground of Earth, Moon or Mars has: Mariana Trench to Olympus Mons.
HEIGHTS_M = (-11_500.0, 22_000.0)
_METRES = ("", "m", "metre", "metres", "meter", "meters")
_ARRAYS = ("dem", "dem_gsd")


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
        _check_npz(dtm)
        dtm_crs = None
    else:
        dtm_crs = _check_geotiff(dtm, MOST_POSTS, heights=True)
    if source.ortho is None:
        return
    ortho_crs = _check_geotiff(source.ortho, MOST_PIXELS, heights=False)
    if dtm_crs is not None and ortho_crs != dtm_crs:
        raise TerrainFileError(
            f"{source.ortho}: its projection is not that of {source.dtm}; bring it there with gdalwarp -t_srs"
        )


def _present(path: Path) -> Path:
    if not path.is_file():
        raise TerrainFileError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}")
    if path.stat().st_size == 0:
        raise TerrainFileError(f"{path}: is empty (0 bytes)")
    return path


def _check_npz(path: Path) -> None:
    try:
        with np.load(path) as file:
            missing = [name for name in _ARRAYS if name not in file]
            posting = None if missing else float(file["dem_gsd"])
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, TypeError) as fault:
        raise TerrainFileError(f"{path}: is no .npz archive of arrays ({fault})") from fault
    if missing:
        raise TerrainFileError(f"{path}: lacks {', '.join(missing)}; needed: dem (m, row 0 in the north), dem_gsd (m)")
    if posting is None or not (np.isfinite(posting) and posting > 0.0):
        raise TerrainFileError(f"{path}: dem_gsd is {posting}; allowed: metres between posts, above 0")


def _check_geotiff(path: Path, most: int, *, heights: bool) -> Any:
    """Checks what the header says and, of heights, that they are some; returns the projection."""
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(f"{path}: reading GeoTIFF needs rasterio: pip install rasterio (extra 'geo')") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a file states no place is said below
        try:
            file = rasterio.open(path)
        except rasterio.errors.RasterioError as fault:
            raise TerrainFileError(f"{path}: is no GeoTIFF ({fault})") from fault
    with file:
        _check_grid(path, file, most)
        _check_projection(path, file)
        if heights:
            _check_heights(path, file)
        return file.crs


def _check_grid(path: Path, file: Any, most: int) -> None:
    if min(file.width, file.height) < 4:
        raise TerrainFileError(f"{path}: has {file.width} x {file.height} values; at least 4 x 4 are needed")
    if max(file.width, file.height) > most:
        raise TerrainFileError(
            f"{path}: has {file.width} x {file.height} values; at most {most} along a side are used: cut it out with "
            "gdalwarp -te, or make it coarser with gdalwarp -tr"
        )
    cell = file.transform
    if not (np.isfinite(cell.a) and cell.a > 0.0):
        raise TerrainFileError(f"{path}: its cells are {cell.a:g} wide; north up and east right are needed (gdalwarp)")
    if cell.b or cell.d or abs(cell.a + cell.e) > 1e-6 * abs(cell.a):
        raise TerrainFileError(f"{path}: has rotated or oblong cells; square ones, north up, are needed (gdalwarp -tr)")


def _check_projection(path: Path, file: Any) -> None:
    crs = file.crs
    if crs is None:
        raise TerrainFileError(f"{path}: states no projection; say which it is with gdal_edit.py -a_srs")
    if crs.is_geographic:
        raise TerrainFileError(f"{path}: is in degrees; project it to metres with gdalwarp -t_srs")
    if not crs.is_projected:
        raise TerrainFileError(f"{path}: its coordinates are no map projection's; project it with gdalwarp -t_srs")
    stretch = _stretch(file)
    worst = float(np.max(np.abs(stretch - 1.0)))
    if worst > MOST_STRETCH:
        raise TerrainFileError(
            f"{path}: its projection stretches lengths by {stretch[0]:.3f} to the east and {stretch[1]:.3f} to the "
            f"north; allowed: within {MOST_STRETCH:g} of 1: project it about its own middle with gdalwarp -t_srs"
        )


def _stretch(file: Any) -> np.ndarray:
    """Length on the map over length on the ground, to the east and to the north, in the middle of a file."""
    from rasterio.crs import CRS
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    terms = file.crs.to_dict()
    body = {name: terms[name] for name in ("a", "b", "R", "ellps", "datum", "rf") if name in terms}
    cell = file.transform
    x, y = cell.c + 0.5 * file.width * cell.a, cell.f + 0.5 * file.height * cell.e
    step = abs(cell.a)
    try:
        globe = CRS.from_dict({"proj": "longlat", **body, "no_defs": True})
        xs, ys = [x - step, x + step, x, x], [y, y, y - step, y + step]
        longitudes, latitudes = np.radians(np.array(transform(file.crs, globe, xs, ys)))
    except (RasterioError, ValueError):
        return np.ones(2)  # a projection whose inverse is not known is believed
    radius = float(body.get("R", body.get("a", 6_378_137.0)))
    across = (longitudes[1] - longitudes[0]) * np.cos(latitudes.mean())
    ground = radius * np.array([np.hypot(across, latitudes[1] - latitudes[0]), latitudes[3] - latitudes[2]])
    metres = float(file.crs.linear_units_factor[1])
    return np.asarray(2.0 * step * metres / np.abs(ground))


def _check_heights(path: Path, file: Any) -> None:
    if file.dtypes[0] == "uint8":
        raise TerrainFileError(f"{path}: holds 8-bit values, which are a picture's; heights in metres are needed")
    unit = (file.units[0] or "").strip().lower()
    if unit not in _METRES:
        raise TerrainFileError(f"{path}: its heights are in {file.units[0]!r}; metres are needed (gdal_calc.py)")
    if file.scales[0] != 1.0 or file.offsets[0] != 0.0:
        raise TerrainFileError(
            f"{path}: states scale {file.scales[0]:g} and offset {file.offsets[0]:g}; apply them with "
            "gdal_translate -unscale"
        )
    values = file.read(1, masked=True)
    valid = values.compressed()
    valid = valid[np.isfinite(valid)]
    if valid.size == 0:
        raise TerrainFileError(f"{path}: has no valid height at all")
    low, high = float(valid.min()), float(valid.max())
    if not (HEIGHTS_M[0] <= low and high <= HEIGHTS_M[1]):
        wrong = low if low < HEIGHTS_M[0] else high
        stated = "states no nodata value" if file.nodata is None else f"states nodata {file.nodata:g}"
        raise TerrainFileError(
            f"{path}: holds heights of {wrong:g} m and {stated}; say what means no data with gdal_edit.py -a_nodata"
        )
