"""Tests of the report section on the field test: results are compared with the paper, errors shown by category."""

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.campaign_report import write_report
from marsyard.reports.fieldtest.presentation import field_cells, field_test_section
from marsyard.reports.section import Subject
from marsyard.reports.stored import read_run
from tests.reports.synthetic_run import MakeRun, make_rows

VELOCITY = {"id": "V", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.99, "confidence": 0.9}


@pytest.fixture
def field_frame() -> pd.DataFrame:
    """Return 20 image triples in each of three cells (category and run), with 20, 10 and 0 answers.

    The paper has values of two of the cells.
    """
    frame = make_rows(60, answer_rate=1.0)
    frame["category"] = ["short time"] * 20 + ["same direction"] * 20 + ["opposite direction"] * 20
    frame["run"] = ["Kelso Run 3"] * 40 + ["Mojave Run 9"] * 20
    is_unanswered = np.arange(60) >= 30
    frame.loc[is_unanswered, "answered"] = False
    frame.loc[is_unanswered, [name for name in frame if str(name).startswith("velocity_error")]] = np.nan
    return frame


def test_cells_are_compared_with_the_paper(make_run: MakeRun, field_frame: pd.DataFrame) -> None:
    run = read_run(make_run(field_frame, requirements=[VELOCITY]))
    short_time, same_direction, opposite_direction = field_cells(Subject(run, "velocity_error_m_s", 5.0))
    assert (short_time.valid.hits, short_time.paper_percent) == (20, 100)
    assert short_time.difference_points == pytest.approx(0.0)
    assert (same_direction.valid.hits, same_direction.paper_percent) == (10, 40)
    assert same_direction.difference_points == pytest.approx(10.0)
    assert opposite_direction.paper_percent is None
    assert np.isnan(opposite_direction.difference_points)
    assert np.isnan(opposite_direction.largest)  # largest error


@pytest.mark.slow
def test_page_reports_misprints_and_categories(make_run: MakeRun, field_frame: pd.DataFrame) -> None:
    directory = make_run(field_frame, requirements=[VELOCITY])
    page = write_report(directory).read_text(encoding="utf-8")
    assert "1,913" in page
    assert "1,925" in page
    assert "Pisgah Run 3, short time (128 + 8 ≠ 134)" in page
    section = field_test_section(Subject(read_run(directory), "velocity_error_m_s", 5.0))
    assert len(section.blocks[1].figures) == 2  # the third category has no answers
    # the comparison is with data to which constants were fitted
    assert "Fit, not validation: fitted to these data are crest_length, regularity, cover" in section.blocks[0].note


def test_other_campaigns_have_no_field_test_section(make_run: MakeRun) -> None:
    run = read_run(make_run(make_rows(30), requirements=[VELOCITY]))
    assert field_test_section(Subject(run, "velocity_error_m_s", 5.0)) is None
