"""Tests of the queue of confirmations: order, interruption, log, and refusal of a changed tree."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.store.confirmation_record import read_record
from marsyard.scenarios.systems import catalogue
from tests.marsyard.confirmation_project import RECORD, create_project, git, make_command
from tools import confirm_queue as queue

LIST = Path(__file__).parents[2] / "tools" / "confirmations.txt"


def test_interrupted_queue_continues_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_project(tmp_path)
    (tmp_path / "other.toml").write_text((tmp_path / "fake.toml").read_text().replace("0.75", "0.7"))
    (tmp_path / "queue.txt").write_text("# two campaigns\nfake.toml 10 1\nother.toml 11 1  # one more case\n")
    git(tmp_path, "config", "user.name", "Test")
    git(tmp_path, "config", "user.email", "test@example.org")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "list")
    marsyard, run_process, commands = make_command(monkeypatch, tmp_path), subprocess.run, []

    def run(command: list[str], **options: Any) -> Any:
        if command[1:3] != ["-m", "marsyard"]:
            return run_process(command, **options)
        commands.append(command[3:])
        if len(commands) == 2:
            raise KeyboardInterrupt
        # later commands run in this process, which is faster
        return run_process(command, **options) if len(commands) == 1 else marsyard(*command[3:])

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(KeyboardInterrupt):
        queue.main(["queue.txt", "--out", "runs", "--record", "confirmations.jsonl"])
    assert queue.main(["queue.txt", "--out", "runs", "--record", "confirmations.jsonl"]) == 0
    assert [command[:2] for command in commands] == [["run", "fake.toml"], ["run", "other.toml"], ["run", "other.toml"]]
    reports = [json.loads((tmp_path / "runs" / name / "report.json").read_text()) for name in ("fake", "other")]
    assert [(report["cases"], report["verdict"]) for report in reports] == [(10, "PASS"), (11, "PASS")]
    assert [entry.cases for entry in read_record(Path(RECORD)).confirmations] == [10, 11]
    lines = [line.split(maxsplit=2) for line in (tmp_path / "runs" / "queue.log").read_text().splitlines()]
    assert len({tree for _, tree, _ in lines}) == 1
    assert [text.split(":")[0] for *_, text in lines] == ["start", "end", "start", "start", "end"]
    # the record is committed; a campaign without its last cases is resumed
    assert queue.git("status", "--porcelain", "--untracked-files=no") == ""
    (tmp_path / "runs" / "other" / "report.json").unlink()
    assert queue.main(["queue.txt", "--out", "runs", "--record", "confirmations.jsonl"]) == 0
    assert commands[3][:2] == ["resume", "runs/other"]


def test_changed_tree_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    create_project(tmp_path)
    (tmp_path / "queue.txt").write_text("fake.toml 10 1\n")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "queue.log").write_text("2026-01-01T00:00:00+00:00 0123456789abcdef start: marsyard\n")
    assert queue.main(["queue.txt", "--out", "runs", "--record", "confirmations.jsonl"]) == 2
    assert "was begun on the tree 0123456789abcdef; this is " in capsys.readouterr().err
    (tmp_path / "estimator.py").write_text("class Estimator:\n    option = 1\n")
    assert queue.main(["queue.txt", "--out", "other", "--record", "confirmations.jsonl"]) == 2
    assert "the tree has changes (M estimator.py): commit them" in capsys.readouterr().err
    assert (tmp_path / RECORD).read_text() == ""


def test_files_that_do_not_determine_rows_are_no_part_of_the_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_project(tmp_path)
    monkeypatch.chdir(tmp_path)
    tree = queue.hash_tree(Path("confirmations.jsonl"), tmp_path / "no.log")
    for name in ("README.md", "docs/results.py", "benchmarks/results/times.json", "reports/verdict.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
        git(tmp_path, "add", name)
        assert queue.hash_tree(Path("confirmations.jsonl"), tmp_path / "no.log") == tree, name
    (tmp_path / "campaigns").mkdir()
    (tmp_path / "campaigns" / "draws.py").write_text("1")
    git(tmp_path, "add", "campaigns/draws.py")
    with pytest.raises(ValueError, match=r"the tree has changes \(A  campaigns/draws.py\)"):
        queue.hash_tree(Path("confirmations.jsonl"), tmp_path / "no.log")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fake.toml 10\n", "line 1: 'fake.toml 10'; allowed: CAMPAIGN CASES JOBS"),
        ("\nfake.toml ten 1\n", "line 2"),
        ("fake.toml 0 1\n", "numbers above 0"),
        ("a/fake.toml 10 1\nfake.toml 20 1\n", "a campaign occurs twice"),
    ],
)
def test_invalid_list_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str) -> None:
    path = tmp_path / "queue.txt"
    path.write_text(text)
    assert queue.main([str(path), "--out", str(tmp_path / "runs")]) == 2
    assert message in capsys.readouterr().err


def test_list_contains_the_whole_catalogue() -> None:
    entries = queue.read_list(LIST)
    assert sorted(entry.campaign for entry in entries) == sorted(catalogue())
