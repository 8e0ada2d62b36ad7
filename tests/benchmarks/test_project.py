"""Tests of the times of a newcomer's commands."""

import subprocess
from pathlib import Path

import pytest

from benchmarks import project
from tests.marsyard.confirmation_project import git


def test_tasks_run_in_a_new_clone_with_an_empty_cache(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text(
        'demo:\n\t@test -n "$$MARSYARD_CACHE" -a ! -e "$$MARSYARD_CACHE" && mkdir "$$MARSYARD_CACHE" && sleep 0.2\n'
        "test:\n\t@test -d $$MARSYARD_CACHE -a ! -e uncommitted\n"
    )
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "state")
    (tmp_path / "uncommitted").touch()
    demo, test, both = project.measure(tmp_path)
    assert 0.2 <= demo.median < 20.0
    assert both.median == pytest.approx((demo.median + test.median) / 60.0)
    assert [row.limit_text for row in (demo, test, both)] == ["<= 90", "<= 300", "<= 12"]


def test_failing_task_stops_the_measurement(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text("demo:\n\t@echo the demo failed; exit 1\n")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "state")
    with pytest.raises(RuntimeError, match=r"make demo ended with 2: the demo failed"):
        project.measure(tmp_path)
