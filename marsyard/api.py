"""What a notebook needs: campaigns, cases, views, algorithms and results, in a dozen names. See docs/examples/.

import marsyard

campaign = marsyard.load_campaign("dimes-smoke", {"terrain.samples": 1024})
marsyard.draw(campaign, 3)                      # what case 3 draws
marsyard.run_case(campaign, 3).row              # runs it, here
folder = marsyard.run_campaign(campaign, "runs/mine", jobs=2)
marsyard.results(folder)                        # its rows, a pandas frame
marsyard.verdicts(folder)                       # its requirements, judged
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marsyard.campaigns.definition import catalogue as shipped
from marsyard.campaigns.definition import loading
from marsyard.campaigns.definition.campaign import Campaign as Campaign
from marsyard.scenarios.interface import CaseResult as CaseResult
from marsyard.sim.camera import CameraModel as CameraModel
from marsyard.sim.camera import read_camera as read_camera
from marsyard.sim.camera import read_cameras as read_cameras

if TYPE_CHECKING:
    import pandas as pd

    from marsyard.cli.render import Picture
    from marsyard.reports.verdicts import Verdict


def catalogue() -> list[str]:
    """Names of the campaigns that ship with Marsyard."""
    return list(shipped.catalogue())


def sites() -> dict[str, str]:
    """What each site is, by its name."""
    from marsyard.sim.terrain import sites as known

    return {name: one.description for name, one in known().items()}


def load_campaign(
    name_or_path: str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    cases: int | None = None,
    seed: int | None = None,
    algorithms: Sequence[str] = (),
) -> Campaign:
    """A campaign of the catalogue, or of a TOML file, checked whole.

    Parameters
    ----------
    name_or_path
        A name of `catalogue`, or the path of a file.
    changes
        Parameters by their dotted paths, instead of the file's; one that is set so is not dispersed.
    cases, seed
        Instead of the file's.
    algorithms
        Instead of the file's: the one that is judged, then those that are compared with it.

    Raises
    ------
    marsyard.campaigns.errors.CampaignError
        Where there is none, or something in it is wrong; the message says what, where and what is allowed.
    """
    stated = [f"{path}={_toml(value)}" for path, value in (changes or {}).items()]
    return loading.load_campaign(str(name_or_path), stated, cases, seed, algorithms)


def draw(campaign: Campaign, case: int) -> dict[str, Any]:
    """What each dispersion draws for a case, by the path of its parameter."""
    return campaign.draws(case)


def draws(campaign: Campaign, cases: int) -> pd.DataFrame:
    """What the first cases draw: a row each."""
    import pandas as pd

    return pd.DataFrame([campaign.draws(case) for case in range(cases)]).rename_axis("case")


def run_case(campaign: Campaign, case: int) -> CaseResult:
    """Runs one case in this process: its outcome, its row, and its pictures and intermediate results (`products`).

    The row is that which `run_campaign` stores for it. A terrain that is not on the disk is built first.
    """
    return campaign.scenario.run(campaign.parameters(case), campaign.streams(case))


def run_campaign(campaign: Campaign, directory: str | Path, *, jobs: int = 1) -> Path:
    """Runs a whole campaign into a new folder, with its report, and returns the folder.

    Raises
    ------
    marsyard.campaigns.errors.CampaignError
        Where the folder is there already, or cannot be written.
    """
    from rich.console import Console

    from marsyard.campaigns.execution.crew import Crew
    from marsyard.campaigns.running.engine import run_campaign as run
    from marsyard.cli.outcome import settle
    from marsyard.cli.progress import campaign_progress
    from marsyard.cli.run_log import RunLog

    folder = Path(directory)
    with campaign_progress(Console(stderr=True)) as progress, RunLog(folder, progress) as log:
        run(campaign, folder, Crew(jobs), log)
    settle(folder)
    return folder


def results(directory: str | Path) -> pd.DataFrame:
    """The rows of a campaign that was run: one for each case, with its outcome, errors and what it drew."""
    from marsyard.campaigns.store.table import refresh_table
    from marsyard.cli.outcome import read_frame

    refresh_table(Path(directory))
    return read_frame(Path(directory))


def verdicts(directory: str | Path) -> Sequence[Verdict]:
    """The requirements of a campaign that was run, judged on its rows."""
    from marsyard.campaigns.store.table import refresh_table
    from marsyard.reports.evaluation import judged

    refresh_table(Path(directory))
    return judged(Path(directory)).verdicts


def score(campaign: Campaign, rows: Sequence[CaseResult], metric: str) -> pd.Series[Any]:
    """One column of the rows of cases that were run, NaN where a case has none."""
    import pandas as pd

    return pd.Series([one.row.get(metric, float("nan")) for one in rows], name=metric).rename_axis("case")


def render_view(site: str, camera: str = "mer-navcam", *, detector: bool = True, **shot: Any) -> list[Picture]:
    """What a camera sees of a site: the picture, or the left and the right one of a pair.

    Parameters
    ----------
    site, camera
        Names, as of `sites` and `marsyard render`; for the site also the path of a DTM (.tif, .npz).
    detector
        Whether to expose a detector; without, a picture has its radiance alone (`Picture.frame`).
    **shot
        As `marsyard render` takes them: scale, altitude_m, east_m, north_m, azimuth_deg, elevation_deg,
        sun_azimuth_deg, sun_elevation_deg, seed, max_hole_fraction.

    Raises
    ------
    ValueError
        For a name that is not known, or a value that cannot be.
    """
    from marsyard.cli.render import Shot, take

    return take(Shot.usual(site, camera, **shot), detector=detector)


def _toml(value: Any) -> str:
    """A value in TOML's notation, of which JSON's scalars and lists are part."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(str(key))} = {_toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(inner) for inner in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(str(value)) if isinstance(value, str | Path) else repr(value)
