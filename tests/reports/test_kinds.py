"""Sections declared as data, as a system of another package declares its own: against rows whose numbers are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.reports import presentation
from marsyard.reports.campaign import section_makers, write_report
from marsyard.reports.charts import cumulative_figure
from marsyard.reports.kinds import (
    Distribution,
    Quantity,
    Rate,
    RateByCondition,
    RateTable,
    Scatter,
    SectionDeclaration,
    Statistics,
    condition_bins,
    flagged,
)
from marsyard.reports.presentation import Presentation, presentations
from marsyard.reports.section import Subject
from marsyard.reports.stored import StoredRun
from marsyard.reports.tables import PaperFacts
from marsyard.scenarios.systems import System

ERROR = Quantity("altitude_error_m")
ALTITUDE = SectionDeclaration(
    key="altitude",
    name="Altitude",
    title="Altitude from two pictures",
    requires=("altitude_error_m",),
    parts=(
        Statistics("altitude_error_m"),
        Distribution([ERROR], ("altitude error (m)", "share of cases"), "Share of cases up to each error.", bound=5.0),
        RateTable([Rate("answered", "answered", flagged("answered"))]),
        RateByCondition(Quantity("altitude_m"), [Rate("answered", "Answered", flagged("answered"))]),
        Scatter([Quantity("altitude_m")], [ERROR], "Every case, and medians of bins."),
    ),
    note="Made up.",
)


def subject(frame: pd.DataFrame, name: str = "altitude-flight-2") -> Subject:
    return Subject(StoredRun(Path("run"), frame, frame, {"name": name}, ()), "altitude_error_m", 5.0)


def rows() -> pd.DataFrame:
    """40 cases at two altitudes: all answered at the lower one, half at the higher one; errors grow with altitude."""
    high = np.arange(40) >= 20
    answered = ~high | (np.arange(40) % 2 == 0)
    error = np.where(answered, 1.0 + high, np.nan)
    return pd.DataFrame({"answered": answered, "altitude_m": np.where(high, 800.0, 400.0), "altitude_error_m": error})


def test_a_declared_section_shows_its_parts_in_order() -> None:
    section = ALTITUDE(subject(rows()))
    assert section is not None
    assert [len(block.plates) for block in section.blocks] == [0, 1, 0, 1, 0, 1, 0]
    assert section.blocks[-1].note == "Made up."
    low, high = section.data["by_condition"]
    assert (low["altitude_m"], low["answered"]["hits"], low["answered"]["n"]) == (400.0, 20, 20)
    assert (high["altitude_m"], high["answered"]["hits"], high["answered"]["n"]) == (800.0, 10, 20)
    assert section.data["rates"]["answered"]["share"] == pytest.approx(0.75)
    # by hand: every error is 1 at the lower altitude and 2 at the higher one
    (effect,) = section.data["effects"]
    assert (effect["centres"], effect["medians"]) == ([400.0, 800.0], [1.0, 2.0])
    assert effect["rank_correlation"] == pytest.approx(1.0)


def test_rows_without_the_columns_have_no_such_section() -> None:
    assert ALTITUDE(subject(rows().drop(columns="altitude_error_m"))) is None
    assert ALTITUDE(subject(rows().assign(altitude_error_m=np.nan))) is None
    alone = SectionDeclaration("alone", "Alone", "Alone", [Distribution([Quantity("missing")], ("", ""), "")])
    assert alone(subject(rows())) is None


def test_a_cumulative_curve_counts_up_or_down() -> None:
    values = {"ours": np.array([1.0, 2.0, 3.0, 4.0])}
    for falling, at_two in ((False, 0.5), (True, 0.5)):
        (line,) = cumulative_figure(values, ("", ""), falling=falling).axes[0].get_lines()
        heights = dict(np.column_stack([np.asarray(line.get_xdata()), np.asarray(line.get_ydata())]).tolist())
        assert heights[2.0] == at_two
        assert heights[4.0] == (0.0 if falling else 1.0)


def test_bins_hold_every_case_with_a_value_once() -> None:
    values = np.append(np.arange(50.0), np.nan)
    bins = condition_bins(values)
    assert [int(chosen.sum()) for chosen in bins] == [10] * 5
    np.testing.assert_array_equal(np.sum(bins, axis=0), np.isfinite(values))


def test_a_papers_numbers_stand_next_to_ours(tmp_path: Path) -> None:
    path = tmp_path / "paper.toml"
    path.write_text(
        """
        [[facts]]
        campaign = "altitude-flight-2"
        title = "Second flight"
        rows = [
            { name = "altitude error (cm)", paper = "120", column = "altitude_error_m", scale = 100.0, digits = 0 },
            { name = "answered", column = "answered", statistic = "rate" },
            { name = "slope", paper = "3", column = "slope_deg" },
        ]
        """
    )
    section = PaperFacts(path)(subject(rows()))
    assert section is not None
    assert section.data == {
        "altitude error (cm)": {"paper": "120", "ours": "100 (100 to 200)"},
        "answered": {"paper": "–", "ours": "30 of 40: 75.00 %"},
        "slope": {"paper": "3", "ours": "–"},
    }
    assert PaperFacts(path)(subject(rows(), "another")) is None


@pytest.fixture
def other_system(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts a system with this report into the registry."""

    def install(report: str) -> None:
        system = System(name="altitude", title="Altitude", summary="", scenarios={}, report=report)
        monkeypatch.setattr(presentation, "systems", lambda: (system,))
        presentations.cache_clear()
        monkeypatch.setattr(presentation, "presentations", presentations)

    return install


REPORT = Presentation(sections=(ALTITUDE,))


def test_a_systems_sections_are_found_by_the_registry(
    other_system: Callable[[str], None], make_run: Callable[..., Path]
) -> None:
    other_system(f"{__name__}:REPORT")
    try:
        assert ALTITUDE in section_makers()
        page = write_report(make_run(rows().assign(case=np.arange(40), outcome="VALID"), requirements=[]))
        assert '<section id="altitude"' in page.read_text(encoding="utf-8")
    finally:
        presentations.cache_clear()


@pytest.mark.parametrize(
    ("report", "wrong"), [("nowhere.at_all:REPORT", "nowhere"), (f"{__name__}:ERROR", "is a Quantity; allowed")]
)
def test_a_report_that_is_none_is_named(other_system: Callable[[str], None], report: str, wrong: str) -> None:
    other_system(report)
    try:
        with pytest.warns(UserWarning, match=f"system 'altitude'.*{wrong}.*are left out"):
            assert presentations() == ()
    finally:
        presentations.cache_clear()
