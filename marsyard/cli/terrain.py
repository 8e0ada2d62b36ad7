"""`marsyard terrain`: the sites, and figures of their terrain next to the field test paper's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from marsyard.cli.options import JsonOption, MaxHolesOption, SiteArgument, fail

if TYPE_CHECKING:
    from marsyard.sim.terrain import Surface
    from marsyard.sim.terrain.imported import Embedded, RealExtent
    from marsyard.sim.terrain.parameters import TerrainParameters
    from marsyard.sim.terrain.sites import PaperFigures
    from marsyard.sim.terrain.statistics import TerrainStatistics

#: Longest side of a picture; colours are blue, green, red.
MAX_PIXELS = 2048
HOLE_COLOUR, OUTLINE_COLOUR = (40, 40, 220), (0, 200, 255)

app = typer.Typer(no_args_is_help=True, help="Sites and the figures of their terrain.")


@app.command(name="list")
def list_sites(
    as_json: JsonOption = False,
) -> None:
    """List the sites."""
    import json

    from rich.console import Console
    from rich.table import Table

    from marsyard.sim.terrain.sites import sites

    if as_json:
        rows = [
            {
                "name": one.name,
                "planet": one.environment.planet,
                "terrain": [scale for scale in ("descent", "ground") if getattr(one, scale) is not None],
                "description": one.description,
            }
            for one in sites().values()
        ]
        typer.echo(json.dumps(rows, indent=2))
        return

    table = Table(box=None, pad_edge=False)
    for heading in ("site", "planet", "terrain", "description"):
        table.add_column(heading)
    for site in sites().values():
        scales = ", ".join(scale for scale in ("descent", "ground") if getattr(site, scale) is not None)
        table.add_row(site.name, site.environment.planet, scales, site.description)
    Console().print(table)


@app.command()
def stats(
    site: SiteArgument,
    scale: Annotated[
        str | None, Option("--scale", metavar="SCALE", help="descent or ground; by default the coarser one.")
    ] = None,
    seed: Annotated[int, Option("--seed", metavar="S", min=0, help="Seed of the terrain.")] = 1,
    as_json: JsonOption = False,
    max_holes: MaxHolesOption = None,
    picture: Annotated[
        Path | None, Option("--picture", metavar="PNG", help="Write a nadir picture; filled holes are red.")
    ] = None,
) -> None:
    """Print albedo, slopes, relief and image contrast of a site's terrain beside the paper's figures."""
    import json

    import numpy as np

    from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, grid_north_deg, site_or_file
    from marsyard.sim.terrain.bank import synthesise
    from marsyard.sim.terrain.imported import embed
    from marsyard.sim.terrain.sites import PAPER
    from marsyard.sim.terrain.statistics import terrain_statistics

    try:
        known = site_or_file(site, MAX_HOLE_FRACTION if max_holes is None else max_holes)
        parameters = known.terrain(scale)
        source = parameters.source
        real = None if source is None else embed(source, parameters.samples, parameters.spacing_m)
        grid_north = None if source is None else grid_north_deg(source.dtm)
        surface = synthesise(parameters, np.random.default_rng(seed))
        if picture is not None:
            write_terrain_picture(picture, surface, real)
    except ValueError as error:
        fail(error)
    measured = terrain_statistics(surface, None if real is None else real.real_samples(parameters.samples))
    extent = None if real is None else real.extent
    if as_json:
        record = _record(site, parameters, seed, measured, PAPER.get(site), extent)
        typer.echo(json.dumps({**record, "grid_north_deg": grid_north}, indent=2))
    else:
        _print(site, parameters, seed, measured, PAPER.get(site), extent)
        if grid_north is not None:
            _print_grid_north(grid_north)


def _print_grid_north(grid_north_deg: float) -> None:
    """State from which north azimuths count."""
    from rich.console import Console

    side, sign = ("east", "-") if grid_north_deg >= 0.0 else ("west", "+")
    away = f"{abs(grid_north_deg):.2f} deg"
    Console().print(
        f"Grid north (the y axis) points {away} {side} of true north in the middle of the file. All azimuths, the "
        f"sun's too, count from grid north: azimuth from grid north = azimuth from true north {sign} {away}."
    )


def _record(
    site: str,
    parameters: TerrainParameters,
    seed: int,
    measured: TerrainStatistics,
    paper: PaperFigures | None,
    extent: RealExtent | None,
) -> dict[str, Any]:
    from dataclasses import asdict

    def plain(values: dict[str, Any]) -> dict[str, Any]:
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in values.items()
        }

    return {
        "site": site,
        "side_m": parameters.samples * parameters.spacing_m,
        "spacing_m": parameters.spacing_m,
        "seed": seed,
        "measured": plain(asdict(measured)),
        "paper": None
        if paper is None
        else {
            "albedo": list(paper.albedo),
            "mean_slope_deg": list(paper.mean_slope_deg),
            "relief_at_least_m": None if paper.relief_m is None else paper.relief_m[0],
            "contrast": paper.contrast,
        },
        "real": None if extent is None else asdict(extent),
    }


def _print(
    site: str,
    parameters: TerrainParameters,
    seed: int,
    measured: TerrainStatistics,
    paper: PaperFigures | None,
    extent: RealExtent | None,
) -> None:
    from rich.console import Console
    from rich.table import Table

    from marsyard.sim.terrain.statistics import CONTRAST_PIXEL_M, CONTRAST_SUN_ELEVATION_DEG

    side = parameters.samples * parameters.spacing_m
    slope = "" if paper is None else _range(paper.mean_slope_deg, 0)
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    table.add_column("terrain", justify="right")
    table.add_column("field test paper, III.A")
    table.add_row("albedo", f"{measured.albedo:.2f}", "" if paper is None else _range(paper.albedo, 1))
    table.add_row("mean slope over 30 m, deg", _number(measured.mean_slope_30_m_deg, 2), slope)
    table.add_row("mean slope over 90 m, deg", _number(measured.mean_slope_90_m_deg, 2), slope)
    relief = "" if paper is None or paper.relief_m is None else f"more than {paper.relief_m[0]:.0f}"
    table.add_row("relief, m", f"{measured.relief_m:.{1 if measured.relief_m >= 10.0 else 2}f}", relief)
    table.add_row("image contrast, RMS / mean", f"{measured.contrast:.3f}", "" if paper is None else paper.contrast)
    console = Console()
    console.print(f"{site}: {side:g} m x {side:g} m, samples {parameters.spacing_m:g} m apart, seed {seed}")
    console.print(table)
    console.print(
        "Slopes are along lines to the east and north (bidirectional). Contrast is that of the terrain seen from "
        f"straight above in pixels of about {CONTRAST_PIXEL_M:g} m, Lunar-Lambert, sun "
        f"{CONTRAST_SUN_ELEVATION_DEG:g} deg high in the west, without shadows or detector."
    )
    if extent is not None:
        console.print(
            f"Real from east {extent.west_m:g} to {extent.east_m:g} m and north {extent.south_m:g} to "
            f"{extent.north_m:g} m, posts {extent.posting_m:g} m apart, synthetic around it; the figures are those of "
            f"the real part, without holes. Filled: {extent.holes} posts without height ({extent.hole_fraction:.1%}), "
            f"{extent.ortho_holes} pixels without brightness."
        )


def _range(values: tuple[float, float], digits: int) -> str:
    low, high = values
    return f"{low:.{digits}f}" if low == high else f"{low:.{digits}f}-{high:.{digits}f}"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def write_terrain_picture(path: Path, surface: Surface, real: Embedded | None) -> None:
    """Write a shaded picture of a terrain, grid north up, as PNG; of an imported one the real part and its holes.

    Raises ValueError where the file exists, or cannot be written.
    """
    import cv2
    import numpy as np

    from marsyard.sim.terrain.statistics import CONTRAST_SUN_ELEVATION_DEG, nadir_picture

    if path.suffix.lower() != ".png":
        raise ValueError(f"--picture {path}: a file that ends in .png is needed")
    if path.exists():
        raise ValueError(f"--picture {path}: exists; choose another name")
    side = surface.levels[0].shape[0]
    level = max(int(np.ceil(np.log2(side / MAX_PIXELS))), 0)
    shaded = nadir_picture(surface, level, np.radians(315.0), np.radians(CONTRAST_SUN_ELEVATION_DEG))
    grey = np.clip(255.0 * shaded / np.percentile(shaded, 99.8), 0.0, 255.0).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    if real is not None:
        step = 2**level
        holes = real.filled_samples(side)[::step, ::step]
        picture[holes] = (0.4 * picture[holes] + 0.6 * np.array(HOLE_COLOUR)).astype(np.uint8)
        south_west = real.columns.start // step, real.rows.start // step
        north_east = real.columns.stop // step, real.rows.stop // step
        cv2.rectangle(picture, south_west, north_east, OUTLINE_COLOUR, 1)
    try:
        written = cv2.imwrite(str(path), picture[::-1])
    except cv2.error as fault:
        raise ValueError(f"--picture {path}: cannot be written ({fault})") from fault
    if not written:
        raise ValueError(f"--picture {path}: cannot be written")
