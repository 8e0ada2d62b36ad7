"""Validate terrain files of a user by their headers before `marsyard.sim.terrain` reads them, and use them as sites.

A GeoTIFF must have a projection in metres (or another length, by which it is scaled) that preserves lengths, square
cells with grid north up, a no-data value if it has gaps, and heights in metres. An .npz archive is checked likewise.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator

from marsyard.sim.files import ARCHIVE_ERRORS, check_regular, npz_headers
from marsyard.sim.terrain import Site, TerrainParameters, site, sites
from marsyard.sim.terrain.imported import RealTerrain, TerrainFileError, check_holes, choose_grid, read_rasters

#: Maximum posts of a DTM and pixels of a picture along a side: limits of the largest terrain and of memory.
_MAX_POSTS, _MAX_PIXELS = 5461, 8192
#: Maximum relative distortion of lengths by the projection.
_MAX_STRETCH = 0.02
#: Range of heights on Earth, Moon and Mars: Mariana Trench to Olympus Mons.
HEIGHTS_M = (-11_500.0, 22_000.0)
_METRES = ("", "m", "metre", "metres", "meter", "meters")
#: Arrays of an .npz archive and their dimensions.
_ARRAYS = {"dem": 2, "dem_gsd": 0, "ortho": 2, "ortho_gsd": 0, "ortho_valid": 2}


def _check_terrain(terrain: TerrainParameters) -> TerrainParameters:
    if terrain.source is not None:
        check_source(terrain.source)
    return terrain


#: A terrain whose files are checked: raises TerrainFileError where they are unusable.
CheckedTerrain = Annotated[TerrainParameters, AfterValidator(_check_terrain)]


def check_site(user: str, scale: str) -> AfterValidator:
    """Return a check of a site's name: a preset with a terrain at the scale; messages name the user of the site."""

    def check(name: str | None) -> str | None:
        allowed = [one.name for one in sites().values() if getattr(one, scale) is not None]
        if name is not None and name not in allowed:
            raise ValueError(f"no site for {user} is called '{name}'; allowed: {', '.join(allowed)}")
        return name

    return AfterValidator(check)


def check_source(source: RealTerrain) -> None:
    """Raise TerrainFileError where files are unusable; the message names file and fault."""
    paths = [path for path in (source.dtm, source.ortho) if path is not None]
    _check(source, tuple(_check_present(path).st_mtime_ns for path in paths))


@lru_cache(maxsize=16)
def _check(source: RealTerrain, _changed_ns: tuple[int, ...]) -> None:
    dtm = source.dtm
    if dtm.suffix == ".npz":
        _raise_first(dtm, _npz_problems(source))
        _check_values(dtm, read_rasters(source)[0].values, source, "mark posts without height with NaN")
        dtm_crs = None
    else:
        dtm_crs = _check_geotiff(dtm, _MAX_POSTS, heights_of=source)
    if source.ortho is None:
        return
    ortho_crs = _check_geotiff(source.ortho, _MAX_PIXELS)
    if dtm_crs is not None and ortho_crs != dtm_crs:
        raise TerrainFileError(
            f"{source.ortho}: its projection is not that of {source.dtm}; bring it there with "
            f"rio warp {source.ortho.name} OUT --like {source.dtm.name} --res METRES"
        )


def _check_present(path: Path) -> os.stat_result:
    try:
        status = check_regular(path)
    except FileNotFoundError:
        raise TerrainFileError(f"{path}: no such file") from None
    except OSError as fault:
        raise TerrainFileError(f"{path}: {fault.strerror}") from fault
    if status.st_size == 0:
        raise TerrainFileError(f"{path}: is empty (0 bytes)")
    return status


def _npz_problems(source: RealTerrain) -> Iterator[str]:
    """Yield problems of an archive's headers."""
    try:
        headers = npz_headers(source.dtm)
    except ARCHIVE_ERRORS as fault:
        raise TerrainFileError(f"{source.dtm}: is no .npz archive of arrays ({fault})") from fault
    missing = [name for name in ("dem", "dem_gsd") if name not in headers]
    if missing:
        yield f"lacks {', '.join(missing)}; needed: dem (m, row 0 in the north), dem_gsd (m)"
    if "ortho" in headers and "ortho_gsd" not in headers:
        yield "has an ortho, but lacks ortho_gsd (m between its pixels)"
    for name, (shape, dtype) in headers.items():
        limit = _MAX_POSTS if name == "dem" else _MAX_PIXELS
        if name in _ARRAYS and dtype.kind not in "biuf":
            yield f"{name} holds values of type {dtype}; allowed: real numbers"
        if _ARRAYS.get(name) == 0 and np.prod(shape, dtype=np.float64) != 1:
            yield f"{name} has the shape {shape}; one number is needed"
        if _ARRAYS.get(name) == 2 and (len(shape) != 2 or min(shape) < 4 or max(shape) > limit):
            yield f"{name} has a grid of shape {shape}; two dimensions of 4 to {limit} values are needed"
    if "ortho_valid" in headers and headers["ortho_valid"][0] != headers.get("ortho", headers["ortho_valid"])[0]:
        yield "ortho_valid has another shape than ortho"
    with np.load(source.dtm, allow_pickle=False) as file:
        for name in [name for name in ("dem_gsd", "ortho_gsd") if name in headers]:
            posting = float(file[name].reshape(()))
            if not (np.isfinite(posting) and posting > 0.0):
                yield f"{name} is {posting}; allowed: metres between posts, above 0"


