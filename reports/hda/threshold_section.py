"""Section on false alarms and misses of the map of hazards, by roughness threshold.

"The paper" is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from marsyard.reports.blocks import Quantity, Rate, condition_blocks, flag_rate, pooled_fraction
from marsyard.reports.column_values import numbers
from marsyard.reports.hda.landing_cases import landing_rows
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Section, Subject, create_section, has_values
from marsyard.reports.wording import format_fraction
from marsyard.scenarios.landing.parameters import LanderParameters

_THRESHOLD_RATES = (
    Rate("false_alarms", "False alarms", pooled_fraction("false_alarms", "footprints_truly_safe")),
    Rate("missed", "Missed", pooled_fraction("missed", "footprints_not_safe")),
    Rate(
        "called_safe_unsafe",
        "Classified as safe, not truly safe",
        pooled_fraction("footprints_called_safe_unsafe", "footprints_called_safe"),
    ),
    Rate(
        "site_reported",
        "Site reported, if a wide safe site exists",
        flag_rate("site_reported", "wide_site_exists"),
        in_figure=False,
    ),
    Rate("safe", "Sites truly safe", flag_rate("site_safe", "site_reported"), in_figure=False),
)
_THRESHOLD_TEXT = (
    "According to the paper, both results of its Fig. 7 contain false positive hazards. The causes are a low roughness "
    "threshold and noise of the map. A higher threshold would remove them. The paper gives no numbers."
)
_THRESHOLD_NOTE = (
    "A footprint is the circle that the lander covers around a grid point. A hazard is detected if the map of slope or "
    "roughness exceeds the threshold in at least one cell of the footprint. False alarms: fraction of the truly safe "
    "footprints with a detected hazard. Missed: fraction of the unsafe footprints without a detected hazard."
)


def _lander_limit_m(subject: Subject) -> float:
    """Return the roughness limit of the campaign's lander, or the default limit."""
    limit = subject.run.parameter("lander", "max_roughness_m")
    return float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m


def threshold_section(subject: Subject) -> Section | None:
    """Create the section on false alarms and misses by threshold, to check the paper's remark on false positives."""
    frame = landing_rows(subject)
    if frame is None or not has_values(frame, "false_alarms"):
        return None
    n_unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    blocks = condition_blocks(
        frame.assign(footprints_not_safe=n_unsafe),
        "threshold",
        Quantity("max_roughness_m", "Roughness threshold (m)"),
        _THRESHOLD_RATES,
        cases="Flights",
        ylabel="fraction of footprints",
        text=_THRESHOLD_TEXT,
        note=_THRESHOLD_NOTE,
        caption=f"Bars are {format_fraction(CONFIDENCE)} intervals.",
        limit=("the lander's limit", _lander_limit_m(subject)),
        data="thresholds",
    )
    return create_section("threshold", "Threshold", "False alarms and misses by roughness threshold", *blocks)
