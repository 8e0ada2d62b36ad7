"""A system under test as one object: its scenarios, algorithms, campaigns, and the presentation of its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

#: Folder of the files that the systems of Marsyard share.
SCENARIOS_FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Ingested:
    """Cases made of recorded data.

    Attributes
    ----------
    campaign
        The text of the campaign file over them.
    cases, pictures
        How many there are.
    note
        What the user should check; empty for nothing.
    """

    campaign: str
    cases: int
    pictures: int
    note: str = ""


@dataclass(frozen=True)
class System:
    """Everything that Marsyard needs to know of a system; plain data, so that reading it imports nothing.

    A system of another package is a module-level object of this class, named by an entry point of the group
    `marsyard.systems` (`marsyard.scenarios.systems`). Every ``module:NAME`` is imported when it is first needed.

    Attributes
    ----------
    name
        A short name, used once among all systems: the dashboard groups campaigns by it.
    title, summary
        Its name for a reader, and one sentence on what is tested.
    scenarios
        Classes that implement `marsyard.scenarios.interface.Scenario`, as ``module:Class``, by the names that campaign
        files use.
    tasks
        The tasks of its algorithms, each a `marsyard.scenarios.estimators.Task` as ``module:NAME``: the published
        algorithm, the baselines, and the forms in which a user's own algorithm is accepted. Entry points of the group
        `marsyard.algorithms` add algorithms.
    catalogue
        Files of campaigns, as a folder and a pattern (``folder/altitude-*.toml``); each is known by its file's name.
        None for no campaigns.
    requirements
        A file of requirements that campaigns name by their ids, as `scenarios/requirements.toml`. None for none.
    columns
        A file that states the columns of each scenario's rows, as `scenarios/columns.toml`. None where they are not
        stated: requirements are then checked against the first finished case.
    compiled_by
        Campaigns of the catalogue, each with settings (``KEY=VALUE``) that make it small: one case of each calls all
        numeric kernels of its scenario (`marsyard compile`).
    templates
        Templates of `marsyard new`, each a `marsyard.scenarios.template.CampaignTemplate` as ``module:NAME``, by the
        names that ``--system`` takes.
    ingest
        A function as ``module:NAME`` that makes cases of recorded data (`marsyard ingest`), called with the folder of
        the data, a folder to write into, and the folder where that will lie in the end; it returns `Ingested`. Empty
        for none.
    report
        A `marsyard.reports.presentation.Presentation` as ``module:NAME``: report sections, and the pictures of a case.
        Empty for the sections that every campaign has.
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
        """The files of the catalogue by their campaigns' names."""
        if self.catalogue is None:
            return {}
        return {path.stem: path for path in sorted(self.catalogue.parent.glob(self.catalogue.name))}
