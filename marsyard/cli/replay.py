"""Command `marsyard replay`: run one case again, and export it in space and time."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import Exit, handle_user_errors

#: Required package, and suffix of the file (a folder without one), of each option that exports a case.
_EXPORTS = {"--rerun": ("rerun", ".rrd"), "--glb": ("trimesh", ".glb"), "--rosbag": ("rosbags", "")}


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
    from marsyard.campaigns.store.products import (
        case_directory,
        pack_products,
        replace_files,
        unpack_products,
        write_packed,
        write_stages,
    )
    from marsyard.reports.presentation import write_case_figures

    exports = _check_exports({"--rerun": rerun, "--glb": glb, "--rosbag": rosbag})
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
    error_text = result.row["error"] and (result.row["traceback"] or result.row["error"])
    for line in (error_text, result.note):
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
        _write_exports(exports, {} if result.products is None else unpack_products(result.products), case)
    if result.stored is not None and result.differing:
        raise typer.Exit(Exit.FAILED)


def _check_exports(targets: Mapping[str, Path | None]) -> dict[str, Path]:
    """Return the files of the requested exports by option, before the case runs.

    Raises CampaignError for a missing package or an unsuitable path.
    """
    from marsyard.campaigns.errors import CampaignError

    exports = {option: target for option, target in targets.items() if target is not None}
    for option, target in exports.items():
        package, suffix = _EXPORTS[option]
        if suffix and target.suffix != suffix:
            raise CampaignError(f"{option} {target}: allowed: a file with the suffix {suffix}")
        if not suffix and target.exists():
            raise CampaignError(f"{option} {target} exists; allowed: a new folder")
        if not target.parent.is_dir():
            raise CampaignError(f"{option} {target}: the folder {target.parent} does not exist")
        if find_spec(package) is None:
            raise CampaignError(f"{option} needs the package {package}: pip install 'marsyard[view]'")
    return exports


def _write_exports(exports: Mapping[str, Path], products: Mapping[str, Any], case: int) -> None:
    """Write the timeline of a case. Raises CampaignError without one, and StoreError if a file cannot be written."""
    from marsyard.campaigns.errors import CampaignError, report_write_errors
    from marsyard.scenarios.timeline import PRODUCT, Timeline

    timeline = Timeline.from_products(products)
    if timeline is None:
        reason = products.get(PRODUCT, "its scenario records none, or the case did not finish")
        raise CampaignError(f"{', '.join(exports)}: case {case} has no timeline: {reason}")
    for option, target in exports.items():
        with report_write_errors(target):
            if option == "--rerun":
                from marsyard.reports.timeline.rerun_file import write_rerun

                write_rerun(target, timeline, f"case {case}")
            elif option == "--glb":
                from marsyard.reports.timeline.glb import write_glb

                write_glb(target, timeline)
            else:
                from marsyard.reports.timeline.ros_bag import write_ros_bag

                write_ros_bag(target, timeline)
        typer.echo(f"{option.removeprefix('--')}: {target}")
