"""Tests of shards: their rows equal those of one run, and incompatible or incomplete shards are not merged."""

import itertools
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import finish_campaign, resume_campaign, run_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.running.shards import Shard, merge_shards
from marsyard.campaigns.store import record
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store
from tests.campaigns.fake_campaign import CampaignFile, RecordingWatch, read_case_rows, run, write_campaign
from tests.command import run_command
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()


def _run_shards(path: Path, folder: Path, count: int, overrides: Sequence[str] = ()) -> list[Path]:
    directories = []
    for number in range(1, count + 1):
        directory = folder / f"shard-{number}"
        campaign = load_campaign(str(path), overrides)
        run_campaign(campaign, directory, ExecutorConfig(1), RecordingWatch(), Shard(number, count))
        directories.append(directory)
    return directories


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign with a case that raises, and one without an answer. Tests must not change the folder."""
    folder = tmp_path_factory.mktemp("whole")
    path = write_campaign(folder, "raising_cases = [3]\nunanswered_cases = [2]")
    return run(path, folder / "run", RecordingWatch())


@pytest.fixture(scope="module")
def shards(whole_run: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Run the same campaign in four shards. Tests must not change the folders."""
    return _run_shards(whole_run.parent / "fake.toml", tmp_path_factory.mktemp("shards"), 4)


@pytest.mark.parametrize(("total", "count"), [(12, 4), (10, 3), (3, 5), (1000, 7)])
def test_shards_contain_each_case_once(total: int, count: int) -> None:
    ranges = [Shard(number, count).cases(total) for number in range(1, count + 1)]
    assert [case for cases in ranges for case in cases] == list(range(total))
    assert max(map(len, ranges)) - min(map(len, ranges)) <= 1


def test_shards_equal_one_run(shards: list[Path], whole_run: Path, tmp_path: Path, watch: RecordingWatch) -> None:
    target = tmp_path / "merged"
    merge_shards(shards[::-1], target)
    finish_campaign(target, ExecutorConfig(1), watch)
    expected, rows = read_case_rows(whole_run), read_case_rows(target)
    assert [row["case"] for row in rows] == list(range(12))
    assert [differing_columns(*pair) for pair in zip(rows, expected, strict=True)] == [()] * 12
    merged, single = record.read(target), record.read(whole_run)
    for key in ("state", "cases", "cases_finished", "cases_crashed", "seed", "definition", "showcase", "evidence"):
        assert merged[key] == single[key], key
    assert "shard" not in merged
    assert len(merged["sessions"]) == 4
    # products of the shards' violations, and of the showcase
    stored = {path.name for path in (target / "cases").iterdir()}
    assert stored == {path.name for path in (whole_run / "cases").iterdir()}


def test_stopped_shard_is_resumed_within_its_cases(shards: list[Path], tmp_path: Path, watch: RecordingWatch) -> None:
    copy = tmp_path / "shard"
    shutil.copytree(shards[1], copy)
    with RowStore(copy / ROWS_FILE) as store:
        rows, about = [store.row(case) for case in (3, 5)], store.about
    create_store(copy / ROWS_FILE, about)
    with RowStore(copy / ROWS_FILE) as store:
        store.add(row for row in rows if row is not None)
    record.update(copy, {"state": "interrupted"})
    with pytest.raises(CampaignError, match="is not finished"):
        merge_shards([copy], tmp_path / "merged")
    resume_campaign(copy, ExecutorConfig(1), watch)
    with RowStore(copy / ROWS_FILE) as store:
        assert store.list_missing_cases(12) == [range(3), range(6, 12)]
    assert record.read(copy)["state"] == "shard"


def test_incomplete_or_different_shards_are_rejected(
    shards: list[Path], whole_run: Path, campaign_file: CampaignFile, tmp_path: Path
) -> None:
    (other,) = _run_shards(campaign_file("unanswered_cases = [2]"), tmp_path, 1)
    for directories, message in (
        (shards[:3], "3 of 12 cases are missing, the first is case 9"),
        ([*shards, shards[0]], "both contain case 0"),
        ([shards[0], whole_run], "was run without --shard"),
        ([*shards[:3], other], "differ in the definition"),
    ):
        with pytest.raises(CampaignError, match=message):
            merge_shards(directories, tmp_path / "merged")
        assert not (tmp_path / "merged").exists()


