"""Tests that the tables of the page on DIMES agree with the algorithm, the campaigns and the paper."""

import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesOptions, ValidityCheck
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.dispersions import Choice
from marsyard.reports.fieldtest.presentation import FIG_11
from marsyard.reports.fits import read_register

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


def test_table_of_the_field_test_has_the_values_of_the_paper() -> None:
    (names,) = find_rows("valid answers in the paper, %")
    runs = [name.removesuffix(" \\*").replace(" ", " Run ") for name in names]
    for category in ("short time", "same direction", "opposite direction"):
        (cells,) = find_rows(category)
        assert [int(cell) for cell in cells] == [FIG_11[category, run]["percent"] for run in runs]
    assert len(FIG_11) == 3 * len(runs)


def test_calibrated_runs_are_marked() -> None:
    """Kelso's crests are calibrated, and the clouds over its run 3."""
    (names,) = find_rows("valid answers in the paper, %")
    constants = [constant.where for constant in read_register() if constant.data.key == "dimes-fieldtest"]
    sites = {match[1] for where in constants if (match := re.search(r"sites\.toml:sites\.(\w+)", where))}
    assert sites == {"kelso"}
    assert ["\\*" in name for name in names] == [name.split()[0].lower() in sites for name in names]


def test_table_of_faults_has_the_sizes_of_the_campaign() -> None:
    dispersion = load_campaign("dimes-offnominal").definition.dispersions["faults"]
    assert isinstance(dispersion, Choice)
    sizes: dict[str, list[float]] = {}
    for fault in dispersion.values:
        assert isinstance(fault, Mapping)
        for name, size in fault.items():
            sizes.setdefault(re.sub(r"_(deg|m|s)$", "", name).replace("_", " "), []).append(float(size))
    assert f"one fault of {sum(map(len, sizes.values()))} kinds and sizes" in " ".join(PAGE.split())
    rows = {name: (cells, index) for names, cells in fault_rows() for index, name in enumerate(names)}
    assert rows.keys() == sizes.keys()
    for name, (cells, index) in rows.items():
        assert [float(size) for size in cells[1].split(";")[index].split(",")] == sizes[name], name


def fault_rows() -> list[tuple[list[str], list[str]]]:
    """Return the rows of the table of faults: the names of the faults in the first cell, and the other cells."""
    lines = PAGE.partition("\n## Faults\n")[2].partition("<!-- section")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if line[:1] == "|"]
    return [(cells[0].split(", "), cells[1:]) for cells in rows[2:]]
