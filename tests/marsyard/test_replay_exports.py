"""Tests of the options of `marsyard replay` that export a case in space and time."""

from pathlib import Path

import pytest
import trimesh

from marsyard.campaigns.store.products import load_products
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.timeline import Timeline, timeline_products
from marsyard.scenarios.timeline_recording import recording_timelines
from marsyard.sim.streams import Streams
from tests.campaigns.fake_campaign import RecordingWatch, run, write_campaign
from tests.campaigns.fake_scenario import FakeParameters, FakeScenario
from tests.command import run_command
from tests.inline_workers import inline_workers_fixture
from tests.reports.timeline.timeline_example import make_timeline

_inline_workers = inline_workers_fixture()


class ScenarioWithTimeline(FakeScenario):
    """A fake scenario whose cases have a timeline, except case 0."""

    def run(self, parameters: FakeParameters, streams: Streams) -> CaseResult:
        result = super().run(parameters, streams)
        products = {**result.products, **timeline_products(make_timeline, is_tested=streams.case > 0)}
        return CaseResult(result.outcome, result.answered, result.row, products, result.failure)


@pytest.fixture(scope="module")
def stored_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run two cases; keep all products."""
    folder = tmp_path_factory.mktemp("timeline")
    path = write_campaign(folder)
    path.write_text(
        path.read_text().replace("tests.campaigns.fake_scenario:FakeScenario", f"{__name__}:ScenarioWithTimeline")
    )
    run(path, folder / "run", RecordingWatch(), "cases=2", "retain.products=all", "retain.showcase=none", jobs=1)
    return folder / "run"


def test_only_recorded_cases_have_a_timeline() -> None:
    def fail() -> Timeline:
        raise AssertionError

    assert timeline_products(fail) == {}
    with recording_timelines():
        assert {*timeline_products(make_timeline)} == {"timeline"}
        with recording_timelines(False):
            assert timeline_products(fail) == {}
    assert timeline_products(fail) == {}


def test_replay_exports_the_case(stored_run: Path, tmp_path: Path) -> None:
    assert Timeline.from_products(load_products(stored_run / "cases" / "1")) is None
    bag, scene = tmp_path / "bag", tmp_path / "case.glb"
    status, output = run_command("replay", stored_run, 1, "--out", tmp_path / "out", "--glb", scene, "--rosbag", bag)
    assert status == 0, output
    assert f"glb: {scene}" in output
    assert f"rosbag: {bag}" in output
    assert "the row equals the stored one" in output
    assert "ground" in trimesh.load(scene, force="scene").geometry
    assert (bag / "metadata.yaml").is_file()
    assert (tmp_path / "out" / "space.png").is_file()
    stored = Timeline.from_products(load_products(tmp_path / "out"))
    assert [*stored.paths] == ["true", "estimated"]


@pytest.mark.parametrize(
    ("option", "target", "message"),
    [
        ("--rerun", "case.txt", "allowed: a file with the suffix .rrd"),
        ("--glb", "missing/case.glb", "missing does not exist"),
        ("--rosbag", ".", "exists; allowed: a new folder"),
    ],
)
def test_wrong_target_is_reported_before_the_case_runs(
    stored_run: Path, tmp_path: Path, option: str, target: str, message: str
) -> None:
    status, output = run_command("replay", stored_run, 0, "--out", tmp_path / "out", option, tmp_path / target)
    assert (status, message in " ".join(output.split())) == (2, True), output
    assert not (tmp_path / "out").exists()


def test_missing_package_is_reported(stored_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.cli.replay.find_spec", lambda _name: None)
    status, output = run_command("replay", stored_run, 0, "--rerun", tmp_path / "case.rrd")
    assert status == 2
    assert "pip install 'marsyard[view]'" in " ".join(output.split())


def test_case_without_timeline_is_reported(stored_run: Path, tmp_path: Path) -> None:
    target = tmp_path / "case.glb"
    status, output = run_command("replay", stored_run, 0, "--out", tmp_path / "out", "--glb", target)
    assert (status, "the row equals the stored one" in output) == (2, True)
    assert "--glb: case 0 has no timeline" in " ".join(output.split())
    assert not target.exists()
