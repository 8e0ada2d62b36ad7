"""Exports of a case in space and time (`marsyard replay --rerun`, `--glb`, `--rosbag`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from marsyard.scenarios.timeline import Timeline


@dataclass(frozen=True)
class TimelineExport:
    """An export of a timeline: option, target, and function that writes it; `name` is the title of the recording."""

    option: str
    target: Path
    write: Callable[[Path, Timeline, str], None]


def list_exports(rerun: Path | None, glb: Path | None, rosbag: Path | None) -> list[TimelineExport]:
    """Check the options of exports before the case runs. Raises CampaignError for a missing package or a wrong path."""
    from marsyard.campaigns.errors import CampaignError

    exports = []
    for option, target, package, suffix, write in (
        ("--rerun", rerun, "rerun", ".rrd", _write_rerun),
        ("--glb", glb, "trimesh", ".glb", _write_glb),
        ("--rosbag", rosbag, "rosbags", "", _write_ros_bag),
    ):
        if target is None:
            continue
        if suffix and target.suffix != suffix:
            raise CampaignError(f"{option} {target}: allowed: a file with the suffix {suffix}")
        if not suffix and target.exists():
            raise CampaignError(f"{option} {target} exists; allowed: a new folder")
        if not target.parent.is_dir():
            raise CampaignError(f"{option} {target}: the folder {target.parent} does not exist")
        if find_spec(package) is None:
            raise CampaignError(f"{option} needs the package {package}: pip install 'marsyard[view]'")
        exports.append(TimelineExport(option, target, write))
    return exports


def write_exports(exports: list[TimelineExport], products: Mapping[str, Any], case: int) -> None:
    """Write the timeline of a case. Raises CampaignError without one, and StoreError if a file cannot be written."""
    from marsyard.campaigns.errors import CampaignError, report_write_errors
    from marsyard.scenarios.timeline import PRODUCT, Timeline

    timeline = Timeline.from_products(products)
    if timeline is None:
        names = ", ".join(export.option for export in exports)
        reason = products.get(PRODUCT, "its scenario records none, or the case did not finish")
        raise CampaignError(f"{names}: case {case} has no timeline: {reason}")
    for export in exports:
        with report_write_errors(export.target):
            export.write(export.target, timeline, f"case {case}")
        typer.echo(f"{export.option.removeprefix('--')}: {export.target}")


def _write_rerun(target: Path, timeline: Timeline, name: str) -> None:
    from marsyard.reports.timeline.rerun_file import write_rerun

    write_rerun(target, timeline, name)


def _write_glb(target: Path, timeline: Timeline, _name: str) -> None:
    from marsyard.reports.timeline.glb import write_glb

    write_glb(target, timeline)


def _write_ros_bag(target: Path, timeline: Timeline, _name: str) -> None:
    from marsyard.reports.timeline.ros_bag import write_ros_bag

    write_ros_bag(target, timeline)
