"""`marsyard terrain`: the sites, and figures of their terrain beside what the field test paper says of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sim.terrain.embedding import RealExtent
    from sim.terrain.parameters import TerrainParameters
    from sim.terrain.sites import PaperFigures
    from sim.terrain.statistics import TerrainStatistics

#: Exit status where the command or a file is wrong, as elsewhere.
WRONG = 2

app = typer.Typer(no_args_is_help=True, help="Sites and the figures of their terrain.")


@app.command(name="list")
def list_sites(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """List the sites."""
    import json

    from rich.console import Console
    from rich.table import Table

    from sim.terrain.sites import sites

    if as_json:
        told = [
            {
                "name": one.name,
                "planet": one.environment.planet,
                "terrain": [scale for scale in ("descent", "ground") if getattr(one, scale) is not None],
                "description": one.description,
            }
            for one in sites().values()
        ]
        typer.echo(json.dumps(told, indent=2))
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
    site: Annotated[
        str, typer.Argument(metavar="SITE", help="A site from `marsyard terrain list`, or a DTM: .tif or .npz.")
    ],
    scale: Annotated[
        str | None, typer.Option("--scale", metavar="SCALE", help="descent or ground; by default the site's coarser.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="S", min=0, help="Seed of the terrain.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print albedo, slopes, relief and image contrast of a site's terrain beside the paper's figures."""
    import json

    import numpy as np

    from sim.terrain.embedding import embed
    from sim.terrain.sites import PAPER
    from sim.terrain.statistics import terrain_statistics
    from sim.terrain.synthesis import synthesise

    try:
        parameters = _terrain(site, scale)
        source = parameters.source
        extent = None if source is None else embed(source, parameters.samples, parameters.spacing_m).extent
        surface = synthesise(parameters, np.random.default_rng(seed))
    except ValueError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(WRONG) from None
    area = None if extent is None else (extent.west_m, extent.south_m, extent.east_m, extent.north_m)
    measured = terrain_statistics(surface, area)
    if as_json:
        typer.echo(json.dumps(_record(site, parameters, seed, measured, PAPER.get(site), extent), indent=2))
    else:
        _print(site, parameters, seed, measured, PAPER.get(site), extent)


def _terrain(site: str, scale: str | None) -> TerrainParameters:
    """Parameters of a site's terrain, or of one around a file. Raises ValueError."""
    from pathlib import Path

    from scenarios.terrain_files import check_source
    from sim.terrain.embedding import grid_for
    from sim.terrain.imported import RealTerrain
    from sim.terrain.parameters import TerrainParameters
    from sim.terrain.sites import site as preset

    if Path(site).suffix.lower() in (".npz", ".tif", ".tiff"):
        source = RealTerrain(dtm=Path(site))
        check_source(source)
        samples, spacing_m = grid_for(source)
        return TerrainParameters(samples=samples, spacing_m=spacing_m, craters_per_km2=0.0, source=source)
    return preset(site).terrain(scale)


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

    from sim.terrain.statistics import CONTRAST_PIXEL_M, CONTRAST_SUN_ELEVATION_DEG

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
    table.add_row("relief, m", f"{measured.relief_m:.{0 if measured.relief_m >= 10.0 else 2}f}", relief)
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
            f"the real part. Filled: {extent.holes} posts without height, {extent.ortho_holes} pixels without "
            "brightness."
        )


def _range(values: tuple[float, float], digits: int) -> str:
    low, high = values
    return f"{low:.{digits}f}" if low == high else f"{low:.{digits}f}-{high:.{digits}f}"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
