"""`marsyard render` and `gallery`: pictures of the sites with truth layers, camera model and inputs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from marsyard.cli.options import MaxHolesOption, OverwriteOption, SiteArgument, fail, with_options


@dataclass(frozen=True)
class RenderOptions:
    """Arguments and options of `marsyard render`."""

    site: SiteArgument
    camera: Annotated[str, Option(metavar="NAME", help="Such as mer-navcam; a wrong name lists all.")]
    out: Annotated[Path, Option(metavar="PREFIX", help="Path of the files without extension.")]
    scale: Annotated[str | None, Option(metavar="SCALE", help="descent or ground; by default the camera's.")] = None
    altitude: Annotated[float | None, Option(metavar="M", help="Height above the ground; by default the camera's.")] = (
        None
    )
    east: Annotated[float | None, Option(metavar="M", help="By default 0, or the middle of a DTM; periodic.")] = None
    north: Annotated[float | None, Option(metavar="M", help="By default 0, or the middle of a DTM; periodic.")] = None
    azimuth: Annotated[float, Option(metavar="DEG", help="Viewing direction, clockwise from north.")] = 0.0
    elevation: Annotated[float | None, Option(metavar="DEG", help="Of the optical axis; -90: down.")] = None
    sun_azimuth: Annotated[float, Option(metavar="DEG", help="Clockwise from north.")] = 250.0
    sun_elevation: Annotated[float, Option(metavar="DEG", help="Above the horizon.")] = 35.0
    detector: Annotated[bool, Option("--detector/--radiance", help="Detector counts, or radiance factor.")] = True
    seed: Annotated[int, Option(metavar="S", min=0, help="Of the terrain and the noise.")] = 1
    overwrite: OverwriteOption = False
    max_holes: MaxHolesOption = None


@with_options(RenderOptions)
def render(given: RenderOptions) -> None:
    """Render a site or DTM: PREFIX.png (16 bits), .npz (truth), .cahvor (camera), .json; -left, -right of a pair."""
    from marsyard.cli.pictures import Shot, check_files, take, write

    with report_picture_errors(given.out):
        settings = {"scale": given.scale, "seed": given.seed, "max_hole_fraction": given.max_holes}
        settings |= {f"{name}_m": getattr(given, name) for name in ("altitude", "east", "north")}
        angles = ("azimuth", "elevation", "sun_azimuth", "sun_elevation")
        settings |= {f"{name}_deg": getattr(given, name) for name in angles}
        shot = Shot.usual(given.site, given.camera, **settings)
        check_files(given.out, given.camera, given.overwrite)
        for picture in take(shot, detector=given.detector):
            if picture.filled is not None and picture.filled.any():
                part = f"{picture.filled.mean():.1%} of the pixels{picture.suffix and f' ({picture.suffix[1:]})'}"
                typer.echo(f"note: {part} see filled holes of the DTM (`filled` in the .npz)", err=True)
            typer.echo(", ".join(str(path) for path in write(picture, shot, given.out)))


@contextmanager
def report_picture_errors(out: Path) -> Iterator[None]:
    """End the command with status 2 where pictures cannot be rendered or written."""
    from marsyard.sim.render.backend import RenderingError

    try:
        yield
    except (ValueError, RenderingError) as error:
        fail(error)
    except OSError as error:
        fail(f"cannot write to {out}: {error}")


def gallery(
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the page and pictures.")] = Path("gallery"),
    overwrite: OverwriteOption = False,
) -> None:
    """Render every site through the cameras that fit it: one page, and a contact sheet. Takes about a minute."""
    from marsyard.cli.gallery import render_gallery

    with report_picture_errors(out):
        typer.echo(render_gallery(out, overwrite))
