"""Tests of the report on images over a map: medians of images with a pose, and figures with and without a pose."""

from pathlib import Path

import numpy as np
import pandas as pd

from marsyard.reports.measured.over_map import map_section
from marsyard.reports.presentation import find_case_kind, write_case_figures
from marsyard.reports.section import Section
from tests.reports.synthetic_run import make_subject


def make_section(columns: dict[str, object]) -> Section | None:
    """Return the section on four images, of which the third has no pose."""
    return map_section(make_subject(pd.DataFrame({"case": range(4), "measured_case": list("abcd"), **columns})))


def test_section_has_medians_of_images_with_a_pose() -> None:
    nan = np.nan
    section = make_section(
        {
            "registration_inliers": [40, 60, 0, 80],
            "height_m": [4000.0, 3000.0, nan, 2000.0],
            "template_yield": [0.9, 0.8, nan, 1.0],
            "rendered.registration_inliers": [90, 0, nan, 70],
            "rendered.height_m": [4010.0, nan, nan, 2010.0],
            "rendered.template_yield": [0.5, nan, nan, 0.7],
            "rendered.pose_error_px": [0.2, nan, nan, 0.4],
        }
    )
    counts = [section.data[name] for name in ("images", "recorded_with_pose", "rendered", "rendered_with_pose")]
    assert counts == [4, 3, 3, 2]
    medians = section.data["medians"]
    assert medians["registration_inliers"] == [60.0, 80.0]
    assert medians["template_yield"] == [0.9, 0.6]
    assert medians["orb_yield"] == [None, None]
    (block,) = section.blocks
    rows = {row[0]: list(row[1:]) for row in block.grid.rows}
    assert rows["images with a pose"] == ["3", "2"]
    assert rows["template yield"] == ["0.900 (0.800 to 1.000)", "0.600 (0.500 to 0.700)"]
    assert rows["orb yield"] == ["–", "–"]
    assert len(block.figures) == 1


def test_other_recorded_images_have_no_section() -> None:
    assert make_section({"residual_median_px": [1.0] * 4}) is None


def test_figure_shows_image_and_map(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (64, 64)).astype(np.uint16)
    products = {"recorded_image": image}
    kind = find_case_kind(products)
    assert "landmarks" in kind.legend
    bare, complete = tmp_path / "bare", tmp_path / "complete"
    for folder in (bare, complete):
        folder.mkdir()
    (path,) = write_case_figures(bare, products)
    landmarks = np.column_stack([rng.uniform(0, 63, (30, 4)), np.ones(30)])
    both = {
        f"{name}_{part}": value
        for name in ("recorded", "rendered")
        for part, value in (("image", image), ("map", rng.random((80, 80))), ("landmarks", landmarks))
    }
    (other,) = write_case_figures(complete, both)
    assert path.name == other.name == "landmarks.png"
    # two rows of panels instead of one
    assert other.stat().st_size > 1.5 * path.stat().st_size
