"""Faults of a landing by size: a safe site, no safe site, no convergence, or a wrong one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports.answers import CONFIDENCE, Share, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.faults import FAULT, NO_FAULT, SIZE
from marsyard.reports.hda.rows import flag, interval_text, is_landing
from marsyard.reports.plates import plate
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MUTED, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, percent, stated

#: Faults in words with the unit of their size; a unit of None is one kind without sizes.
NAMES: Mapping[str, tuple[str, str | None]] = MappingProxyType(
    {
        "none": ("none", None),
        "black_picture": ("picture delivered black", "number"),
        "repeated_picture": ("first picture delivered again", None),
        "lost_rows": ("rows of the second picture lost", "share"),
        "lost_pictures": ("pictures of the flight lost", "share"),
        "laser_silent": ("altimeter silent", None),
        "laser_stuck": ("altimeter stuck at a height greater by", "share"),
        "gps_outage_s": ("no GPS from before the pictures on", "s"),
        "bad_pixels": ("dead pixels, and as many hot ones", "share"),
        "listed_bad_pixels": ("the same, listed and filled", "share"),
        "dust_discs": ("specks of dust on the lens", "number"),
        "own_shadow_m": ("own shadow in view", "m"),
        "several": ("several", None),
    }
)


@dataclass(frozen=True)
class LandingFault:
    """Flights with one fault of one size.

    Attributes
    ----------
    fault, size
        As the rows name it.
    n, safe, refused, unconverged, wrong, unfinished
        Flights; truly safe sites, `no safe site`, not converged, sites that are not safe, not run to their end.
    wrong_share
        Wrong ones of all.
    off_m, sink_m_s
        Medians over the landings: true touchdown from the site, and speed of sinking then; NaN where nothing landed.
    """

    fault: str
    size: float
    n: int
    safe: int
    refused: int
    unconverged: int
    wrong: int
    unfinished: int
    wrong_share: Share
    off_m: float
    sink_m_s: float


def landing_faults_section(subject: Subject) -> Section | None:
    """The table; None where no flight has a fault."""
    rows = landing_faults(subject.frame)
    if all(row.fault == NO_FAULT for row in rows):
        return None
    caption = "Full: a truly safe site. Hatched: no safe site. Dotted: not converged. Crossed: a site that is not safe."
    note = (
        "Not converged: said so, and the a-priori site is what is left. Wrong: a site was reported as safe and is not, "
        f"with the interval of its share at {stated(CONFIDENCE)}. 'No safe site' may be right: rows tell no "
        "difference. "
        "Touchdown off: median distance of the true touchdown from where the site was; sinking: median speed then."
    )
    blocks = [Block(plates=[plate(fault_bars(rows), "hdafaults", caption)]), Block(grid=_grid(rows), note=note)]
    data = {"rows": [asdict(row) for row in rows]}
    return Section("landing-faults", "Faults", "Faults by size", blocks, data)


def landing_faults(frame: pd.DataFrame) -> list[LandingFault]:
    """Flights by fault and size, those without a fault first; none where rows are of other cases."""
    if not is_landing(frame) or FAULT not in frame:
        return []
    sizes = numbers(frame, SIZE)
    found = []
    for fault in sorted(frame[FAULT].dropna().unique(), key=lambda name: (name != NO_FAULT, str(name))):
        of_fault = frame[FAULT].eq(fault).fillna(False).to_numpy(dtype=np.bool_)
        for size in np.unique(sizes[of_fault]):
            same = np.isnan(sizes) if np.isnan(size) else sizes == size
            found.append(_row(frame[of_fault & same], str(fault), float(size)))
    return found


def _row(chosen: pd.DataFrame, fault: str, size: float) -> LandingFault:
    reported, safe, refused = (flag(chosen, name) for name in ("site_reported", "site_safe", "no_site_reported"))
    finished = chosen["site_reported"].notna().to_numpy(dtype=np.bool_)
    return LandingFault(
        fault=fault,
        size=size,
        n=len(chosen),
        safe=int((reported & safe).sum()),
        refused=int(refused.sum()),
        unconverged=int((finished & ~reported & ~refused).sum()),
        wrong=int((reported & ~safe).sum()),
        unfinished=int((~finished).sum()),
        wrong_share=share_of(reported & ~safe, chosen),
        off_m=_median(chosen, "touchdown_error_m"),
        sink_m_s=_median(chosen, "touchdown_sink_m_s"),
    )


def _median(chosen: pd.DataFrame, name: str) -> float:
    values = numbers(chosen, name)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


@in_page_style
def fault_bars(rows: list[LandingFault]) -> Figure:
    """Shares of the four outcomes, a bar each row."""
    figure, axes = new_axes(7.4, 1.0 + 0.27 * len(rows))
    kinds = (
        ("safe", "safe site", {"color": SERIES[0]}),
        ("refused", "no safe site", {"color": "none", "edgecolor": SERIES[2], "hatch": "////"}),
        ("unconverged", "not converged", {"color": "none", "edgecolor": MUTED, "hatch": "...."}),
        ("wrong", "wrong", {"color": "none", "edgecolor": REQUIREMENT, "hatch": "xxxx"}),
    )
    left = np.zeros(len(rows))
    for kind, name, style in kinds:
        share = np.array([100.0 * getattr(row, kind) / row.n for row in rows])
        axes.barh(np.arange(len(rows)), share, left=left, height=0.7, label=name, **style)  # type: ignore[arg-type]
        left = left + share
    axes.set_yticks(np.arange(len(rows)), [" ".join(_named(row)) for row in rows])
    axes.set(xlabel="% of flights", xlim=(0.0, 100.0))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def _named(row: LandingFault) -> tuple[str, str]:
    name, unit = NAMES.get(row.fault, (row.fault.replace("_", " "), "number"))
    if unit is None or np.isnan(row.size):
        return name, ""
    if unit == "share":
        return name, f"{100.0 * row.size:g} %"
    return name, f"{row.size:g}" if unit == "number" else f"{row.size:g} {unit}"


def _grid(rows: list[LandingFault]) -> Grid:
    head = ["Fault", "Size", "Flights", "Safe site", "No safe site", "Not converged", "Wrong", "Wrong, interval"]
    head += ["Touchdown off (m)", "Sinking (m/s)"]
    texts = []
    for row in rows:
        name, size = _named(row)
        counts = [
            f"{count:,} ({percent(count / row.n)})" for count in (row.safe, row.refused, row.unconverged, row.wrong)
        ]
        landing = [NOTHING if np.isnan(value) else f"{value:.2f}" for value in (row.off_m, row.sink_m_s)]
        texts.append([name, size or NOTHING, f"{row.n:,}", *counts, interval_text(row.wrong_share), *landing])
    return Grid(head, texts)
