"""Commands `marsyard terrain list` and `terrain stats`: the sites, and the statistics of their terrain."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from marsyard.cli.errors import exit_with_error
from marsyard.cli.options import JsonOption, MaxHolesOption, SiteArgument
from marsyard.cli.terminal import create_console

if TYPE_CHECKING:
    from marsyard.sim.terrain import Surface
    from marsyard.sim.terrain.imported import EmbeddedDtm, RealExtent
    from marsyard.sim.terrain.parameters import TerrainParameters
    from marsyard.sim.terrain.statistics import TerrainStatistics

#: Nadir image: maximum side length, pixels; percentile of the brightness that becomes white; colours (blue, green, red)
#: of filled holes and of the outline of a DTM; opacity of the colour of holes.
MAX_SIDE_PX, WHITE_PERCENTILE = 2048, 99.8
HOLE_COLOUR, OUTLINE_COLOUR, HOLE_OPACITY = (40, 40, 220), (0, 200, 255), 0.6

app = typer.Typer(no_args_is_help=True, help="List sites and print statistics of their terrain.")


@app.command(name="list")
def list_sites(as_json: JsonOption = False) -> None:
    """List the sites."""
    from rich.table import Table

    from marsyard.sim.terrain.sites import sites

    rows, table = [], Table(box=None, pad_edge=False)
    for heading in ("site", "planet", "terrain", "description"):
        table.add_column(heading)
    for site in sites().values():
        planet = site.environment.planet
        scales = [name for name in ("descent", "ground") if getattr(site, name) is not None]
        rows.append({"name": site.name, "planet": planet, "terrain": scales, "description": site.description})
        table.add_row(site.name, planet, ", ".join(scales), site.description)
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        create_console().print(table)


@app.command()
def stats(
    site: SiteArgument,
    scale: Annotated[
        str | None,
        Option(
            metavar="SCALE",
            help="`descent` (kilometres) or `ground` (a hundred metres); by default `descent`, if the site has it.",
        ),
    ] = None,
    seed: Annotated[int, Option(metavar="S", min=0, help="Seed of the terrain.")] = 1,
    as_json: JsonOption = False,
    max_holes: MaxHolesOption = None,
    image: Annotated[Path | None, Option(metavar="PNG", help="Write a nadir image; filled holes are red.")] = None,
) -> None:
    """Print albedo, slopes, relief and image contrast of a terrain.

    For a site of the DIMES field test paper (Johnson, Willson et al.), its published values follow for comparison.
    """
    import numpy as np

    from marsyard.scenarios.terrain_files import MAX_HOLE_FRACTION, grid_north_deg, load_site
    from marsyard.sim.terrain.imported import embed
    from marsyard.sim.terrain.statistics import PUBLISHED_SITES, terrain_statistics
    from marsyard.sim.terrain.synthesis import synthesise

    try:
        definition = load_site(site, MAX_HOLE_FRACTION if max_holes is None else max_holes)
        parameters = definition.terrain(scale)
        source = parameters.source
        dtm = None if source is None else embed(source, parameters.samples, parameters.spacing_m)
        grid_north = None if source is None else grid_north_deg(source.dtm)
        surface = synthesise(parameters, np.random.default_rng(seed))
        if image is not None:
            _write_image(image, surface, dtm)
    except ValueError as error:
        exit_with_error(error)
    statistics = terrain_statistics(surface, None if dtm is None else dtm.real_samples(parameters.samples))
    extent = None if dtm is None else dtm.extent
    if not as_json:
        _print_statistics(site, parameters, seed, statistics, extent, grid_north)
        return
    paper = PUBLISHED_SITES.get(site)
    published: dict[str, Any] | None = None
    if paper is not None:
        published = {"albedo": paper.albedo, "mean_slope_deg": paper.mean_slope_deg}
        published |= {"relief_at_least_m": paper.relief_m and paper.relief_m[0], "contrast": paper.contrast}
    record = {
        "site": site,
        "side_m": parameters.samples * parameters.spacing_m,
        "spacing_m": parameters.spacing_m,
        "seed": seed,
        "measured": {key: value if math.isfinite(value) else None for key, value in asdict(statistics).items()},
        "paper": published,
        "real": None if extent is None else asdict(extent),
        "grid_north_deg": grid_north,
    }
    typer.echo(json.dumps(record, indent=2))


def _write_image(path: Path, surface: Surface, dtm: EmbeddedDtm | None) -> None:
    """Write a shaded nadir image of a terrain as PNG, grid north up; mark a DTM's outline and filled holes.

    Raises ValueError if the file exists or cannot be written.
    """
    import cv2
    import numpy as np

    from marsyard.sim.terrain.statistics import CONTRAST_SUN_ELEVATION_DEG, render_nadir_image

    if path.suffix.lower() != ".png":
        raise ValueError(f"--image {path}: the file name must end in .png")
    if path.exists():
        raise ValueError(f"--image {path}: exists; choose another name")
    side = len(surface.levels[0])
    level = max(int(np.ceil(np.log2(side / MAX_SIDE_PX))), 0)
    # light from the north-west, as usual for shaded relief
    shaded = render_nadir_image(surface, level, np.radians(315.0), np.radians(CONTRAST_SUN_ELEVATION_DEG))
    grey = np.clip(255.0 * shaded / np.percentile(shaded, WHITE_PERCENTILE), 0.0, 255.0).astype(np.uint8)
    image = np.repeat(grey[..., None], 3, axis=2)
    if dtm is not None:
        step = 2**level
        holes = dtm.filled_samples(side)[::step, ::step]
        coloured = (1.0 - HOLE_OPACITY) * image[holes] + HOLE_OPACITY * np.array(HOLE_COLOUR)
        image[holes] = coloured.astype(np.uint8)
        south_west = dtm.columns.start // step, dtm.rows.start // step
        north_east = dtm.columns.stop // step, dtm.rows.stop // step
        cv2.rectangle(image, south_west, north_east, OUTLINE_COLOUR, 1)
    try:
        is_written = cv2.imwrite(str(path), image[::-1])
    except cv2.error as error:
        raise ValueError(f"--image {path}: cannot be written ({error})") from error
    if not is_written:
        raise ValueError(f"--image {path}: cannot be written")


def _print_statistics(
    site: str,
    parameters: TerrainParameters,
    seed: int,
    statistics: TerrainStatistics,
    extent: RealExtent | None,
    grid_north: float | None,
) -> None:
    from rich.table import Table

    from marsyard.sim.terrain.statistics import CONTRAST_PIXEL_M, CONTRAST_SUN_ELEVATION_DEG, PUBLISHED_SITES

    side_m, paper = parameters.samples * parameters.spacing_m, PUBLISHED_SITES.get(site)
    albedo, slope, relief, contrast = "", "", "", ""
    if paper is not None:
        albedo, slope, contrast = _format_range(paper.albedo, 1), _format_range(paper.mean_slope_deg, 0), paper.contrast
        relief = "" if paper.relief_m is None else f"more than {paper.relief_m[0]:.0f}"
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    table.add_column("terrain", justify="right")
    table.add_column("field test paper, III.A")
    table.add_row("albedo", f"{statistics.albedo:.2f}", albedo)
    for length_m, value in ((30, statistics.mean_slope_30_m_deg), (90, statistics.mean_slope_90_m_deg)):
        table.add_row(f"mean slope over {length_m} m, deg", "-" if math.isnan(value) else f"{value:.2f}", slope)
    table.add_row("relief, m", f"{statistics.relief_m:.{1 if statistics.relief_m >= 10.0 else 2}f}", relief)
    table.add_row("image contrast, RMS / mean", f"{statistics.contrast:.3f}", contrast)
    terminal = create_console()
    terminal.print(f"{site}: {side_m:g} m x {side_m:g} m, sample spacing {parameters.spacing_m:g} m, seed {seed}")
    terminal.print(table)
    terminal.print(
        "Slopes are measured along lines to the east and to the north (bidirectional). Contrast is computed for a "
        f"nadir image with pixels of about {CONTRAST_PIXEL_M:g} m, Lunar-Lambert reflection, sun in the west at "
        f"{CONTRAST_SUN_ELEVATION_DEG:g} deg elevation, without shadows and without detector."
    )
    if extent is not None:
        terminal.print(
            f"The DTM covers east {extent.west_m:g} to {extent.east_m:g} m and north {extent.south_m:g} to "
            f"{extent.north_m:g} m with posts every {extent.posting_m:g} m; the terrain around it is synthetic. The "
            f"statistics use the DTM without its holes. Filled: {extent.holes} posts without height "
            f"({extent.hole_fraction:.1%}), {extent.ortho_holes} orthoimage pixels without brightness."
        )
    if grid_north is not None:
        direction, sign = ("east", "-") if grid_north >= 0.0 else ("west", "+")
        angle = f"{abs(grid_north):.2f} deg"
        terminal.print(
            f"Grid north (the y axis) points {angle} {direction} of true north at the centre of the file. All azimuths "
            "are relative to grid north, including that of the sun: azimuth from grid north = azimuth from true north "
            f"{sign} {angle}."
        )


def _format_range(values: tuple[float, float], digits: int) -> str:
    low, high = values
    return f"{low:.{digits}f}" if low == high else f"{low:.{digits}f}-{high:.{digits}f}"
