"""Validate a user's terrain files before `marsyard.sim.terrain` reads them, and create sites from them.

A GeoTIFF must have a map projection that preserves lengths (to 2 %) and square cells with grid north up; coordinates
may be in metres or another length unit. Its heights must be in metres, and gaps need a no-data value. An .npz archive
must have heights and cell sizes in metres.
"""

import os
import warnings
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator

from marsyard.scenarios.map_scale import NoInverseError, map_scale
from marsyard.scenarios.missing_heights import find_missing_value
from marsyard.sim.files import check_regular, read_npz_headers, report_damage
from marsyard.sim.terrain import Site, TerrainParameters, site, sites
from marsyard.sim.terrain.imported import choose_grid
from marsyard.sim.terrain.rasters import (
    RealTerrain,
    TerrainFileError,
    brightness_problems,
    check_holes,
    read_heights,
    read_rasters,
)

#: Maximum number of DTM posts along a side (size of the largest terrain), and of orthoimage pixels (memory).
_MAX_POSTS, _MAX_PIXELS = 5461, 8192
#: Maximum relative difference of a cell's sides: rounding in files.
_MAX_SIDE_DIFFERENCE = 1e-6
#: Maximum relative distortion of lengths by the projection.
_MAX_STRETCH = 0.02
#: Minimum number of values along a side of a grid.
_MIN_SIDE = 4
#: Range of heights on Earth, Moon and Mars: Mariana Trench to Olympus Mons.
HEIGHTS_M = (-11_500.0, 22_000.0)
#: Names of the unit metre in a GeoTIFF; without a name, heights are assumed to be in metres.
_METRE_UNITS = ("", "m", "metre", "metres", "meter", "meters")
#: Vertical axis of depths in a projection's text (WKT 1).
_DEPTH_AXIS = ",DOWN]"
_NO_GEOTIFF = "is not a valid GeoTIFF"
#: Arrays of an .npz archive and their dimensions.
_ARRAYS = {"dem": 2, "dem_gsd": 0, "ortho": 2, "ortho_gsd": 0, "ortho_valid": 2}
#: File suffixes of terrain models.
SUFFIXES = (".npz", ".tif", ".tiff", ".img", ".cub")
#: Preset that supplies light, air, scattering and fine texture for imported ground.
LIGHT_PRESET = "gusev"
#: Default maximum fraction of posts without height in a terrain model.
MAX_HOLE_FRACTION = float(RealTerrain.model_fields["max_hole_fraction"].default)


def _check_terrain(terrain: TerrainParameters) -> TerrainParameters:
    """Check the files of a terrain from a model. Raises TerrainFileError."""
    if terrain.source is not None:
        check_source(terrain.source)
    return terrain


#: A terrain whose files are checked: raises TerrainFileError if they are invalid.
CheckedTerrain = Annotated[TerrainParameters, AfterValidator(_check_terrain)]


def check_source(source: RealTerrain) -> None:
    """Raise TerrainFileError for invalid files; the message contains the file and the problem."""
    paths = [path for path in (source.dtm, source.ortho) if path is not None]
    _check_files(source, tuple(_require_file(path).st_mtime_ns for path in paths))


@lru_cache(maxsize=16)
def _check_files(source: RealTerrain, _modified_ns: tuple[int, ...]) -> None:
    """Check the files; the modification times are a key of the cache, so that changed files are checked again."""
    dtm = source.dtm
    if dtm.suffix == ".npz":
        with report_damage(dtm, TerrainFileError, "is not a valid .npz archive of arrays"):
            _raise_first_problem(dtm, _npz_problems(source))
        heights, _ = read_rasters(source)
        _check_values(dtm, heights.values, heights.posting_m, source, "mark posts without height with NaN")
        dtm_crs = None
    else:
        dtm_crs = _check_geotiff(dtm, _MAX_POSTS, dtm_source=source)
    if source.ortho is None or not source.use_ortho:
        return
    ortho_crs = _check_geotiff(source.ortho, _MAX_PIXELS)
    if dtm_crs is not None and ortho_crs != dtm_crs:
        raise TerrainFileError(
            f"{source.ortho}: its projection differs from that of {source.dtm}; reproject it with "
            f"rio warp {source.ortho.name} OUT --like {source.dtm.name} --res METRES"
        )
    read_rasters(source)  # checks that the orthoimage covers the DTM


def _require_file(path: Path) -> os.stat_result:
    """Return the status of a file. Raises TerrainFileError if it is missing, not a regular file, or empty."""
    try:
        status = check_regular(path)
    except FileNotFoundError:
        raise TerrainFileError(f"{path}: no such file") from None
    except OSError as error:
        raise TerrainFileError(f"{path}: {error.strerror}") from error
    if status.st_size == 0:
        raise TerrainFileError(f"{path}: is empty (0 bytes)")
    return status


