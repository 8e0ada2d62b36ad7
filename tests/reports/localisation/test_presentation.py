"""Tests of the report on localisation: sections with rows of known statistics, and the view of a case."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.algorithms.localisation.interface import PositionOutcome
from marsyard.reports.campaign_report import write_report
from marsyard.reports.dimes.case_figures import is_dimes_case
from marsyard.reports.hda.products import is_hda_case
from marsyard.reports.localisation.presentation import (
    LOCALISATION,
    draw_errors,
    draw_landmarks,
    draw_map,
    is_localisation_case,
    light_section,
    position_section,
    view,
)
from marsyard.reports.presentation import find_case_kind, presentations, write_case_figures
from tests.reports.localisation.synthetic_localisation import (
    IMAGES,
    REFUSED,
    localisation_frame,
    refused_products,
    synthetic_products,
)
from tests.reports.synthetic_run import make_subject

REQUIREMENT = {
    "id": "LOC-FINAL", "statement": "The last position is within 40 m.", "metric": "position_error_m", "bound": 40.0,
    "probability": 0.9, "confidence": 0.9, "population": "valid",
}  # fmt: skip


@pytest.fixture
def products() -> dict[str, Any]:
    """Return products of a synthetic descent; see `synthetic_products`."""
    return synthetic_products()


def test_presentation_is_registered(products: dict[str, Any]) -> None:
    assert LOCALISATION in presentations().values()
    assert find_case_kind(products) is LOCALISATION.cases[0]
    assert not is_dimes_case(products)
    assert not is_hda_case(products)


def test_all_figures_of_a_case_are_written(products: dict[str, Any], tmp_path: Path) -> None:
    paths = write_case_figures(tmp_path, products)
    assert [path.name for path in paths] == ["errors.png", "map.png", "landmarks.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_figures_of_a_descent_without_positions_are_written(tmp_path: Path) -> None:
    assert [path.name for path in write_case_figures(tmp_path, refused_products())] == ["errors.png", "map.png"]


def test_errors_are_drawn_with_three_standard_deviations(products: dict[str, Any]) -> None:
    figure = draw_errors(products)
    for component, axes in enumerate(figure.axes):
        line = np.array(axes.lines[-1].get_data()).T
        np.testing.assert_array_equal(line, products["track"][REFUSED:, [0, 1 + component]])
        band = axes.collections[0].get_paths()[0].vertices
        assert np.abs(np.asarray(band)[:, 1]).max() == 3.0 * products["track"][REFUSED, 4 + component]
    assert len(figure.axes) == 3


def test_positions_are_drawn_on_the_map(products: dict[str, Any]) -> None:
    (axes,) = draw_map(products).axes
    lines = {line.get_label(): np.array(line.get_data()).T for line in axes.lines}
    np.testing.assert_allclose(lines["true"], products["true_xy_m"] / 1e3)
    np.testing.assert_allclose(lines["estimated"], products["estimated_xy_m"] / 1e3)
    np.testing.assert_allclose(np.ravel(lines["initial"]), products["initial_xy_m"] / 1e3)
    image = axes.get_images()[0]
    # row 0 is the southernmost
    assert image.origin == "lower"
    np.testing.assert_allclose(image.get_extent(), [-1.0, 1.0, -0.9, 1.1])
    del products["initial_xy_m"]
    assert len(draw_map(products).axes[0].lines) == 2


def test_landmarks_are_drawn_by_use(products: dict[str, Any]) -> None:
    figure = draw_landmarks(products)
    markers = {
        str(line.get_marker()): np.array(line.get_data()).T
        for line in figure.axes[0].lines
        if str(line.get_marker()) in "ox"
    }
    used = products["landmarks_used"]
    np.testing.assert_array_equal(markers["o"], products["landmarks_px"][used])
    np.testing.assert_array_equal(markers["x"], products["landmarks_px"][~used])


@pytest.mark.parametrize("used", [True, False])
def test_landmarks_of_one_kind_are_drawn(products: dict[str, Any], used: bool) -> None:
    assert draw_landmarks({**products, "landmarks_used": np.full(30, used)}) is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"landmarks_px": None},
        {"landmarks_residual_px": np.zeros((29, 2))},
        {"landmarks_used": None},
        {"landmarks_used": np.ones(3, dtype=bool)},
        {"image_2": None},
    ],
)
def test_incomplete_landmarks_are_omitted(products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert draw_landmarks({**products, **changes}) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"track": None},
        {"track": np.zeros((7, 6))},
        {"map": None},
        {"map_extent_m": np.zeros(3)},
        {"map_extent_m": np.full(4, np.nan)},
        {"outcomes": None},
        {"outcomes": ["VALID"]},
        {"outcomes": ["VALID"] * IMAGES + ["LOST"]},
        {"inliers": np.zeros(2)},
        {"true_xy_m": None},
        {"estimated_xy_m": "lost"},
    ],
)
def test_incomplete_products_are_no_localisation_case(products: dict[str, Any], changes: dict[str, Any]) -> None:
    assert is_localisation_case(products)
    assert not is_localisation_case({**products, **changes})
    name = next(iter(changes))
    assert not is_localisation_case({key: value for key, value in products.items() if key != name})


def test_table_has_a_row_per_estimate(products: dict[str, Any]) -> None:
    case_view = view(products)
    assert len(case_view.figures) == 3
    assert [row.values[0] for row in case_view.rows] == [*(f"image {k}" for k in range(1, IMAGES + 1)), "end"]
    assert [row.succeeded for row in case_view.rows] == [False] * REFUSED + [True] * (IMAGES + 1 - REFUSED)
    assert all(len(row.values) == len(case_view.head) for row in case_view.rows)
    refused, valid, final = case_view.rows[0].values, case_view.rows[REFUSED].values, case_view.rows[-1].values
    assert list(refused) == ["image 1", PositionOutcome.NO_COARSE_FIX.value, "", "", "", "", ""]
    assert valid[1:3] == [PositionOutcome.VALID.value, "80"]
    assert float(valid[3].replace("−", "-")) == pytest.approx(products["track"][REFUSED, 1], rel=0.05)
    # horizontal standard deviation: 3 m per axis, 4.24 m in total
    assert float(valid[6]) == pytest.approx(np.hypot(3.0, 3.0), rel=0.02)
    assert final[2] == ""


def test_view_of_a_refused_descent_has_one_row() -> None:
    case_view = view(refused_products())
    assert [row.succeeded for row in case_view.rows] == [False]
    assert len(case_view.figures) == 2


def test_position_section_has_rates_and_quantiles() -> None:
    frame = localisation_frame(200)
    section = position_section(make_subject(frame))
    rates = section.data["rates"]
    assert rates["Last answer within 10 s is a position"].hits == frame["fixed_in_time"].sum()
    assert rates["Coarse position within 200 m"].hits == frame["fixed_in_time"].sum()
    assert rates["A reported position is wrong by more than 40 m"].hits == 0
    headings = [block.heading for block in section.blocks]
    assert headings == ["Positions", "Position error", "Distributions"]


def test_condition_section_is_created() -> None:
    section = light_section(make_subject(localisation_frame(200)))
    bins = section.data["by_condition"]
    assert sum(entry["n"] for entry in bins) == 200
    assert [entry["fixed_in_time"].hits for entry in bins] == [entry["answered"].hits for entry in bins]


def test_algorithm_without_coarse_stage_has_no_coarse_rate() -> None:
    section = position_section(make_subject(localisation_frame(200).assign(coarse_error_m=np.nan)))
    assert section.data["rates"]["Coarse position within 200 m"].n == 0


@pytest.mark.parametrize("section", [position_section, light_section])
def test_sections_of_refusals_report_their_rate(section: Any) -> None:
    """A campaign in which no descent has a position still reports that fact."""
    created = section(make_subject(localisation_frame(30, fixed_fraction=0.0)))
    assert created.blocks


@pytest.mark.parametrize("section", [position_section, light_section])
def test_other_campaigns_have_no_section(section: Any) -> None:
    assert section(make_subject(pd.DataFrame({"case": [0, 1], "sun_difference_deg": [1.0, 2.0]}))) is None


@pytest.mark.usefixtures("plain_figures")
def test_page_and_json_have_the_sections(make_run: Callable[..., Path], products: dict[str, Any]) -> None:
    directory = make_run(localisation_frame(20), [REQUIREMENT], products=products)
    page = write_report(directory).read_text(encoding="utf-8")
    report = json.loads((directory / "report.json").read_text(encoding="utf-8"))
    assert {"localisation", "localisation-conditions", "consistency"} <= set(report["sections"])
    assert "Position on the map" in page
    assert "True and estimated positions on the map." in page
