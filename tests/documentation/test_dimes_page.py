"""Tests that the tables of the page on DIMES agree with the algorithm and with the calibration of the field test."""

from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesOptions, ValidityCheck

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "dimes.md").read_text()


def find_rows(label: str) -> list[list[str]]:
    """Find the table rows with this label; return their other cells."""
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in PAGE.splitlines() if line[:1] == "|"]
    return [cells[1:] for cells in rows if cells[0].strip() == label]


@pytest.mark.parametrize(
    ("check", "text"),
    [
        (ValidityCheck.CONTRAST, f"contrast at least {DimesOptions().min_contrast:g}"),
        (ValidityCheck.PEAK_HEIGHT, f"peak at least {DimesOptions().min_peak:g}"),
        (ValidityCheck.PEAK_WIDTH, f"peak width at most {DimesOptions().max_peak_width_px:g} px"),
        (ValidityCheck.SECOND_PEAK, f"second peak at most {DimesOptions().max_second_peak_ratio:g} of the first"),
        (ValidityCheck.SEARCH_BORDER, "peak not on the border of the search range (`SEARCH_BORDER`"),
    ],
)
def test_table_contains_each_check_with_its_limit(check: ValidityCheck, text: str) -> None:
    ((_, published, _),) = find_rows("checks of a track")
    assert text in published, check
    assert len(ValidityCheck) == 5
    assert published.startswith("five")


def test_table_contains_threshold_and_contrast() -> None:
    ((_, threshold, _),) = find_rows("check with the inertial unit (IMU check)")
    assert threshold.startswith(f"{DimesOptions().imu_threshold_m_s:g} m/s")
    ((_, contrast, _),) = find_rows("contrast of a template")
    assert "divided by the mean signal" in contrast


@pytest.mark.parametrize("category", ["short time", "same direction", "opposite direction"])
def test_cells_of_calibrated_runs_are_marked(category: str) -> None:
    # Kelso's crests are calibrated, and the clouds over its run 3; columns: Pisgah 2 and 3, Kelso 2 and 3, Ivanpah 3
    (cells,) = find_rows(f"{category}, Marsyard")
    assert ["\\*" in cell for cell in cells] == [False, False, True, True, False]
