"""Commands `marsyard render`, `gallery` and `dataset`: images of sites, and images of campaigns as training data."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from marsyard.cli import options
from marsyard.cli.errors import exit_with_error, handle_user_errors
from marsyard.cli.terminal import size_text

#: Name of the kernels of `marsyard render` in `marsyard.sim.kernel_cache`, next to the names of scenarios.
RENDER_KERNELS = "render"


def render(
    site: options.SiteArgument,
    camera: Annotated[
        str, Option(metavar="NAME", help="Camera, such as mer-navcam or mer-descent-flown; an unknown name lists all.")
    ],
    out: Annotated[Path, Option(metavar="PREFIX", help="Path of the files without extension.")],
    scale: Annotated[
        str | None,
        Option(
            metavar="SCALE",
            help="Terrain of the site: descent (kilometres, coarse) or ground (100 m, fine); by default that of the "
            "camera.",
        ),
    ] = None,
    altitude: Annotated[
        float | None,
        Option(metavar="M", help="Camera height above the ground; by default a typical height for the camera."),
    ] = None,
    east: Annotated[
        float | None, Option(metavar="M", help="East coordinate of the camera; by default 0, or the DTM centre.")
    ] = None,
    north: Annotated[
        float | None, Option(metavar="M", help="North coordinate of the camera; by default 0, or the DTM centre.")
    ] = None,
    azimuth: Annotated[float, Option(metavar="DEG", help="Viewing direction, clockwise from north.")] = 0.0,
    elevation: Annotated[
        float | None,
        Option(metavar="DEG", help="Elevation of the optical axis, -90 is down; by default typical for the camera."),
    ] = None,
    sun_azimuth: Annotated[float, Option(metavar="DEG", help="Sun azimuth, clockwise from north.")] = 250.0,
    sun_elevation: Annotated[float, Option(metavar="DEG", help="Sun elevation above the horizon.")] = 35.0,
    detector: Annotated[
        bool, Option("--detector/--radiance", help="Write detector counts, or the radiance factor (I/F).")
    ] = True,
    seed: Annotated[int, Option(metavar="S", min=0, help="Seed of the terrain and the noise.")] = 1,
    overwrite: options.OverwriteOption = False,
    max_holes: options.MaxHolesOption = None,
) -> None:
    """Render an image of a site or DTM.

    Writes PREFIX.png (16 bits), PREFIX.npz (ground truth), PREFIX.cahvor (camera) and PREFIX.json (values).

    A stereo camera adds -left and -right to PREFIX.
    """
    from marsyard.image_files import check_files, write_image
    from marsyard.sim.kernel_cache import mark_ready
    from marsyard.site_images import ImageRequest, render_images

    with report_image_errors(out):
        request = ImageRequest.from_defaults(
            site,
            camera,
            scale=scale,
            altitude_m=altitude,
            east_m=east,
            north_m=north,
            azimuth_deg=azimuth,
            elevation_deg=elevation,
            sun_azimuth_deg=sun_azimuth,
            sun_elevation_deg=sun_elevation,
            seed=seed,
            max_hole_fraction=max_holes,
        )
        check_files(out, camera, overwrite)
        _note_compilation()
        images = render_images(request, detector=detector, note=_print_progress)
        _print_progress("ground truth and files")
        for image in images:
            if image.filled is not None and image.filled.any():
                fraction = f"{image.filled.mean():.1%} of the pixels{image.suffix and f' ({image.suffix[1:]})'}"
                typer.echo(f"note: {fraction} show filled holes of the DTM (`filled` in the .npz)", err=True)
            typer.echo(", ".join(str(path) for path in write_image(image, request, out)))
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


@handle_user_errors
def dataset(
    campaign: options.CampaignArgument,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the shards.")],
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    shard: Annotated[int, Option(metavar="N", min=1, help="Cases per shard.")] = 50,
    jobs: Annotated[int, Option(metavar="J", min=1, help="Worker processes.")] = 1,
    override: options.SetOption = None,
) -> None:
    """Write images with range, normals, rock masks, hazard maps and poses as WebDataset shards.

    Landing campaigns have two images per case. Existing shards are not written again.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.dataset import write_dataset

    shards = write_dataset(load_campaign(campaign, override or [], cases, seed), out, shard, jobs)
    total = sum(path.stat().st_size for path in shards)
    typer.echo(f"{len(shards)} shards, {size_text(total)}: {out}")
