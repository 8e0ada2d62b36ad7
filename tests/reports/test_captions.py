"""Tests of captions and printed numbers in reports: intervals, minimum numbers of cases and rounding."""

from __future__ import annotations

import re
from xml.etree import ElementTree as Xml

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.blocks import correlation_text, estimate_effects
from marsyard.reports.hda.sections import MAP_CONDITIONS, MAP_ERRORS, distance_grid
from marsyard.reports.overall import combine_verdicts
from marsyard.reports.sections import driver_figures
from marsyard.reports.traceability import junit_xml
from marsyard.reports.wording import NOTHING, number
from tests.reports.synthetic_run import make_rows

METRIC = "velocity_error_m_s"
DRIVERS = ("off_nadir_max_deg", "sun_elevation_deg")


def test_rank_correlations_have_intervals_and_need_enough_cases() -> None:
    few_captions = [figure.caption for figure in driver_figures(make_rows(12, answer_rate=1.0), METRIC, 5.0, DRIVERS)]
    assert few_captions
    assert not [caption for caption in few_captions if "correlation" in caption]
    captions = [figure.caption for figure in driver_figures(make_rows(60, answer_rate=1.0), METRIC, 5.0, DRIVERS)]
    pattern = r"Rank correlation −?\d\.\d{3} \(−?\d\.\d{3} to −?\d\.\d{3} at 90 % confidence\)"
    assert all(re.search(pattern, caption) for caption in captions)


@pytest.mark.parametrize(("maps", "has_interval"), [(10, False), (40, True)])
def test_rank_correlations_of_maps_have_intervals(maps: int, has_interval: bool) -> None:
    rng = np.random.default_rng(1)
    texture = rng.uniform(0.1, 1.0, maps)
    frame = pd.DataFrame({"texture": texture, "rms_fraction": rng.uniform(0.0, 0.1, maps) / texture})
    effect = estimate_effects(frame, MAP_CONDITIONS, MAP_ERRORS)[0]
    assert effect["error"].startswith("elevation error")
    assert (" to " in correlation_text(effect)) == has_interval
    assert has_interval or correlation_text(effect) == NOTHING


def test_bound_without_enough_cases_is_a_dash() -> None:
    # a lower bound of the 5 % quantile at 90 % confidence needs 45 values: 0.95^45 = 0.0994
    (row,) = distance_grid({"sites": np.array([1.0, 2.0, 3.0])}).rows
    assert row[-1] == NOTHING


def test_rounding_errors_are_printed_as_zero() -> None:
    assert number(9.09e-13) == number(-9.09e-13) == "0.000"
    assert number(2e-7) == "2.00e−07"


def test_message_on_one_crashed_case_is_singular() -> None:
    frame = make_rows(8, n_crashed=1)
    suite = Xml.fromstring(junit_xml("one", [], combine_verdicts([], frame)))  # noqa: S314
    assert [failure.get("message") for failure in suite.iter("failure")] == ["1 case crashed"]
