"""The Python API for notebooks: campaigns, cases, views and results. See docs/examples/.

import marsyard

campaign = marsyard.load_campaign("dimes-smoke", {"terrain.samples": 1024})
marsyard.draw(campaign, 3)                      # the draws of case 3
marsyard.run_case(campaign, 3).row              # runs the case in this process
folder = marsyard.run_campaign(campaign, "runs/mine", jobs=2)
marsyard.results(folder)                        # its rows, a pandas frame
marsyard.verdicts(folder)                       # the verdicts on its requirements
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marsyard.campaigns.definition import loading
from marsyard.campaigns.definition import loading as shipped
from marsyard.campaigns.definition.campaign import Campaign as Campaign
from marsyard.scenarios.interface import CaseResult as CaseResult
from marsyard.sim.camera import CameraModel as CameraModel
from marsyard.sim.camera import read_camera as read_camera
from marsyard.sim.camera import read_cameras as read_cameras

if TYPE_CHECKING:
    import pandas as pd

    from marsyard.cli.pictures import Picture
    from marsyard.reports.verdicts import Verdict


def catalogue() -> list[str]:
    """Return the names of the campaigns that ship with Marsyard."""
    return list(shipped.catalogue())


def sites() -> dict[str, str]:
    """Return the descriptions of the sites by name."""
    from marsyard.sim.terrain import sites as presets

    return {name: one.description for name, one in presets().items()}


def load_campaign(
    name_or_path: str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    cases: int | None = None,
    seed: int | None = None,
    algorithms: Sequence[str] = (),
) -> Campaign:
    """Load and validate a campaign. Raises `marsyard.campaigns.errors.CampaignError`.

    - name_or_path: a name of `catalogue`, or the path of a TOML file
    - changes: parameters by dotted path that replace the file's; they are not dispersed
    - cases, seed: replace the file's
    - algorithms: replace the file's: the algorithm under test, then the compared ones
    """
    overrides = [f"{path}={_toml(value)}" for path, value in (changes or {}).items()]
    return loading.load_campaign(str(name_or_path), overrides, cases, seed, algorithms)


def draw(campaign: Campaign, case: int) -> dict[str, Any]:
    """Return the draws of a case by the path of the dispersed parameter."""
    return campaign.draws(case)


def draws(campaign: Campaign, cases: int) -> pd.DataFrame:
    """Return the draws of the first cases, one row per case."""
    import pandas as pd

    return pd.DataFrame([campaign.draws(case) for case in range(cases)]).rename_axis("case")


def run_case(campaign: Campaign, case: int) -> CaseResult:
    """Run one case in this process; return its outcome, row, and pictures and intermediate results (`products`).

    The row equals the one that `run_campaign` stores. A terrain that is not on the disk is built first.
    """
    return campaign.scenario.run(campaign.parameters(case), campaign.streams(case))


def run_campaign(campaign: Campaign, directory: str | Path, *, jobs: int = 1) -> Path:
    """Run a whole campaign into a new folder, write its report, and return the folder.

    Raises `marsyard.campaigns.errors.CampaignError` where the folder exists or cannot be written.
    """
    from rich.console import Console

    from marsyard.campaigns.execution.workers import ExecutorConfig
    from marsyard.campaigns.running.engine import run_campaign as run
    from marsyard.cli.outcome import settle
    from marsyard.cli.progress import RunLog, campaign_progress

    folder = Path(directory)
    with campaign_progress(Console(stderr=True)) as progress, RunLog(folder, progress) as log:
        run(campaign, folder, ExecutorConfig(jobs), log)
    settle(folder)
    return folder


def results(directory: str | Path) -> pd.DataFrame:
    """Return the rows of a finished campaign: outcome, errors and draws, one row per case."""
    from marsyard.campaigns.store.table import refresh_table
    from marsyard.cli.outcome import read_frame

    refresh_table(Path(directory))
    return read_frame(Path(directory))


def verdicts(directory: str | Path) -> Sequence[Verdict]:
    """Evaluate the requirements of a finished campaign."""
    from marsyard.campaigns.store.table import refresh_table
    from marsyard.reports.evaluation import evaluate_run

    refresh_table(Path(directory))
    return evaluate_run(Path(directory)).verdicts


def score(campaign: Campaign, rows: Sequence[CaseResult], metric: str) -> pd.Series[Any]:
    """Return one column of the rows of finished cases; NaN where a case does not have it."""
    import pandas as pd

    return pd.Series([one.row.get(metric, float("nan")) for one in rows], name=metric).rename_axis("case")


def render_view(site: str, camera: str = "mer-navcam", *, detector: bool = True, **shot: Any) -> list[Picture]:
    """Render a camera's view of a site: one picture, or the left and right one of a pair. Raises ValueError.

    - site, camera: names as in `sites` and `marsyard render`; for the site also the path of a DTM (.tif, .npz)
    - detector: whether to expose a detector; otherwise a picture has its radiance alone (`Picture.frame`)
    - shot: options of `marsyard render`: scale, altitude_m, east_m, north_m, azimuth_deg, elevation_deg,
      sun_azimuth_deg, sun_elevation_deg, seed, max_hole_fraction
    """
    from marsyard.cli.pictures import Shot, take

    return take(Shot.usual(site, camera, **shot), detector=detector)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(str(key))} = {_toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(inner) for inner in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(str(value)) if isinstance(value, str | Path) else repr(value)
