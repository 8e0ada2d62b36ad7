"""Tests of the report section on recorded images: match residuals, and figures with complete and missing data."""

from pathlib import Path

import numpy as np
import pandas as pd

from marsyard.reports.measured.presentation import MEASURED, agreement_section, read_matched_pairs
from marsyard.reports.presentation import find_case_kind, write_case_figures
from marsyard.reports.section import Section
from tests.reports.synthetic_run import make_subject


def make_section(**columns: object) -> Section | None:
    """Return the section on four cases with these columns."""
    return agreement_section(make_subject(pd.DataFrame({"case": range(4), "outcome": ["VALID"] * 4, **columns})))


def make_products(matches: int) -> dict[str, object]:
    """Return two images and a table of matches; a quarter of the matches are outliers.

    Columns: u and v in both images, residual in u and v (px), 1 for inliers.
    """
    rng = np.random.default_rng(1)
    table = np.concatenate(
        [rng.uniform(0, 60, (matches, 4)), rng.normal(0, 0.5, (matches, 2)), np.ones((matches, 1))], 1
    )
    table[: matches // 4, 6] = 0.0
    images = {f"image_{number}": rng.integers(0, 4095, (48, 64)).astype(np.uint16) for number in (1, 2)}
    return {**images, "matches_1": table}


def test_section_reports_residuals_and_unmatched_cases() -> None:
    residuals = [0.4, np.nan, 0.6, 1.5]
    section = make_section(
        measured_case=["a", "b", "c", "d"],
        residual_median_px=residuals,
        residual_90_percent_px=[1.0, np.nan, 1.2, 3.0],
        matches=[120, 3, 90, 80],
        **{"mine.difference_m_s": [0.1, np.nan, 0.3, 0.2]},
    )
    assert (section.data["cases"], section.data["unmatched"]) == (4, 1)
    assert section.data["median_of_medians_px"] == 0.6
    assert section.data["differences"] == {"mine.difference_m_s": 0.2}
    (block,) = section.blocks
    assert list(block.grid.rows[0][:4]) == ["0", "a", "VALID", "120"]
    assert block.grid.rows[1][4] == "–"
    assert len(block.figures) == 1


def test_infinite_residuals_are_not_missing_ones() -> None:
    """The poses of case b place the matches outside of the view of the later camera."""
    section = make_section(
        measured_case=list("abcd"), residual_median_px=[0.4, np.inf, 0.6, np.inf], matches=[120, 110, 9, 80]
    )
    (block,) = section.blocks
    assert [row[4] for row in block.grid.rows] == ["0.400", "out of view", "0.600", "out of view"]
    assert (section.data["unmatched"], section.data["out_of_view"]) == (0, 2)
    assert section.data["median_of_medians_px"] is None


def test_no_section_without_recorded_cases() -> None:
    assert make_section(residual_median_px=[1.0] * 4) is None


def test_case_without_matches_is_shown(tmp_path: Path) -> None:
    view = MEASURED.cases[0].view(make_products(0), False)
    assert view.rows[0].succeeded is False
    assert "0 matches" in view.figures[0].caption
    (path,) = write_case_figures(tmp_path, make_products(40))
    assert path.stat().st_size > 5000


def test_invalid_matches_and_images_give_no_pairs() -> None:
    products = make_products(40)
    (pair,) = read_matched_pairs(products)
    assert np.count_nonzero(pair.inlier) == 30
    assert pair.caption.startswith("Images 1 and 2: 30 matches, median residual ")
    assert read_matched_pairs({**products, "matches_1": np.zeros((4, 3))}) == []
    assert read_matched_pairs({**products, "image_2": None}) == []
    # recorded cases are recognised before the other systems
    assert find_case_kind(products) is MEASURED.cases[0]