def _npz_problems(source: RealTerrain) -> Iterator[str]:
    """Yield problems of an archive's headers."""
    headers = read_npz_headers(source.dtm)
    missing = [name for name in ("dem", "dem_gsd") if name not in headers]
    if missing:
        yield f"has no {', '.join(missing)}; required: dem (m, row 0 in the north), dem_gsd (m)"
    if "ortho" in headers and "ortho_gsd" not in headers:
        yield "has an ortho, but no ortho_gsd (m between its pixels)"
    for name, (shape, dtype) in headers.items():
        limit = _MAX_POSTS if name == "dem" else _MAX_PIXELS
        if name in _ARRAYS and dtype.kind not in "biuf":
            yield f"{name} contains values of type {dtype}; allowed: real numbers"
        if _ARRAYS.get(name) == 0 and np.prod(shape, dtype=np.float64) != 1:
            yield f"{name} has the shape {shape}; allowed: one number"
        if _ARRAYS.get(name) == 2 and (len(shape) != 2 or min(shape) < _MIN_SIDE or max(shape) > limit):
            yield f"{name} has a grid of shape {shape}; allowed: two dimensions of {_MIN_SIDE} to {limit} values"
    if "ortho_valid" in headers and headers["ortho_valid"][0] != headers.get("ortho", headers["ortho_valid"])[0]:
        yield "ortho_valid and ortho have different shapes"
    with np.load(source.dtm, allow_pickle=False) as file:
        for name in [name for name in ("dem_gsd", "ortho_gsd") if name in headers]:
            posting = float(file[name].reshape(()))
            if not (np.isfinite(posting) and posting > 0.0):
                yield f"{name} is {posting}; allowed: metres between posts, above 0"


def _geotiff_problems(file: Any, max_side: int, is_dtm: bool) -> Iterator[str]:
    """Yield problems of a GeoTIFF's size, cells and projection and, for heights, of their unit and type."""
    if min(file.width, file.height) < _MIN_SIDE:
        yield f"has {file.width} x {file.height} values; allowed: at least {_MIN_SIDE} x {_MIN_SIDE}"
    if max(file.width, file.height) > max_side:
        yield (
            f"has {file.width} x {file.height} values; allowed: at most {max_side} along a side: extract a part with "
            "rio clip --bounds, or resample it with rio warp --res"
        )
    cell, crs = file.transform, file.crs
    if not (np.isfinite(cell.a) and cell.a > 0.0):
        yield f"its cells are {cell.a:g} wide; allowed: north up and east right (rio warp)"
    if cell.b or cell.d or abs(cell.a + cell.e) > _MAX_SIDE_DIFFERENCE * abs(cell.a):
        yield "has rotated or oblong cells; allowed: square cells, north up (rio warp --res)"
    if crs is None:
        yield "has no projection; add it with rio edit-info --crs"
    elif crs.is_geographic:
        yield "is in degrees; project it to metres with rio warp --dst-crs"
    elif not crs.is_projected:
        yield "its coordinates are not those of a map projection; project it with rio warp --dst-crs"
    try:
        scale = map_scale(file)
    except NoInverseError as error:
        yield (
            f"its projection has no inverse in PROJ ({error}), so that lengths and true north are unknown; allowed: a "
            "projection with an inverse, such as stereographic, Lambert conformal or transverse Mercator"
        )
        return
    if scale is not None and max(scale.max_ratio - 1.0, 1.0 - scale.min_ratio) > _MAX_STRETCH:
        yield (
            f"its projection stretches lengths by {scale.min_ratio:.3f} to {scale.max_ratio:.3f}, depending on their "
            f"direction; allowed: within {_MAX_STRETCH:g} of 1: project it about its centre with rio warp --dst-crs"
        )
    if not is_dtm:
        yield from brightness_problems(file)
        return
    if file.colorinterp[0].name in ("palette", "red", "green", "blue"):
        yield "contains colours, as in an image; allowed: heights in metres"
    if file.dtypes[0] == "uint8":
        yield "contains 8-bit values, as in an image; allowed: heights in metres"
    if (file.units[0] or "").strip().lower() not in _METRE_UNITS:
        yield f"its heights are in {file.units[0]!r}; allowed: metres (rio calc)"
    if _DEPTH_AXIS in crs.to_wkt():
        yield "contains depths (its vertical axis points down); allowed: heights, positive upwards (rio calc)"
    if file.scales[0] != 1.0 or file.offsets[0] != 0.0:
        yield f"has scale {file.scales[0]:g} and offset {file.offsets[0]:g}; apply them with rio calc"


