"""Assurance case of campaigns: claims, arguments and evidence in the Goal Structuring Notation, with open defeaters.

It is computed from the files of an assurance package alone (`marsyard.reports.assurance.package`). Notation: GSN
Community Standard, version 3; a defeater is a counter-argument of its dialectic extension.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.claims import Confirmation
from marsyard.campaigns.definition.evidence import EvidenceKind
from marsyard.reports.assurance.argument import (
    Element,
    ElementKind,
    GoalState,
    NumberedElement,
    defeater,
    goal,
    number_elements,
)
from marsyard.reports.fits import Constant, read_constants
from marsyard.reports.overall import describe_status
from marsyard.reports.provenance import format_tested_algorithms
from marsyard.reports.report_file import CampaignReport
from marsyard.reports.stored import table
from marsyard.reports.validation_rows import RowKind, ValidationRow, read_checks
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count, format_fraction, percent
from marsyard.scenarios.systems import find_system

#: Files of the evidence that is common to all campaigns.
VALIDATION, REGISTER, CREDIBILITY = "evidence/validation.json", "evidence/fitted.toml", "evidence/credibility.toml"
#: Word that marks an assumption in the source of a dispersion or requirement.
_ASSUMED = "assumed"
#: Number of names in a text before the others are counted.
_MAX_NAMES = 6


@dataclass(frozen=True)
class AssuredRun:
    """A campaign of the package.

    - folder: folder in the package, relative to it
    - report, data: content of `report.json`, read, and as JSON
    - record: content of `campaign.json`
    - head: last head of the chain of hashes of the rows
    - confirmations, record_head: entries of the claim in its record of confirmations, and the hash of the record
    """

    folder: str
    report: CampaignReport
    data: Mapping[str, Any]
    record: Mapping[str, Any]
    head: str
    confirmations: Sequence[Confirmation] = ()
    record_head: str = ""

    @property
    def algorithm(self) -> str:
        """Names and versions of the algorithms under test."""
        return format_tested_algorithms(self.report.algorithm_details) or ", ".join(self.report.algorithms) or "none"

    @property
    def definition(self) -> Mapping[str, Any]:
        """Definition of the campaign."""
        return table(self.record.get("definition"))

    @property
    def system(self) -> str:
        """Name of the system; empty for an unknown one."""
        system = find_system(str(self.definition.get("scenario") or ""))
        return "" if system is None else system.name

    @property
    def robustness(self) -> Sequence[Mapping[str, Any]]:
        """Changes of the dispersions that turn PASS into FAIL, as in `report.json`; empty if not computed."""
        stored = self.data.get("robustness")
        return [table(item) for item in stored] if isinstance(stored, list) else []

    @property
    def assumed_dispersions(self) -> list[str]:
        """Paths of the dispersions whose source contains an assumption."""
        dispersions = table(self.definition.get("dispersions"))
        return [str(path) for path, item in dispersions.items() if _ASSUMED in str(table(item).get("source")).lower()]

    def word(self, verdict: Verdict) -> str:
        """Return the word for a verdict; PASS of an exploration is marked."""
        is_exploration = self.report.evidence.kind is EvidenceKind.EXPLORATION
        return describe_status(verdict.status, is_exploration=is_exploration)

    def file(self, name: str) -> str:
        """Return the path of a file of the campaign in the package."""
        return f"{self.folder}/{name}"


@dataclass(frozen=True)
class AssuranceCase:
    """Assurance case: the argument, and the evidence that its page lists.

    - rows: rows of the validation page that concern a system of the campaigns
    - constants: fitted constants on which their results depend
    - factors: factors of the credibility of the simulation (`name`, `group`, `level`, `reasons`)
    """

    root: Element
    runs: tuple[AssuredRun, ...]
    rows: tuple[ValidationRow, ...]
    constants: tuple[Constant, ...]
    factors: tuple[Mapping[str, str], ...] = field(default=())

    @property
    def defeaters(self) -> list[NumberedElement]:
        """Open defeaters; their parents are the elements that they challenge."""
        return [item for item in number_elements(self.root) if item.element.kind is ElementKind.DEFEATER]

    def to_json(self) -> dict[str, Any]:
        """Convert to JSON: elements, and links in the words of GSN."""
        listed = number_elements(self.root)
        contexts = (ElementKind.CONTEXT, ElementKind.ASSUMPTION)
        return {
            "notation": "GSN Community Standard, version 3",
            "elements": [
                {
                    "id": name,
                    "type": item.kind.name.lower(),
                    "statement": item.text,
                    "state": item.state.value if item.kind is ElementKind.GOAL else "",
                    "evidence": item.evidence,
                }
                for name, item, _ in listed
            ],
            "links": [
                {"source": name, "target": parent, "type": "challenges"}
                if item.kind is ElementKind.DEFEATER
                else {
                    "source": parent,
                    "target": name,
                    "type": "inContextOf" if item.kind in contexts else "supportedBy",
                }
                for name, item, parent in listed
                if parent
            ],
        }


def build_argument(runs: Sequence[AssuredRun], folder: Path) -> AssuranceCase:
    """Build the argument on campaigns from the files of a package. Raises OSError or ValueError if one is invalid."""
    checks, constants = read_checks(folder / VALIDATION), read_constants(folder / REGISTER)
    factors = tomllib.loads((folder / CREDIBILITY).read_text(encoding="utf-8"))["factors"]
    all_rows = [row for check in checks.values() for row in check.rows]
    systems = {run.system for run in runs}
    rows = [row for row in all_rows if any(row.concerns(system) for system in systems)]
    fitted = [item for item in constants if any(item.concerns(run.system, run.report.sites) for run in runs)]
    names = ", ".join(dict.fromkeys(run.report.campaign for run in runs))
    scope = (
        "The verdicts hold for the dispersions of the campaign files and for the models of the simulation. They do not "
        "prove that an algorithm will work on Mars."
    )
    root = goal(
        f"The algorithms under test meet the requirements of the campaigns {names}.",
        Element(ElementKind.CONTEXT, scope),
        Element(
            ElementKind.STRATEGY,
            "Argument over each campaign, and over the credibility of the simulation",
            (*(_argue_run(run, all_rows, constants) for run in runs), _argue_credibility(factors)),
        ),
    )
    return AssuranceCase(root, tuple(runs), tuple(rows), tuple(fitted), tuple(factors))


def _argue_run(run: AssuredRun, rows: Sequence[ValidationRow], constants: Iterable[Constant]) -> Element:
    """Argue that an algorithm meets the requirements of a campaign."""
    report, dispersions = run.report, table(run.definition.get("dispersions"))
    context = f"{count(report.cases, 'case')}; {report.sampling.text}; root seed {report.seed}"
    assumed = run.assumed_dispersions
    assumption = f"{len(assumed)} of {count(len(dispersions), 'dispersion')} are assumed: {_list_names(assumed)}"
    crashed = f"{count(report.crashed, 'case')} crashed. Fix the cause before you use the verdict."
    return goal(
        f"{run.algorithm} meets the requirements of {report.campaign}: {report.verdict}.",
        Element(ElementKind.CONTEXT, context, evidence=run.file("campaign.json")),
        Element(ElementKind.ASSUMPTION, assumption, evidence=run.file("campaign.json")) if assumed else None,
        defeater(crashed, run.file("report.html"), GoalState.REFUTED) if report.crashed else None,
        defeater("The campaign has no requirement.", state=GoalState.OPEN) if not report.verdicts else None,
        Element(
            ElementKind.STRATEGY,
            "Argument over each requirement at its confidence",
            tuple(_argue_requirement(run, verdict) for verdict in report.verdicts),
        ),
        _argue_evidence(run),
        _argue_rows(run),
        _argue_validity(run, [row for row in rows if row.concerns(run.system)], constants),
    )


def _argue_requirement(run: AssuredRun, verdict: Verdict) -> Element:
    """Argue that a requirement is met, with its robustness."""
    required = f"{format_fraction(verdict.probability)} at {format_fraction(verdict.confidence)} confidence"
    bounds = "" if math.isnan(verdict.lower) else f", bounds {percent(verdict.lower)} to {percent(verdict.upper)}"
    numbers = f"{run.word(verdict)}: {verdict.failures:,} of {count(verdict.n, 'case')} failed{bounds}. {verdict.note}"
    state = GoalState.SUPPORTED
    if not verdict.status.is_met:
        state = GoalState.REFUTED if verdict.status is Status.FAIL else GoalState.OPEN
    is_assumed = verdict.kind == "ours" or _ASSUMED in verdict.source.lower()
    return goal(
        f"{verdict.requirement_id}: {verdict.statement} Required: {required}.",
        Element(ElementKind.SOLUTION, numbers.strip(), evidence=run.file("report.html"), own_state=state),
        defeater(f"PASS needs a decision of a person: {verdict.status}.") if verdict.status.is_qualified else None,
        defeater("Evaluated by observed rate, not at a confidence.") if verdict.decide_by == ESTIMATE else None,
        defeater(f"The required rate or bound is assumed: {verdict.source or 'no source'}.") if is_assumed else None,
        _describe_time_factor(verdict),
        *_argue_robustness(run, verdict),
    )


def _describe_time_factor(verdict: Verdict) -> Element | None:
    """Challenge a requirement on a computing time, which depends on the processor of the simulation."""
    if "time_s" not in verdict.metric:
        return None
    factor = f"the flight processor is assumed to be {verdict.scale:g} times slower than the host of the simulation"
    return defeater(f"Computing time: {factor}; caches, buses and scheduling are not modelled.")


def _argue_robustness(run: AssuredRun, verdict: Verdict) -> Iterator[Element]:
    """List the changes of the dispersions up to which PASS holds."""
    if not verdict.status.is_met:
        return
    items = [item for item in run.robustness if item.get("requirement") == verdict.requirement_id]
    if not items:
        yield defeater("Robustness against other dispersions: not computed.")
        return
    texts = [str(item["pass_text"]) for item in items if item.get("pass_text")]
    unknown = [str(item.get("parameter")) for item in items if not item.get("pass_text")]
    if texts:
        yield Element(ElementKind.SOLUTION, f"PASS holds up to: {'; '.join(texts)}", evidence=run.file("report.json"))
    if unknown:
        names = _list_names(list(dict.fromkeys(unknown)))
        yield defeater(f"The cases do not show that PASS holds under a change of: {names}.", run.file("report.json"))


def _argue_evidence(run: AssuredRun) -> Element:
    """Argue that the cases were drawn after the algorithm was frozen."""
    evidence = run.report.evidence
    solution = None
    if run.confirmations:
        entries = "; ".join(
            f"{item.number} ({item.started_utc[:10]}, {count(item.counted_cases, 'case')}: "
            f"{', '.join(f'{name} {status}' for name, status in (item.results or {}).items()) or 'not finished'})"
            for item in run.confirmations
        )
        text = f"Confirmations of claim {evidence.claim[:8]}: {entries}. Record with head {run.record_head[:12]}"
        solution = Element(ElementKind.SOLUTION, text, evidence=run.file("confirmations.jsonl"))
    qualifications = (*evidence.terrain_texts, *evidence.notes) if run.confirmations else (evidence.text,)
    runs = table(run.definition.get("calibration")).get("runs") or ()
    calibrated = "; ".join(f"{', '.join(item['options'])} on seed {item['seed']} ({item['note']})" for item in runs)
    return goal(
        "The cases were drawn after the algorithm was frozen, and no earlier result is hidden.",
        solution,
        Element(ElementKind.CONTEXT, f"Options set on declared calibration runs: {calibrated}") if calibrated else None,
        *(
            defeater(text, run.file("campaign.json"), GoalState.CHALLENGED if solution else GoalState.OPEN)
            for text in qualifications
        ),
    )


def _argue_rows(run: AssuredRun) -> Element:
    """Argue that the rows are those that the program stored."""
    version = f"marsyard {table(run.record.get('versions')).get('marsyard', 'of unknown version')}"
    machine = table(run.record.get("environment"))
    environment = ", ".join(str(machine[name]) for name in ("platform", "processor", "python") if machine.get(name))
    commit = str(run.report.git_commit or "")
    rows = f"{count(run.report.cases, 'row')} in a chain of hashes with head {run.head[:12]}"
    return goal(
        "The rows are those of the stated program, in the stated environment.",
        Element(ElementKind.SOLUTION, rows, evidence=run.file("cases.sqlite")),
        Element(
            ElementKind.CONTEXT,
            f"commit {commit or 'unknown'}; {version}; {environment}",
            evidence=run.file("campaign.json"),
        ),
        defeater(f"The program had changes without a commit ({commit or 'unknown'}).")
        if "+" in commit or not commit
        else None,
    )


def _argue_validity(run: AssuredRun, rows: Sequence[ValidationRow], constants: Iterable[Constant]) -> Element:
    """Argue that the simulation was checked in the conditions of the cases."""
    solutions = []
    for kind in RowKind:
        decided = [row for row in rows if row.kind is kind and row.is_met is not None]
        met = sum(bool(row.is_met) for row in decided)
        if decided:
            # a fit shows that constants were fitted, and is no evidence of validity
            shape = ElementKind.CONTEXT if kind is RowKind.FIT else ElementKind.SOLUTION
            text = f"{kind}: {met} of {count(len(decided), 'row')} meet their limit"
            solutions.append(Element(shape, text, evidence=VALIDATION))
    by_data: dict[str, list[str]] = {}
    for constant in constants:
        if constant.concerns(run.system, run.report.sites):
            by_data.setdefault(constant.data.title, []).append(constant.name)
    fits = [f"Fitted to {title}: {_list_names(list(dict.fromkeys(names)))}." for title, names in by_data.items()]
    unknown = [] if run.report.validity.domains else ["The domain of validity of this system is not declared."]
    return goal(
        "The simulation was checked in the conditions of the cases.",
        *solutions,
        *(defeater(text, run.file("report.json")) for text in (*run.report.validity.sentences, *unknown)),
        *(defeater(text, REGISTER) for text in fits),
    )


def _argue_credibility(factors: Sequence[Mapping[str, str]]) -> Element:
    """Argue that the credibility of the simulation is rated, with the weak factors as defeaters."""
    # a level is a number from 0 to 4, or a range such as "1 to 2"
    weak = [item for item in factors if item["level"].partition(" ")[0] in ("0", "1")]
    return goal(
        "The credibility of the simulation is rated by the factors of NASA-STD-7009B.",
        Element(ElementKind.SOLUTION, f"{count(len(factors), 'factor')} rated by the developers", evidence=CREDIBILITY),
        defeater("Nobody outside of the project has reviewed the levels.", CREDIBILITY),
        *(defeater(f"{item['name']}, level {item['level']}: {item['reasons']}.", CREDIBILITY) for item in weak),
    )


def _list_names(names: Sequence[str]) -> str:
    """List the first names, and count the others."""
    others = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {others} more" if others > 0 else "")
