"""Tests of the view of images with marks."""

import base64
import io
import re

import cv2
import numpy as np
import pytest
from matplotlib.text import Annotation

from marsyard.reports.figure_style import RASTER_DPI, svg_markup
from marsyard.reports.images import Mark, Panel, box, draw_images, draw_panels, square
from tests.reports.drawn_marks import find_boxes

RED = "#ff0000"


def test_panel_extends_over_its_cells() -> None:
    wide, narrow, text = Panel(np.ones((8, 8)), "wide"), Panel(np.ones((4, 4)), "narrow"), Panel(text="nothing")
    figure = draw_panels([[wide, wide], [narrow, text]], (4.0, 4.0), [3.0, 1.0])
    figure.draw_without_rendering()
    upper, left, right = (axes.get_subplotspec() for axes in figure.axes)
    assert (upper.rowspan, upper.colspan) == (range(1), range(2))
    assert upper.get_gridspec().get_height_ratios() == [3.0, 1.0]
    assert [spec is not None and spec.colspan.start for spec in (left, right)] == [0, 1]
    assert not figure.axes[2].axison
    assert [item.get_text() for item in figure.axes[2].texts] == ["nothing"]


def test_marks_are_drawn_at_their_pixels() -> None:
    points, lines = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[[0.0, 0.0]], [[5.0, 6.0]], [[7.0, 0.0]]])
    style = {"color": RED, "marker": "o", "linestyle": ""}
    line_style = {"color": RED}
    marks = [Mark(points, style, "label"), Mark(lines, line_style), box(np.zeros(2), np.full(2, 2.0), line_style)]
    marks += square(np.full(2, 4.0), 3.0, line_style)
    (axes,) = draw_panels([[Panel(np.zeros((8, 8)), "title", marks)]], (2.0, 2.0)).axes
    np.testing.assert_array_equal(np.column_stack(axes.lines[0].get_data()), points)
    np.testing.assert_array_equal(np.column_stack(axes.lines[1].get_data()), lines[:, 0])
    assert [(*item.corner, *item.size) for item in find_boxes(axes, RED)] == [(0, 0, 2, 2), (2.5, 2.5, 3, 3)]
    # the label is at the centre of the upper end of its mark
    labels = [(item.get_text(), item.xy) for item in axes.texts if isinstance(item, Annotation)]
    assert labels == [("label", (2.0, 2.0))]
    assert square(np.array([np.nan, 1.0]), 3.0, {}) == []


@pytest.mark.parametrize(("side", "interpolation"), [(512, "none"), (513, "antialiased")])
def test_images_are_stretched_between_quantiles(side: int, interpolation: str) -> None:
    values = np.linspace(0.0, 100.0, side * side).reshape(side, side)
    values[0, 0] = np.nan
    (axes,) = draw_images([values]).axes
    (image,) = axes.get_images()
    grey = np.asarray(image.get_array())[..., 0]
    assert (grey[0, 0], grey[-1, -1]) == (0, 255)
    # 1 % of the values are black and 1 % white
    np.testing.assert_allclose([(grey == 0).mean(), (grey == 255).mean()], 0.012, atol=0.004)
    assert image.get_interpolation() == interpolation


@pytest.mark.parametrize("is_large", [True, False])
def test_large_images_of_pages_are_compressed(is_large: bool) -> None:
    rng = np.random.default_rng(3)
    levels = np.linspace(0.0, 200.0, 512) + rng.normal(0.0, 8.0, (512, 512))
    side = 512 if is_large else 64
    figure = draw_panels([[Panel(levels[:side, :side])]], (3.2, 3.2))
    markup = svg_markup(figure, "key", "image")
    ((kind, text),) = re.findall(r"data:image/(\w+);base64,([\w+/=\s]+)", markup)
    assert kind == ("webp" if is_large else "png")
    data = base64.b64decode(text)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=RASTER_DPI)
    if is_large:
        assert len(data) < 0.4 * len(buffer.getvalue())
        # compression smooths the noise of 8 of 200 levels, and moves no level
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).astype(np.float64)
        columns = image[20:-20].mean(axis=0)
        expected = np.interp(np.linspace(0.0, 1.0, columns.size), np.linspace(0.0, 1.0, 512), levels.mean(axis=0))
        assert np.corrcoef(columns[20:-20], expected[20:-20])[0, 1] > 0.999
