"""Section on tracking on four kinds of ground (Table II).

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections import Counter

import pandas as pd

from marsyard.reports import populations, rates
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.vtt.paper import PAPER, TERRAINS
from marsyard.reports.vtt.run_selection import is_closed_loop, selectable_targets
from marsyard.reports.wording import NOTHING, format_fraction, note_text, percent

#: Minimum change of azimuth that the paper calls excessive, degrees (section 5.5).
EXCESSIVE_DEG = 10.0


def terrains_section(subject: Subject) -> Section | None:
    """Create the section on Table II; None unless the campaign is that of the paper's terrains."""
    frame, printed_rows = subject.frame, PAPER["table_2"]
    if subject.run.name != TERRAINS or not is_closed_loop(frame) or "incline" not in frame:
        return None
    names = [str(name) for name in frame["incline"].dropna().unique()]
    ordered_names = [name for name in printed_rows if name in names] + sorted(set(names) - set(printed_rows))
    rows, data = [], []
    for name in ordered_names:
        runs = frame[frame["incline"].eq(name)]
        is_stuck, slips = populations.flag_mask(runs, "stuck"), rates.finite_values(runs, "slip_max")
        mobile_runs, stuck_runs = runs[~is_stuck], selectable_targets(runs[is_stuck])
        selectable_runs = selectable_targets(mobile_runs)
        lost_runs = selectable_runs[~populations.flag_mask(selectable_runs, "tracked")]
        cause_counts = dict(Counter(failure_cause(row) for _, row in lost_runs.iterrows()).most_common())
        failure_fraction, failure_fraction_all = (
            rates.flag_fraction(group, "tracked", value=False) for group in (selectable_runs, mobile_runs)
        )
        held_fraction = rates.fraction_of(populations.flag_mask(stuck_runs, "target_held"), stuck_runs)
        slip = float(slips.max()) if slips.size else float("nan")
        row = printed_rows.get(name)
        paper = [NOTHING] * 2 if row is None else [f"{row['failures']} of {row['trials']}", row["reason"]]
        causes = "; ".join(f"{cause}: {n}" for cause, n in cause_counts.items()) or "none"
        simulated_texts = [
            rates.fraction_text(failure_fraction),
            rates.interval_text(failure_fraction),
            causes,
            rates.fraction_text(failure_fraction_all),
            rates.fraction_text(held_fraction) if held_fraction.n else NOTHING,
        ]
        rows.append([name, *paper, *simulated_texts, percent(slip)])
        fractions = {"failed": failure_fraction, "failed_all": failure_fraction_all, "stuck_held": held_fraction}
        data.append({"name": name, **fractions, "causes": cause_counts, "slip_max": slip})
    head = ["Terrain", "Failures, paper", "Reason, paper", "Failures, ours", f"{format_fraction(CONFIDENCE)} interval"]
    head += ["Cause, ours", "Failures, all targets", "Stuck: target held", "Maximum wheel slip"]
    note = note_text("vtt.table_2", limit=f"{EXCESSIVE_DEG:g}")
    title = "Tracking with visual odometry on four kinds of ground (Table II of the paper)"
    return Section("table-2", "Kinds of ground", title, [Block(grid=Grid(head, rows), note=note)], {"terrains": data})


def failure_cause(row: pd.Series) -> str:
    """Determine the cause of a failed run from its row."""
    outcome = str(row["outcome"])
    if outcome not in ("COMPLETED", "LOST"):
        return outcome.replace("_", " ").lower()
    if float(row.get("azimuth_change_max_deg", 0.0)) > EXCESSIVE_DEG:
        return "excessive azimuth change"
    if row.get("clear_sky") is not None and not bool(row["clear_sky"]):
        return "lighting change"
    return "drift" if outcome == "COMPLETED" else str(row["losses"]).replace("_", " ").lower()
