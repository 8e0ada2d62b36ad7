"""Tests of the negative controls: each fails a requirement on small campaigns."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from benchmarks.validation.controls import RUNS, TITLES, ControlRun, measure_campaign
from benchmarks.validation.document import RESULTS
from marsyard.api import run_campaign
from marsyard.campaigns.definition.loading import find_campaign, load_campaign
from marsyard.reports.evaluation import evaluate_run
from marsyard.scenarios.systems import catalogue

#: Small campaigns, by system: cases and changes of the campaign file.
SMALL: Mapping[str, ControlRun] = {
    "dimes-smoke": ControlRun((0, 1), ("terrain.samples=512",)),
    "hda-hazardous": ControlRun((0, 1, 2, 3)),
    "vtt-checkout-2": ControlRun((0,), ("world.samples=512", "start.distance_m=3.0", "target.diameter_m=0.5")),
    "loc-smoke": ControlRun(
        (0,), ("terrain.samples=1024", "map.side_px=512", "camera.pixels=256", "camera.pixel_mrad=6.68")
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SMALL))
def test_each_control_fails_a_requirement(name: str) -> None:
    measure = measure_campaign(name, SMALL[name])
    assert measure.passed, measure.how
    assert len(measure.how.split(" | ")) == len(TITLES)


@pytest.mark.slow
def test_control_that_meets_all_requirements_is_reported(tmp_path: Path) -> None:
    """On gentle ground any site is safe: with HDA-FIND alone, estimators that use no image meet every requirement."""
    text, _, _ = find_campaign("hda-benign").read_text().partition("[[requirements]]")
    path = tmp_path / "benign.toml"
    path.write_text(f'{text}[[requirements]]\nid = "HDA-FIND"\n')
    measure = measure_campaign(str(path), ControlRun((0, 1), ("terrain.samples=512",)))
    cells = dict(zip(TITLES.values(), measure.how.split(" | "), strict=True))
    assert not measure.passed
    assert (cells["no image"], cells["constant"], cells["refusal"]) == ("**none**", "**none**", "HDA-FIND")


def test_table_of_the_page_contains_the_whole_catalogue_without_an_empty_cell() -> None:
    measures = json.loads(RESULTS.read_text())["checks"]["controls"]["measures"]
    assert [row["claim"].split("`")[1] for row in measures] == list(catalogue())
    for row in measures:
        assert row["measured"] == 0.0
        assert "**none**" not in row["how"]
    assert set(RUNS) <= set(catalogue())


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SMALL))
def test_hanging_algorithm_never_passes(tmp_path: Path, name: str) -> None:
    overrides = ("limits.case_time_s=30", *SMALL[name].overrides)
    campaign = load_campaign(name, overrides, cases=1, algorithms=["marsyard.algorithms.controls:Hang"])
    evaluation = evaluate_run(run_campaign(campaign, tmp_path / "run"))
    assert list(evaluation.run.all_cases["outcome"]) == ["TIMED_OUT"]
    assert evaluation.exit_code == 1
    assert not [verdict for verdict in evaluation.verdicts if verdict.status in ("PASS", "MET BY RATE")]
