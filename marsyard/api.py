"""The Python API for notebooks: load and run campaigns and cases, render images, read results.

Example (more in docs/examples/)::

    import marsyard

    result = marsyard.run("dimes-smoke", algorithm=MyEstimator(), compare=["dimes"])
    result.verdicts                                 # one row per requirement, a pandas data frame
    result.cases                                    # one row per case
    result.failures("DIMES-VEL")                    # the violations, the worst first
    result.case(3).replay().figures()               # run a case again and draw its figures

    campaign = marsyard.load_campaign("dimes-smoke", {"terrain.samples": 1024})
    marsyard.draw(campaign, 3)                      # the randomly drawn parameter values of case 3
    marsyard.run_case(campaign, 3).row              # run the case in this process
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marsyard.campaigns.definition import loading
from marsyard.campaigns.definition.campaign import Campaign as Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.scenarios import systems
from marsyard.scenarios.interface import CaseResult as CaseResult
from marsyard.sim.camera import CameraModel as CameraModel
from marsyard.sim.camera import read_camera as read_camera
from marsyard.sim.camera import read_cameras as read_cameras

if TYPE_CHECKING:
    import pandas as pd

    from marsyard.reports.verdicts import Verdict
    from marsyard.result import Result
    from marsyard.site_images import RenderedImage


def catalogue() -> list[str]:
    """Return the names of the built-in campaigns."""
    return list(systems.catalogue())


def sites() -> dict[str, str]:
    """Return the descriptions of the built-in sites by name."""
    from marsyard.sim.terrain import sites as presets

    return {name: site.description for name, site in presets().items()}


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
    - changes: values by dotted parameter path that override the file; these parameters are not dispersed
    - cases, seed: number of cases and root seed, which override the file
    - algorithms: algorithms, which override the file: first the algorithm under test, then those for comparison
    """
    overrides = [f"{path}={_format_toml(value)}" for path, value in (changes or {}).items()]
    return loading.load_campaign(str(name_or_path), overrides, cases, seed, algorithms)


def create_campaign(
    name: str,
    scenario: str,
    *,
    cases: int,
    seed: int = 1,
    parameters: Mapping[str, Any] | None = None,
    dispersions: Mapping[str, Mapping[str, Any]] | None = None,
    requirements: Sequence[str | Mapping[str, Any]] = (),
    **tables: Any,
) -> Campaign:
    """Create and validate a campaign without a file. Raises `marsyard.campaigns.errors.CampaignError`.

    - name, scenario: name of the campaign; name of a scenario (`descent`) or ``module:Class``
    - cases, seed: number of cases and root seed
    - parameters: nested tables of the scenario's parameters, as in a campaign file
    - dispersions: distributions by dotted parameter path: ``{"sun.elevation_deg": {"distribution": "uniform", ...}}``
    - requirements: ids of included requirements (`DIMES-VEL`), or tables as in a campaign file
    - tables: further keys of a campaign file, such as `description`, `retain` and `limits`
    """
    entries = [{"id": entry} if isinstance(entry, str) else dict(entry) for entry in requirements]
    values = {"name": name, "scenario": scenario, "cases": cases, "seed": seed, **tables}
    values |= {"parameters": dict(parameters or {}), "dispersions": dict(dispersions or {}), "requirements": entries}
    return loading.create_campaign(values, f"campaign '{name}'")


def run(
    campaign: Campaign | str | Path,
    algorithm: Any = None,
    *,
    compare: Sequence[Any] = (),
    cases: int | None = None,
    seed: int | None = None,
    changes: Mapping[str, Any] | None = None,
    jobs: int = 1,
    directory: str | Path | None = None,
) -> Result:
    """Run a campaign with an algorithm, and return its results. Raises `marsyard.campaigns.errors.CampaignError`.

    - campaign: a name of `catalogue`, the path of a TOML file, or a campaign
    - algorithm, compare: algorithm under test, and algorithms that run on the same cases. A name; a class, or a
      function without parameters, that returns an algorithm; a function of the measurements that returns the estimate;
      or an algorithm itself, of which each worker process receives a copy. None for the algorithm of the campaign
    - cases, seed, changes: as in `load_campaign`; only for a campaign that is given by name or path
    - jobs: number of worker processes
    - directory: new folder of the results; `runs/NAME-TIME` if None
    """
    from marsyard.cli.execution import default_directory
    from marsyard.result import open_result

    if isinstance(campaign, Campaign):
        if cases is not None or seed is not None or changes:
            raise CampaignError("cases, seed and changes are for a campaign that is given by its name or file")
        name = campaign.definition.name
    else:
        # without changes and algorithms: algorithms given as objects are stored in the folder with this name first
        name = loading.load_campaign(str(campaign)).definition.name
    folder = default_directory(name) if directory is None else Path(directory)
    specs = _name_algorithms([*([] if algorithm is None else [algorithm]), *compare], folder / "algorithms")
    if compare and algorithm is None:
        raise CampaignError("compare needs an algorithm under test: the argument 'algorithm'")
    if isinstance(campaign, Campaign):
        selected = loading.replace_algorithms(campaign, specs)
    else:
        selected = load_campaign(campaign, changes, cases=cases, seed=seed, algorithms=specs)
    run_campaign(selected, folder, jobs=jobs)
    return open_result(folder)