def _geotiff_problems(file: Any, max_side: int, are_heights: bool) -> Iterator[str]:
    """Yield problems of a file's size, cells and projection, and of the unit and type of heights."""
    if min(file.width, file.height) < 4:
        yield f"has {file.width} x {file.height} values; at least 4 x 4 are needed"
    if max(file.width, file.height) > max_side:
        yield (
            f"has {file.width} x {file.height} values; at most {max_side} along a side are used: cut a part out with "
            "rio clip --bounds, or make it coarser with rio warp --res"
        )
    cell, crs = file.transform, file.crs
    if not (np.isfinite(cell.a) and cell.a > 0.0):
        yield f"its cells are {cell.a:g} wide; north up and east right are needed (rio warp)"
    if cell.b or cell.d or abs(cell.a + cell.e) > 1e-6 * abs(cell.a):
        yield "has rotated or oblong cells; square ones, north up, are needed (rio warp --res)"
    if crs is None:
        yield "states no projection; state it with rio edit-info --crs"
    elif crs.is_geographic:
        yield "is in degrees; project it to metres with rio warp --dst-crs"
    elif not crs.is_projected:
        yield "its coordinates are no map projection's; project it with rio warp --dst-crs"
    scale = map_scale(file)
    # a projection without a known inverse is accepted
    if scale is not None and max(scale.largest - 1.0, 1.0 - scale.smallest) > _MAX_STRETCH:
        yield (
            f"its projection stretches lengths by {scale.smallest:.3f} to {scale.largest:.3f}, depending on their "
            f"direction; allowed: within {_MAX_STRETCH:g} of 1: project it about its own middle with rio warp --dst-crs"
        )
    if not are_heights:
        return
    if file.dtypes[0] == "uint8":
        yield "holds 8-bit values, which are a picture's; heights in metres are needed"
    if (file.units[0] or "").strip().lower() not in _METRES:
        yield f"its heights are in {file.units[0]!r}; metres are needed (rio calc)"
    if file.scales[0] != 1.0 or file.offsets[0] != 0.0:
        yield f"states scale {file.scales[0]:g} and offset {file.offsets[0]:g}; apply them with rio calc"


def _raise_first(path: Path, problems: Iterator[str]) -> None:
    """Raise TerrainFileError for the first problem; later checks rely on it."""
    problem = next(problems, None)
    if problem is not None:
        raise TerrainFileError(f"{path}: {problem}")


def _check_geotiff(path: Path, max_side: int, *, heights_of: RealTerrain | None = None) -> Any:
    """Check the header and, of a DTM, the heights; return the projection."""
    with _open(path) as file:
        _raise_first(path, _geotiff_problems(file, max_side, heights_of is not None))
        if heights_of is None:
            return file.crs
        values = file.read(1, masked=True)
        if values.dtype.kind not in "iuf":
            raise TerrainFileError(f"{path}: holds values of type {values.dtype}; heights in metres are needed")
        stated = "states no nodata value" if file.nodata is None else f"states nodata {file.nodata:g}"
        advice = f"it {stated}; state the value that means no data with rio edit-info --nodata"
        _check_values(path, values.astype(np.float64).filled(np.nan), heights_of, advice)
        return file.crs


def _open(path: Path) -> Any:
    """Open a GeoTIFF. Raises TerrainFileError."""
    _check_present(path)
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(f"{path}: reading GeoTIFF needs rasterio: pip install rasterio (extra 'geo')") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without a position is refused by `_geotiff_problems`
        try:
            return rasterio.open(path)
        except rasterio.errors.RasterioError as fault:
            raise TerrainFileError(f"{path}: is no GeoTIFF ({fault})") from fault


def grid_north_deg(path: Path) -> float | None:
    """Return the azimuth of a GeoTIFF's grid north in its middle, clockwise from true north; None if unknown.

    Raises TerrainFileError where the file cannot be opened.
    """
    if path.suffix == ".npz":
        return None
    with _open(path) as file:
        scale = map_scale(file)
    return None if scale is None else scale.grid_north_deg