def test_changed_shard_is_rejected(shards: list[Path], tmp_path: Path) -> None:
    copies = [shutil.copytree(shard, tmp_path / shard.name) for shard in shards]
    with RowStore(copies[2] / ROWS_FILE) as store:
        store._connection.execute("UPDATE cases SET outcome = 'CRASHED' WHERE case_number = 7")
    with pytest.raises(CampaignError, match=r"shard-3/cases\.sqlite: the row of case 7 was changed"):
        merge_shards(copies, tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_rows_of_another_campaign_are_rejected(shards: list[Path], campaign_file: CampaignFile, tmp_path: Path) -> None:
    (other,) = _run_shards(campaign_file("unanswered_cases = [2]"), tmp_path, 1)
    shutil.copy(shards[0] / "campaign.json", other / "campaign.json")
    with pytest.raises(CampaignError, match="the definition is not the one with which the rows were stored"):
        merge_shards([other, *shards[1:]], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_changes_of_all_shards_are_merged_on_request(shards: list[Path], tmp_path: Path) -> None:
    copies = [shutil.copytree(shard, tmp_path / shard.name) for shard in shards]
    changes = [{"utc": "", "cases_before": 1, "in": [f"code ({number}, now 9)"]} for number in (1, 2)]
    record.update(copies[1], {"changes": changes[:1]})
    record.update(copies[3], {"changes": changes[1:]})
    with pytest.raises(CampaignError, match=r"shard-2 was continued with another program .*--allow-changed"):
        merge_shards(copies, tmp_path / "merged")
    assert not (tmp_path / "merged").exists()
    merge_shards(copies, tmp_path / "merged", allow_changed=True)
    assert record.read(tmp_path / "merged")["changes"] == changes


#: Events of Python's audit hook that write.
WRITING_EVENTS = ("open", "os.rename", "os.mkdir", "os.rmdir", "os.remove", "sqlite3.connect", "shutil.copyfile")


def merge_until_killed(shards: Sequence[Path], target: Path, step: int) -> bool:
    """Merge shards in a process that ends, as if it was killed, before a step of writing; return whether it ended."""
    child = os.fork()
    if child == 0:
        steps = itertools.count()

        def end_at_step(event: str, arguments: tuple[object, ...]) -> None:
            is_step = event in WRITING_EVENTS and str(target.parent) in " ".join(map(str, arguments))
            if is_step and next(steps) == step:
                os._exit(9)

        sys.addaudithook(end_at_step)
        merge_shards(shards, target)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def test_killed_merge_is_repeated(shards: list[Path], tmp_path: Path) -> None:
    """A merge is killed before each of its steps of writing; the next merge then succeeds."""
    folder, step = tmp_path / "merged", 0
    folder.mkdir()
    target = folder / "all"
    while merge_until_killed(shards, target, step):
        assert not target.exists() or record.read(target)["state"] == "interrupted", step
        if not target.exists():
            merge_shards(shards, target)
        with RowStore(target / ROWS_FILE, thorough=True) as store:
            store.verify()
            assert store.count() == 12
        assert sorted(path.name for path in folder.iterdir()) == ["all"], step
        products = {path.name for shard in shards for path in shard.glob("cases/*")}
        assert {path.name for path in (target / "cases").iterdir()} == products
        shutil.rmtree(target)
        step += 1
    # each writes at least once: folder, store, products, record, final name
    assert step >= 5
    assert record.read(target)["state"] == "interrupted"


def test_merge_into_a_used_folder_is_rejected(shards: list[Path], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    (tmp_path / "empty").mkdir()
    for target in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(CampaignError, match="exists and is not an empty folder"):
            merge_shards(shards, target)
    merge_shards(shards, tmp_path / "empty")
    assert record.read(tmp_path / "empty")["cases"] == 12


@pytest.mark.parametrize("text", ["0/4", "5/4", "2", "a/b", "1/0"])
def test_invalid_shards_are_reported(text: str) -> None:
    with pytest.raises(CampaignError, match="expected NUMBER/COUNT"):
        Shard.parse(text)


def test_commands_merge_shards(campaign_file: CampaignFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = campaign_file("unanswered_cases = [2]")
    status, output = run_command("run", path, "--shard", "1/1", "--jobs", 1, "--out", "a")
    assert (status, "marsyard merge" in output) == (0, True), output
    assert run_command("merge", "a", "--out", "all", "--jobs", 1)[0] in (1, 3)
    assert (tmp_path / "all" / "report.html").is_file()
    assert run_command("run", path, "--shard", "1/2", "--confirm", "--out", "b")[0] == 2