def _raise_first_problem(path: Path, problems: Iterator[str]) -> None:
    """Raise TerrainFileError for the first problem only: later checks assume that earlier checks passed."""
    problem = next(problems, None)
    if problem is not None:
        raise TerrainFileError(f"{path}: {problem}")


def _check_geotiff(path: Path, max_side: int, *, dtm_source: RealTerrain | None = None) -> Any:
    """Check the header and, for a DTM, the heights; return the projection."""
    with report_damage(path, TerrainFileError, _NO_GEOTIFF), _open(path) as file:
        _raise_first_problem(path, _geotiff_problems(file, max_side, dtm_source is not None))
        if dtm_source is None:
            return file.crs
        if np.dtype(file.dtypes[0]).kind not in "iuf":
            raise TerrainFileError(f"{path}: contains values of type {file.dtypes[0]}; allowed: heights in metres")
        nodata = "has no nodata value" if file.nodata is None else f"has the nodata value {file.nodata:g}"
        advice = f"it {nodata}; set the value for missing data with rio edit-info --nodata"
        _, unit_m = file.crs.linear_units_factor
        posting_m = float(file.transform.a) * float(unit_m)
        _check_values(path, read_heights(file), posting_m, dtm_source, advice)
        return file.crs


def _open(path: Path) -> Any:
    """Open a GeoTIFF, for `report_damage`. Raises TerrainFileError without the file or rasterio."""
    _require_file(path)
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(f"{path}: reading GeoTIFF needs rasterio: pip install rasterio (extra 'geo')") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `_geotiff_problems` reports a file without a position
        return rasterio.open(path)


def grid_north_deg(path: Path) -> float | None:
    """Return the azimuth of a GeoTIFF's grid north at its centre, clockwise from true north; None if unknown.

    Raises TerrainFileError if the file cannot be opened.
    """
    if path.suffix == ".npz":
        return None
    with report_damage(path, TerrainFileError, _NO_GEOTIFF), _open(path) as file:
        scale = map_scale(file)
    return None if scale is None else scale.grid_north_deg


def _check_values(path: Path, values: np.ndarray, posting_m: float, source: RealTerrain, advice: str) -> None:
    """Check the number of missing heights (NaN), the range of the valid heights, and undeclared missing values."""
    check_holes(source, values)
    valid_heights = values[np.isfinite(values)]
    low, high = float(valid_heights.min()), float(valid_heights.max())
    if not (HEIGHTS_M[0] <= low and high <= HEIGHTS_M[1]):
        extreme = low if low < HEIGHTS_M[0] else high
        posts = int(np.count_nonzero(valid_heights == extreme))
        raise TerrainFileError(
            f"{path}: contains heights of {extreme:g} m; allowed: {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m; "
            f"number of posts with this height: {posts} of {values.size}; {advice}"
        )
    missing = find_missing_value(values, posting_m)
    if missing is not None:
        raise TerrainFileError(
            f"{path}: the height {missing.height_m:.10g} m at {missing.posts} of {values.size} posts is probably a "
            f"value for missing data: it is repeated exactly, with cliffs at its border; {advice}"
        )


def is_terrain_file(name: str) -> bool:
    """Return whether a name is the file of a terrain model, not a site."""
    return Path(name).suffix.lower() in SUFFIXES


def check_site_name(name: str) -> None:
    """Raise TerrainFileError if a name that is no terrain model is the name of a file, not of a site."""
    path = Path(name)
    if name not in sites() and (path.suffix or len(path.parts) > 1 or path.is_file()):
        raise TerrainFileError(
            f"{name}: is not a terrain model; allowed: {', '.join(SUFFIXES)} (GeoTIFF, PDS3 or ISIS products, "
            f"arrays); convert other rasters with rio convert {path.name} {path.stem}.tif"
        )


def load_site(name: str, max_hole_fraction: float = MAX_HOLE_FRACTION) -> Site:
    """Return a preset by name, or a terrain model's file as a site: one terrain at both scales, no rocks or craters.

    Raises ValueError, or TerrainFileError.
    """
    if not is_terrain_file(name):
        check_site_name(name)
        return site(name)
    path = Path(name)
    source = RealTerrain(dtm=path, max_hole_fraction=max_hole_fraction)
    check_source(source)
    return _import_site(source, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _import_site(source: RealTerrain, _modified_ns: int) -> Site:
    """Create the site of a terrain model; the modification time is a key of the cache."""
    samples, spacing_m = choose_grid(source)
    terrain = TerrainParameters(samples=samples, spacing_m=spacing_m, craters_per_km2=0.0, source=source)
    changes = {
        "name": source.dtm.name,
        "description": f"terrain model {source.dtm} with the light of {LIGHT_PRESET}",
        "descent": terrain,
        "ground": terrain,
        "hills": (),
    }
    return site(LIGHT_PRESET).model_copy(update=changes)
