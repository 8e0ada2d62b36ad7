"""Command `marsyard replay`: run one case again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.timeline_exports import list_exports, write_exports

if TYPE_CHECKING:
    pass


@handle_user_errors
def replay(
    directory: options.DirectoryArgument,
    case: Annotated[int, Argument(metavar="CASE", help="Number of the case, from 0.")],
    out: Annotated[
        Path | None, Option(metavar="DIR", help="Folder of images and results; by default DIR/cases/CASE.")
    ] = None,
    save_stages: Annotated[
        bool,
        Option(
            "--save-stages",
            help="Also write each intermediate result as a file of its own to stages/ (.npy, .png or .json).",
        ),
    ] = False,
    rerun: Annotated[
        Path | None, Option(metavar="FILE", help="Also write the case in space and time for the Rerun viewer (.rrd).")
    ] = None,
    glb: Annotated[
        Path | None, Option(metavar="FILE", help="Also write ground, paths and cameras as a glTF scene (.glb).")
    ] = None,
    rosbag: Annotated[
        Path | None,
        Option(metavar="DIR", help="Also write images, poses and inertial data as a ROS 2 bag into a new folder."),
    ] = None,
    trust: options.TrustOption = False,
) -> None:
    """Run one case again, write and plot its intermediate results, and compare its row with the stored one."""
    from marsyard.campaigns.running.replay import replay as rerun_case
    from marsyard.campaigns.store.origin import adopt
    from marsyard.campaigns.store.packed_products import pack_products, replace_files, unpack_products, write_packed
    from marsyard.campaigns.store.products import case_directory
    from marsyard.campaigns.store.stages import write_stages
    from marsyard.reports.presentation import write_case_figures

    exports = list_exports(rerun, glb, rosbag)
    if trust:
        adopt(directory)
    result = rerun_case(directory, case)
    target = out if out is not None else case_directory(directory, case)
    if (result.failed or result.products is None) and (target / "products.json").exists():
        output_lines = [f"{target} keeps its previous products: this run of the case produced none"]
    else:  # replace the products, stages and figures together or not at all
        packed = result.products or pack_products({})
        products = unpack_products(packed)
        with replace_files(target) as folder:
            write_packed(folder, packed, result.row)
            stages = write_stages(folder / "stages", products) if save_stages else 0
            figures = [target / path.relative_to(folder) for path in write_case_figures(folder, products)]
        stage_lines = [f"stages: {stages} files in {target / 'stages'}"] if save_stages else []
        output_lines = [f"products: {target}", *stage_lines, *(f"figure: {figure}" for figure in figures)]
    typer.echo(f"case {case}: {result.row['outcome']}")
    for line in (result.row["error"] and (result.row["traceback"] or result.row["error"]), result.note):
        if line:
            typer.echo(line)
    typer.echo("\n".join(output_lines))
    if result.changed:
        typer.echo(f"changed since the campaign was run: {'; '.join(result.changed)}")
    if result.stored is None:
        typer.echo("the campaign has no stored row of this case to compare with")
    elif result.differing:
        typer.echo(f"the row differs from the stored one in: {', '.join(result.differing)}")
        for column in result.differing:
            typer.echo(f"  {column}: {result.stored.get(column)!r} stored, {result.row.get(column)!r} now")
    else:
        typer.echo("the row equals the stored one")
    if exports:
        write_exports(exports, {} if result.products is None else unpack_products(result.products), case)
    if result.stored is not None and result.differing:
        raise typer.Exit(Exit.FAILED)