def open_result(directory: str | Path) -> Result:
    """Open the results of a stored campaign. Raises CampaignError if the folder contains no campaign."""
    from marsyard.result import open_result as open_stored

    return open_stored(directory)


def _name_algorithms(algorithms: Sequence[Any], folder: Path) -> list[str]:
    """Return the specifications of algorithms; objects are stored in `folder`. Raises CampaignError."""
    from marsyard.scenarios.stored_objects import store_object

    try:
        return [store_object(algorithm, folder) for algorithm in algorithms]
    except ValueError as error:
        raise CampaignError(str(error)) from error


def draw(campaign: Campaign, case: int) -> dict[str, Any]:
    """Return the parameter values drawn from the dispersions for one case, by parameter path."""
    return campaign.draws(case)


def draws(campaign: Campaign, cases: int) -> pd.DataFrame:
    """Return the parameter values drawn for the first `cases` cases, one row per case."""
    import pandas as pd

    return pd.DataFrame([campaign.draws(case) for case in range(cases)]).rename_axis("case")


def run_case(campaign: Campaign, case: int) -> CaseResult:
    """Run one case in this process; return its outcome, row of results, images and intermediate results (`products`).

    The row equals the row that `run_campaign` stores. A terrain that is not in the cache is built first.
    """
    return campaign.scenario.run(campaign.parameters(case), campaign.streams(case))


def run_campaign(campaign: Campaign, directory: str | Path, *, jobs: int = 1) -> Path:
    """Run a campaign with `jobs` worker processes, store it in a new folder, write its report; return the folder.

    Raises `marsyard.campaigns.errors.CampaignError` if the folder exists or cannot be written.
    """
    from rich.console import Console

    from marsyard.campaigns.execution.executors import ExecutorConfig
    from marsyard.campaigns.running.engine import run_campaign as run
    from marsyard.cli.outcome import evaluate_and_store
    from marsyard.cli.progress import RunLog, campaign_progress

    folder = Path(directory)
    with campaign_progress(Console(stderr=True)) as progress, RunLog(folder, progress) as log:
        run(campaign, folder, ExecutorConfig(jobs), log)
    evaluate_and_store(folder)
    return folder


def results(directory: str | Path) -> pd.DataFrame:
    """Return the stored results of a campaign: outcome, errors and drawn values, one row per case."""
    import pandas as pd

    from marsyard.campaigns.errors import StoreError
    from marsyard.campaigns.store.table import TABLE_FILE, refresh_table
    from marsyard.sim.files import report_damage

    refresh_table(Path(directory))
    path = Path(directory) / TABLE_FILE
    with report_damage(path, StoreError, "is not a valid table of cases"):
        return pd.read_parquet(path)


def verdicts(directory: str | Path) -> Sequence[Verdict]:
    """Evaluate the requirements of a stored campaign; return one verdict per requirement."""
    from marsyard.campaigns.store.table import refresh_table
    from marsyard.reports.evaluation import evaluate_run

    refresh_table(Path(directory))
    return evaluate_run(Path(directory)).verdicts


def collect_metric(results: Sequence[CaseResult], metric: str) -> pd.Series[Any]:
    """Collect the column `metric` of results of `run_case`, one value per case; NaN for a case without the column."""
    import pandas as pd

    return pd.Series([result.row.get(metric, float("nan")) for result in results], name=metric).rename_axis("case")


def render_view(site: str, camera: str = "mer-navcam", *, detector: bool = True, **pose: Any) -> list[RenderedImage]:
    """Render an image of a site with ground truth; for a stereo camera, the left and right image. Raises ValueError.

    - site, camera: names as in `sites` and `marsyard render`; the site may also be the path of a DTM (.tif, .npz)
    - detector: whether to simulate the detector; otherwise only the radiance is rendered (`RenderedImage.frame`)
    - pose: options of `marsyard render`: scale, altitude_m, east_m, north_m, azimuth_deg, elevation_deg,
      sun_azimuth_deg, sun_elevation_deg, seed, max_hole_fraction
    """
    from marsyard.site_images import ImageRequest, render_images

    return render_images(ImageRequest.from_defaults(site, camera, **pose), detector=detector)


def _format_toml(value: Any) -> str:
    """Format a value in TOML syntax."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(str(key))} = {_format_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_format_toml(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(str(value)) if isinstance(value, str | Path) else repr(value)
