"""Tables of verdicts and confirmations for terminals.

Cells are `Text` objects, so that brackets in names are not read as markup.
"""

import math
from collections.abc import Sequence

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from marsyard.campaigns.definition.claims import Confirmation
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import NOTHING, percent, requirement_text

_STYLES = {
    Status.PASS: "bold green",
    Status.MET_BY_RATE: "bold cyan",
    Status.FAIL: "bold red",
    Status.INSUFFICIENT: "bold yellow",
    Status.UNVERIFIED: "bold cyan",
    Status.UNREGISTERED: "bold cyan",
    Status.OTHER_CLAIMS: "bold cyan",
}


def verdict_table(verdicts: Sequence[Verdict], algorithm: str = "") -> Group:
    """Create a table of requirements with verdicts and evidence, and its notes, for terminals of at least 80 columns.

    algorithm: name of the algorithm under test
    """
    title = f"Verdict of {algorithm}" if algorithm else "Verdict"
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, expand=False, title_justify="left")
    table.add_column("Requirement", overflow="fold", ratio=None, min_width=18)
    table.add_column("Verdict", no_wrap=True)
    for heading in ("Failed", "Succeeded", "Bounds", "Needed"):
        table.add_column(heading, justify="right", no_wrap=True)
    for verdict in verdicts:
        requirement = Text(verdict.requirement_id, style="bold")
        requirement.append(f"\n{requirement_text(verdict)}", style="dim")
        table.add_row(
            requirement,
            Text(str(verdict.status), style=_STYLES[verdict.status]),
            f"{verdict.failures} of {verdict.n}",
            percent(verdict.estimate),
            NOTHING if math.isnan(verdict.lower) else f"≥ {percent(verdict.lower)}\n≤ {percent(verdict.upper)}",
            NOTHING if verdict.additional_cases is None else str(verdict.additional_cases),
        )
    if not verdicts:
        table.add_row(Text("no requirement"), "", "", "", "", "")
    lines = []
    if any(not math.isnan(verdict.lower) for verdict in verdicts):
        lines.append("Bounds: one-sided Clopper-Pearson bounds at the required confidence.")
        lines.append("Needed: additional cases, all without failure, that would lead to PASS.")
    if len(verdicts) > 1 and verdicts[0].note and len({verdict.note for verdict in verdicts}) == 1:
        lines.append(verdicts[0].note)
    else:
        lines += [f"{verdict.requirement_id}: {verdict.note}" for verdict in verdicts if verdict.note]
    # not as the table's caption, which cuts off full lines
    return Group(table, *(Text(line, style="dim") for line in lines))


def confirmations_table(entries: Sequence[Confirmation]) -> Table:
    """Create a table of confirmations (`marsyard run --confirm`) for terminals.

    A confirmation is a run with a new seed after the algorithm was frozen. The column Number counts the confirmations
    of one claim.
    """
    table = Table(title="Confirmations", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("Campaign", "Algorithm", "Claim"):
        table.add_column(heading, overflow="fold")
    for heading in ("Number", "Date", "Cases"):
        table.add_column(heading, no_wrap=True)
    table.add_column("Results", min_width=14)
    for entry in entries:
        results = "not finished"
        if not entry.is_unfinished:
            results = "\n".join(f"{name}: {status}" for name, status in (entry.results or {}).items())
            results = results or "no requirement"
        claim = entry.claim[:8] if entry.is_chained else NOTHING
        cells = (entry.campaign, entry.frozen.algorithm, claim, str(entry.number), entry.started_utc[:10])
        table.add_row(*map(Text, (*cells, str(entry.cases), results)))
    return table
