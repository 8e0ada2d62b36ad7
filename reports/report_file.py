"""Typed record of `report.json`: created by the report, and read by the dashboard."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from marsyard.campaigns.definition.evidence import Evidence
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.reports.provenance import Algorithm
from marsyard.reports.robustness import Robustness
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.statistics.error_summary import ErrorSummary
from marsyard.reports.validity import Validity
from marsyard.reports.verdicts import Verdict

#: Files of a report: the page, and its data.
PAGE_FILE, REPORT_JSON = "report.html", "report.json"
#: Version of the layout of `report.json`. A removed field, or a new meaning, increases the version.
Schema = Literal[8]
SCHEMA: Schema = 8
#: Properties that `report.json` contains next to the fields of verdicts, sampling design and evidence.
_VERDICT_PROPERTIES = ("note", "plain_status", "confident_status", "margin")
_ROBUSTNESS_PROPERTIES = ("name", "pass_text", "fail_text")
_SAMPLING_PROPERTIES, _EVIDENCE_PROPERTIES = ("independent", "text"), ("title", "text")


@dataclass(frozen=True)
class StudySummary:
    """Kind (`rare`, `search`, `budget`, `robust`), requirement and main result of a study."""

    kind: str
    requirement: str
    sentence: str


@dataclass(frozen=True)
class CampaignReport:
    """Content of `report.json`: the results of a campaign's report; null represents NaN and infinities.

    - schema: version of the layout
    - state, seed, git_commit, started_utc, finished_utc: copied from `campaign.json`
    - crashed: number of crashed cases
    - sites, algorithms: names in the rows, at most 24
    - algorithm_details: algorithms of the record, the algorithm under test first
    - verdict, sentence, exit_code: verdict of the campaign, its explanation and its exit status
    - study: main result of a study; null for an ordinary campaign
    - verdicts: verdict of each requirement, with the properties `note`, `plain_status`, `confident_status`, `margin`
    - outcomes: number of cases by outcome
    - metric, statistics: the page's metric, and statistics of its errors by label
    - worst_cases: numbers of the cases with the largest errors, the largest first
    - validity: cases outside of the conditions in which the simulation was checked, and missed checks
    - sections: data of each further section of the page, by the section's anchor
    - showcases: cases with stored products
    - robustness: for each requirement that the rate of the cases meets, the smallest change of each kind to FAIL,
      with the properties `name`, `pass_text` and `fail_text`
    - repeated: number of cases that finished only in a second attempt
    """

    schema: Schema
    campaign: str
    state: Any
    seed: Any
    git_commit: Any
    started_utc: Any
    finished_utc: Any
    cases: int
    crashed: int
    sites: tuple[str, ...]
    algorithms: tuple[str, ...]
    algorithm_details: tuple[Algorithm, ...]
    sampling: SamplingDesign
    evidence: Evidence
    verdict: str
    sentence: str
    study: StudySummary | None
    exit_code: int
    verdicts: tuple[Verdict, ...]
    outcomes: Mapping[str, int]
    metric: str | None
    statistics: Mapping[str, ErrorSummary]
    worst_cases: tuple[str, ...]
    validity: Validity
    sections: Mapping[str, Mapping[str, Any]]
    showcases: tuple[int, ...]
    robustness: tuple[Robustness, ...] = ()
    repeated: int = 0

    def to_json(self) -> dict[str, Any]:
        """Convert to types of JSON; NaN and infinities become None, folders of the user are hidden."""
        values = asdict(self)
        values["verdicts"] = [asdict(verdict) | _properties(verdict, _VERDICT_PROPERTIES) for verdict in self.verdicts]
        values["robustness"] = [asdict(item) | _properties(item, _ROBUSTNESS_PROPERTIES) for item in self.robustness]
        values["sampling"] |= _properties(self.sampling, _SAMPLING_PROPERTIES)
        values["evidence"] |= _properties(self.evidence, _EVIDENCE_PROPERTIES)
        return dict(_to_json_types(values))


_ADAPTER = TypeAdapter(CampaignReport)


def read_report(text: str | bytes) -> CampaignReport | None:
    """Read the content of `report.json`; None for another layout, or text that is no report."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError:
        return None


def _properties(item: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(item, name) for name in names}


def _to_json_types(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _to_json_types(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json_types(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, int | bool) else hide_folders(str(value))
