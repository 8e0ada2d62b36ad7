"""Tests of blocks of report sections: rates, distributions and figures of rows, and sections of a system."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.reports import presentation
from marsyard.reports.blocks import (
    Quantity,
    Rate,
    collect_values,
    condition_bins,
    condition_blocks,
    distribution_block,
    flag_rate,
    quantile_block,
    rate_block,
)
from marsyard.reports.campaign_report import section_makers, write_report
from marsyard.reports.effects import scatter_block
from marsyard.reports.papers import paper_section
from marsyard.reports.plots import cumulative_figure
from marsyard.reports.presentation import Presentation, presentations
from marsyard.reports.section import Block, Grid, Section, Subject, create_section, has_values
from marsyard.scenarios.systems import System
from tests.reports.synthetic_run import make_subject

ERROR = Quantity("altitude_error_m")
ANSWERED = Rate("answered", "Answered", flag_rate("answered"))


def altitude_section(subject: Subject) -> Section | None:
    """Create a section with rates, a distribution, rates by condition and a scatter plot."""
    frame = subject.frame
    if not has_values(frame, "altitude_error_m"):
        return None
    curves = collect_values(frame, [ERROR])
    labels, caption = ("altitude error (m)", "fraction of cases"), "Fraction of cases up to each error."
    return create_section(
        "altitude",
        "Altitude",
        "Altitude from two images",
        rate_block({"answered": ANSWERED.compute(frame)}),
        distribution_block("errors", curves, labels, caption, bound=5.0),
        *condition_blocks(frame, "answers", Quantity("altitude_m"), [ANSWERED]),
        scatter_block(frame, "scatter", [Quantity("altitude_m")], [ERROR], "Every case, and medians of bins."),
        Block(note="Synthetic data."),
    )


def make_rows_of_two_altitudes() -> pd.DataFrame:
    """Return 40 cases at two altitudes: all answered at 400 m with error 1 m, half answered at 800 m with error 2 m."""
    is_high = np.arange(40) >= 20
    is_answered = ~is_high | (np.arange(40) % 2 == 0)
    error = np.where(is_answered, 1.0 + is_high, np.nan)
    return pd.DataFrame(
        {"answered": is_answered, "altitude_m": np.where(is_high, 800.0, 400.0), "altitude_error_m": error}
    )


def test_section_contains_its_blocks_and_their_data_in_order() -> None:
    section = altitude_section(make_subject(make_rows_of_two_altitudes()))
    # rates, distribution, rates by condition (figure, table), scatter plot, note
    assert [len(block.figures) for block in section.blocks] == [0, 1, 1, 0, 1, 0]
    assert section.blocks[-1].note == "Synthetic data."
    low, high = section.data["by_condition"]
    assert (low["altitude_m"], low["answered"].hits, low["answered"].n) == (400.0, 20, 20)
    assert (high["altitude_m"], high["answered"].hits, high["answered"].n) == (800.0, 10, 20)
    assert section.data["rates"]["answered"].fraction == pytest.approx(0.75)
    # medians of the errors: 1 m at 400 m, 2 m at 800 m
    (effect,) = section.data["effects"]
    assert (effect["centres"], effect["medians"]) == ([400.0, 800.0], [1.0, 2.0])
    assert effect["rank_correlation"] == pytest.approx(1.0)


def test_missing_columns_give_no_section() -> None:
    assert altitude_section(make_subject(make_rows_of_two_altitudes().drop(columns="altitude_error_m"))) is None
    assert altitude_section(make_subject(make_rows_of_two_altitudes().assign(altitude_error_m=np.nan))) is None
    frame = make_rows_of_two_altitudes()
    missing = [Quantity("missing")]
    blocks = [distribution_block("errors", collect_values(frame, missing), ("", ""), "")]
    blocks += [quantile_block(frame, missing, {"Median": 0.5}), scatter_block(frame, "errors", missing, [ERROR], "")]
    assert create_section("errors", "Errors", "Errors", *blocks, rate_block({})) is None


def test_cumulative_curve_rises_and_complementary_curve_falls() -> None:
    values = {"ours": np.array([1.0, 2.0, 3.0, 4.0])}
    for complementary in (False, True):
        (line,) = cumulative_figure(values, ("", ""), complementary=complementary).axes[0].get_lines()
        heights = dict(np.column_stack([np.asarray(line.get_xdata()), np.asarray(line.get_ydata())]).tolist())
        assert heights[2.0] == 0.5
        assert heights[4.0] == (0.0 if complementary else 1.0)


def test_bins_contain_each_finite_value_once() -> None:
    values = np.append(np.arange(50.0), np.nan)
    bins = condition_bins(values)
    assert [int(is_in_bin.sum()) for is_in_bin in bins] == [10] * 5
    np.testing.assert_array_equal(np.sum(bins, axis=0), np.isfinite(values))


def test_paper_values_are_compared_with_results(tmp_path: Path) -> None:
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
    section = paper_section(make_subject(make_rows_of_two_altitudes(), name="altitude-flight-2"), path)
    assert section.data == {
        "altitude error (cm)": {"paper": "120", "ours": "100 (100 to 200)"},
        "answered": {"paper": "–", "ours": "30 of 40: 75.00 %"},
        "slope": {"paper": "3", "ours": "–"},
    }
    assert paper_section(make_subject(make_rows_of_two_altitudes(), name="another"), path) is None


@pytest.fixture
def register_altitude_system(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function that registers a system with the given report."""

    def register(report: str) -> None:
        system = System(name="altitude", title="Altitude", summary="", scenarios={}, report=report)
        monkeypatch.setattr(presentation, "systems", lambda: (system,))
        presentations.cache_clear()
        monkeypatch.setattr(presentation, "presentations", presentations)

    return register


REPORT = Presentation(sections=(altitude_section,))


@pytest.mark.usefixtures("plain_figures")
def test_sections_of_a_registered_system_are_written(
    register_altitude_system: Callable[[str], None], make_run: Callable[..., Path]
) -> None:
    register_altitude_system(f"{__name__}:REPORT")
    try:
        assert altitude_section in section_makers()
        page = write_report(
            make_run(make_rows_of_two_altitudes().assign(case=np.arange(40), outcome="VALID"), requirements=[])
        )
        assert '<section id="altitude"' in page.read_text(encoding="utf-8")
    finally:
        presentations.cache_clear()


@pytest.mark.parametrize(
    ("report", "message"), [("nowhere.at_all:REPORT", "nowhere"), (f"{__name__}:ERROR", "is a Quantity; allowed")]
)
def test_invalid_report_of_a_system_gives_a_warning(
    register_altitude_system: Callable[[str], None], report: str, message: str
) -> None:
    register_altitude_system(report)
    try:
        with pytest.warns(UserWarning, match=f"system 'altitude'.*{message}.*are omitted"):
            assert presentations() == {}
    finally:
        presentations.cache_clear()


def test_table_with_an_additional_cell_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"row \['a', 'b', 'c'\] has 3 cells; allowed: 2"):
        Grid(["x", "y"], [["1", "2"], ["a", "b", "c"]])