def _check_values(path: Path, values: np.ndarray, source: RealTerrain, advice: str) -> None:
    """Check the number of missing heights (NaN) and the range of the others."""
    check_holes(source, values)
    valid = values[np.isfinite(values)]
    low, high = float(valid.min()), float(valid.max())
    if not (HEIGHTS_M[0] <= low and high <= HEIGHTS_M[1]):
        wrong = low if low < HEIGHTS_M[0] else high
        raise TerrainFileError(
            f"{path}: holds heights of {wrong:g} m; allowed: {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m; {advice}"
        )


#: Distance from a pole, in cells, below which the direction of true north is undefined.
_POLE_CELLS = 2.0


@dataclass(frozen=True)
class MapScale:
    """Scale of a map projection at a point.

    - smallest, largest: extreme ratios of lengths on the map to those on the ground over all directions: the singular
      values of the projection's derivative (Snyder 1987, Map Projections: A Working Manual, section 4)
    - grid_north_deg: grid convergence: azimuth of the columns' upward direction, clockwise from true north, -180 to
      180; None at a pole
    """

    smallest: float
    largest: float
    grid_north_deg: float | None


def map_scale(file: Any) -> MapScale | None:
    """Compute the scale of a rasterio dataset's projection in its middle; None without a known inverse."""
    from rasterio.crs import CRS
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    cell = file.transform
    x, y = cell.c + 0.5 * file.width * cell.a, cell.f + 0.5 * file.height * cell.e
    # central differences of positions in body-fixed axes, which have no singularity at the poles, over a step that is
    # large compared with rounding and small compared with the projection's curvature
    step = max(abs(cell.a), 1.0)
    xs, ys = [x - step, x + step, x, x], [y, y, y - step, y + step]
    try:
        terms, unit_m = file.crs.to_dict(), float(file.crs.linear_units_factor[1])
        body = {name: terms[name] for name in ("a", "b", "R", "ellps", "datum", "rf") if name in terms}
        centred = CRS.from_dict({"proj": "geocent", **body, "units": "m", "no_defs": True})
        positions = np.array(transform(file.crs, centred, xs, ys, [0.0] * 4), dtype=np.float64).T
    except (RasterioError, ValueError):
        return None
    # ground lengths per map length along x and y
    length = 2.0 * step * unit_m
    east, north = (positions[1] - positions[0]) / length, (positions[3] - positions[2]) / length
    gram = np.array([[east @ east, east @ north], [east @ north, north @ north]])
    if not np.all(np.isfinite(gram)) or np.linalg.det(gram) <= 0.0:
        return None
    ground = np.sqrt(np.linalg.eigvalsh(gram))
    azimuth_deg = None
    if float(np.hypot(*positions.mean(axis=0)[:2])) >= _POLE_CELLS * abs(cell.a) * unit_m:
        normal = np.cross(east, north)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        true_east = np.cross([0.0, 0.0, 1.0], normal)
        true_north = np.cross(normal, true_east)
        azimuth_deg = float(np.degrees(np.arctan2(north @ true_east, north @ true_north)))
    return MapScale(1.0 / float(ground[1]), 1.0 / float(ground[0]), azimuth_deg)


#: Suffixes of terrain models.
ENDINGS = (".npz", ".tif", ".tiff")
#: Preset of the light, air, scattering and fine texture of imported ground.
LIGHT_OF = "gusev"
#: Fraction of posts without height up to which a terrain model is used, unless stated.
MAX_HOLE_FRACTION = float(RealTerrain.model_fields["max_hole_fraction"].default)


def is_terrain_file(name: str) -> bool:
    """Return whether a name is that of a terrain model's file, not of a site."""
    return Path(name).suffix.lower() in ENDINGS


def site_or_file(name: str, max_hole_fraction: float = MAX_HOLE_FRACTION) -> Site:
    """Return a preset by name, or a terrain model's file as a site: one terrain at both scales, no rocks or craters.

    Raises ValueError, or TerrainFileError.
    """
    if not is_terrain_file(name):
        return site(name)
    path = Path(name)
    source = RealTerrain(dtm=path, max_hole_fraction=max_hole_fraction)
    check_source(source)
    return _import_site(source, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _import_site(source: RealTerrain, _changed_ns: int) -> Site:
    samples, spacing_m = choose_grid(source)
    terrain = TerrainParameters(samples=samples, spacing_m=spacing_m, craters_per_km2=0.0, source=source)
    changes = {
        "name": source.dtm.name,
        "description": f"terrain model {source.dtm} in the light of {LIGHT_OF}",
        "descent": terrain,
        "ground": terrain,
    }
    return site(LIGHT_OF).model_copy(update=changes)
