"""Commands `marsyard render` and `gallery`: images of sites."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from marsyard.cli import options
from marsyard.cli.errors import exit_with_error
from marsyard.cli.option_classes import with_options

#: Name of the kernels of `marsyard render` in `marsyard.sim.kernel_cache`, next to the names of scenarios.
RENDER_KERNELS = "render"


@dataclass(frozen=True)
class RenderOptions:
    """Arguments and options of `marsyard render`."""

    site: options.SiteArgument
    camera: Annotated[
        str, Option(metavar="NAME", help="Camera, such as mer-navcam or mer-descent-flown; an unknown name lists all.")
    ]
    out: Annotated[Path, Option(metavar="PREFIX", help="Path of the files without extension.")]
    scale: Annotated[
        str | None,
        Option(
            metavar="SCALE",
            help="Terrain of the site: descent (kilometres, coarse) or ground (100 m, fine); by default that of the "
            "camera.",
        ),
    ] = None
    altitude: Annotated[
        float | None,
        Option(metavar="M", help="Camera height above the ground; by default a typical height for the camera."),
    ] = None
    east: Annotated[
        float | None, Option(metavar="M", help="East coordinate of the camera; by default 0, or the DTM centre.")
    ] = None
    north: Annotated[
        float | None, Option(metavar="M", help="North coordinate of the camera; by default 0, or the DTM centre.")
    ] = None
    azimuth: Annotated[float, Option(metavar="DEG", help="Viewing direction, clockwise from north.")] = 0.0
    elevation: Annotated[
        float | None,
        Option(metavar="DEG", help="Elevation of the optical axis, -90 is down; by default typical for the camera."),
    ] = None
    sun_azimuth: Annotated[float, Option(metavar="DEG", help="Sun azimuth, clockwise from north.")] = 250.0
    sun_elevation: Annotated[float, Option(metavar="DEG", help="Sun elevation above the horizon.")] = 35.0
    detector: Annotated[
        bool, Option("--detector/--radiance", help="Write detector counts, or the radiance factor (I/F).")
    ] = True
    seed: Annotated[int, Option(metavar="S", min=0, help="Seed of the terrain and the noise.")] = 1
    overwrite: options.OverwriteOption = False
    max_holes: options.MaxHolesOption = None


@with_options(RenderOptions)
def render(arguments: RenderOptions) -> None:
    """Render an image of a site or DTM.

    Writes PREFIX.png (16 bits), PREFIX.npz (ground truth), PREFIX.cahvor (camera) and PREFIX.json (values).

    A stereo camera adds -left and -right to PREFIX.
    """
    from marsyard.image_files import check_files, write_image
    from marsyard.image_request import ImageRequest
    from marsyard.sim.kernel_cache import mark_ready
    from marsyard.site_images import render_images

    with report_image_errors(arguments.out):
        values = {"scale": arguments.scale, "seed": arguments.seed, "max_hole_fraction": arguments.max_holes}
        values |= {f"{name}_m": getattr(arguments, name) for name in ("altitude", "east", "north")}
        angles = ("azimuth", "elevation", "sun_azimuth", "sun_elevation")
        values |= {f"{name}_deg": getattr(arguments, name) for name in angles}
        request = ImageRequest.from_defaults(arguments.site, arguments.camera, **values)
        check_files(arguments.out, arguments.camera, arguments.overwrite)
        _note_compilation()
        images = render_images(request, detector=arguments.detector, note=_print_progress)
        _print_progress("ground truth and files")
        for image in images:
            if image.filled is not None and image.filled.any():
                fraction = f"{image.filled.mean():.1%} of the pixels{image.suffix and f' ({image.suffix[1:]})'}"
                typer.echo(f"note: {fraction} show filled holes of the DTM (`filled` in the .npz)", err=True)
            typer.echo(", ".join(str(path) for path in write_image(image, request, arguments.out)))
        mark_ready(RENDER_KERNELS)


def _print_progress(text: str) -> None:
    typer.echo(text, err=True)


def _note_compilation() -> None:
    """Print that the kernels are compiled first, unless this machine has rendered an image or a scenario before."""
    from marsyard.campaigns.running.compilation import COMPILATION_NOTE
    from marsyard.scenarios.systems import scenario_paths
    from marsyard.sim.kernel_cache import kernels_are_ready

    if not any(kernels_are_ready(name) for name in (RENDER_KERNELS, *scenario_paths())):
        _print_progress(f"note: {COMPILATION_NOTE}")


@contextmanager
def report_image_errors(out: Path) -> Iterator[None]:
    """Print an error and end the command with status 2 if images cannot be rendered or written."""
    from marsyard.sim.render.backend import RenderingError

    try:
        yield
    except (ValueError, RenderingError) as error:
        exit_with_error(error)
    except OSError as error:
        exit_with_error(f"cannot write to {out}: {error}")


def gallery(
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the page and images.")] = Path("gallery"),
    terrain: Annotated[
        list[Path] | None,
        Option("--terrain", metavar="FILE", help="Also show this DTM, seen by a descent camera. Can be repeated."),
    ] = None,
    overwrite: options.OverwriteOption = False,
) -> None:
    """Render each site with suitable cameras; write one page and a contact sheet. Takes about a minute."""
    from marsyard.site_gallery import render_gallery

    _note_compilation()
    with report_image_errors(out):
        typer.echo(render_gallery(out, overwrite, terrain or ()))
