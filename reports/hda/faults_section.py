"""Section on the answers of the search in flights with faults."""

import math

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports import populations, rates
from marsyard.reports.hda.landing_cases import PAPER, landing_rows
from marsyard.reports.outcomes_by_size import ExtraColumn, OutcomesBySize
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Section, Subject, create_section
from marsyard.reports.wording import NOTHING, format_fraction


def _describe_fault(fault: str, size: float) -> tuple[str, str]:
    """Return the name of a fault, and its size with the unit; the size is empty if it is NaN, or without a unit."""
    description = PAPER["fault_names"].get(fault, {"name": fault.replace("_", " "), "unit": "number"})
    name, unit = description["name"], description.get("unit")
    if unit is None or math.isnan(size):
        return name, ""
    if unit == "fraction":
        return name, f"{100.0 * size:g} %"
    return name, f"{size:g}" if unit == "number" else f"{size:g} {unit}"


def classify_answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create a mask for each outcome of the search, in the order of `ANSWERS`; each row has exactly one outcome.

    `unconverged`: finished, but the algorithm reported neither a site nor that no site is safe.
    """
    is_reported, is_safe, is_refused = (
        populations.flag_mask(frame, name) for name in ("site_reported", "site_safe", "no_site_reported")
    )
    is_finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    return {
        "safe": is_reported & is_safe,
        "wrong": is_reported & ~is_safe,
        "refused": is_refused,
        "unconverged": is_finished & ~is_reported & ~is_refused,
        "unfinished": ~is_finished,
    }


def _median(frame: pd.DataFrame, column: str) -> float:
    return rates.quantile(rates.finite_values(frame, column), 0.5)


def _two_decimals(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


FAULT_OUTCOMES = OutcomesBySize(
    outcomes=classify_answers,
    styles={
        "safe": ("safe site", "full"),
        "refused": ("no safe site", "hatched"),
        "unconverged": ("not converged", "dotted"),
        "wrong": ("unsafe site", "crossed"),
    },
    cases="Flights",
    wording=_describe_fault,
    extra_columns=(
        ExtraColumn("Touchdown error (m)", "off_m", lambda rows: _median(rows, "touchdown_error_m"), _two_decimals),
        ExtraColumn("Sink rate (m/s)", "sink_m_s", lambda rows: _median(rows, "touchdown_sink_m_s"), _two_decimals),
    ),
)
_FAULT_NOTE = (
    "Safe site, unsafe site: a site is reported, and it is truly safe or not. No safe site: the algorithm gives "
    "this answer; it can be correct. Not converged: the algorithm reports this, and the helicopter descends to the "
    f"a-priori site. The interval is at {format_fraction(CONFIDENCE)} confidence. Touchdown error: median distance of "
    "the true touchdown from the site. Sink rate: median vertical speed at touchdown."
)


def faults_section(subject: Subject) -> Section | None:
    """Create the section on answers by fault and size; None without faults."""
    frame = landing_rows(subject)
    caption = "Fraction of flights by answer, for each fault and size."
    blocks = [] if frame is None else FAULT_OUTCOMES.blocks(frame, "landingfaults", caption, _FAULT_NOTE)
    return create_section("landing-faults", "Faults", "Faults by size", *blocks)
