"""A system under test as one object: scenarios, algorithms, campaigns, and presentation of the results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

#: Folder of the files that the systems of Marsyard share.
SCENARIOS_FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Ingested:
    """Cases made of recorded data: text of the campaign file, numbers, and a note for the user."""

    campaign: str
    cases: int
    pictures: int
    note: str = ""


@dataclass(frozen=True)
class System:
    """A system under test; plain data, whose ``module:NAME`` objects are imported when they are needed.

    A system of another package is a module-level object of this class, named by an entry point of the group
    `marsyard.systems` (`marsyard.scenarios.systems`).

    - name: short unique name; the dashboard groups campaigns by it
    - title, summary: name for a reader, and one sentence on the tests
    - scenarios: classes that implement `marsyard.scenarios.interface.Scenario`, by the names in campaign files
    - tasks: each a `marsyard.scenarios.estimators.Task`: the published algorithm, the baselines, and the accepted forms
      of a user's algorithm. Entry points of the group `marsyard.algorithms` add algorithms.
    - catalogue: campaign files, as a folder and a pattern (``folder/altitude-*.toml``)
    - requirements: a file of requirements that campaigns name by their ids, as `scenarios/requirements.toml`
    - columns: a file of the columns of each scenario's rows, as `scenarios/columns.toml`. Without it requirements are
      checked against the first finished case.
    - compiled_by: campaigns of the catalogue, each with settings (``KEY=VALUE``) that make it small: one case of each
      calls all numeric kernels of its scenario (`marsyard compile`)
    - templates: each a `marsyard.scenarios.template.CampaignTemplate`, by the values of ``marsyard new --system``
    - ingest: function that makes cases of recorded data (`marsyard ingest`). Arguments: the folder of the data, a
      folder to write into, and the folder to which that is moved. Returns `Ingested`.
    - report: a `marsyard.reports.presentation.Presentation`: report sections, and the pictures of a case
    """

    name: str
    title: str
    summary: str
    scenarios: Mapping[str, str]
    tasks: tuple[str, ...] = ()
    catalogue: Path | None = None
    requirements: Path | None = None
    columns: Path | None = None
    compiled_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    templates: Mapping[str, str] = field(default_factory=dict)
    ingest: str = ""
    report: str = ""

    @property
    def campaigns(self) -> Mapping[str, Path]:
        """Files of the catalogue by campaign."""
        if self.catalogue is None:
            return {}
        return {path.stem: path for path in sorted(self.catalogue.parent.glob(self.catalogue.name))}
