"""The tutorials' commands, run in order in an empty folder; most `marsyard` commands run in this process."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]

TUTORIALS = sorted((Path(__file__).parents[2] / "docs" / "tutorials").glob("*.md"))
FENCED = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SAVED_AS = re.compile(r"Save it as `([\w./-]+)`:\s*\Z")
#: What a tutorial says is there in the end.
PROMISED = {
    "first-campaign": (
        "draws.svg",
        "first/report.html",
        "first/cases.parquet",
        "first/cases.sqlite",
        "first/campaign.json",
        "first/cases/3/dimes.png",
    ),
    "measured-data": ("checked/report.html",),
    "custom-dynamics": ("powered/report.html",),
    "custom-instrument": ("lidar/report.html",),
    "custom-score": ("airbags/report.html",),
    "custom-system": ("fallen/report.html", "fallen/cases/2/altitude.png"),
}
#: Folder of the packages that a tutorial installs.
INSTALLED = "installed"
EXITS = re.compile(r"# exits with (\d)(?: or (\d))?")


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial(tutorial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = tutorial.read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    installs = "$ pip install" in text
    commands = 0
    for block in FENCED.finditer(text):
        language, body = block.groups()
        saved = SAVED_AS.search(text, 0, block.start())
        if saved is not None:
            (tmp_path / saved[1]).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / saved[1]).write_text(body, encoding="utf-8")
            continue
        assert language != "toml", "a campaign that is saved nowhere"
        if language == "python":
            _run([sys.executable, "-c", body], {0})
        elif language == "console":
            for line in body.splitlines():
                assert line.startswith("$ "), line
                commands += 1
                allowed = {int(code) for found in EXITS.findall(line) for code in found if code} or {0}
                words = shlex.split(line.removeprefix("$ ").split("#")[0])
                if words[:2] == ["pip", "install"]:
                    words[2:2] = ["--no-deps", "--no-build-isolation", "--target", INSTALLED]
                run = _invoke if words[0] == "marsyard" and not installs else _run
                run(words, allowed)
    assert commands >= 3
    for name in PROMISED.get(tutorial.stem, ()):
        assert (tmp_path / name).stat().st_size > 0


def _invoke(words: list[str], allowed: set[int]) -> None:
    ended = CliRunner().invoke(app, words[1:])
    assert ended.exit_code in allowed, f"{words}: {ended.exit_code}\n{ended.output}\n{ended.exception!r}"


def _run(words: list[str], allowed: set[int]) -> None:
    # what a tutorial installs does not go into the environment that runs the tests
    searched = os.pathsep.join((str(Path(__file__).parents[2]), str(Path(INSTALLED).resolve())))
    environment = {**os.environ, "PYTHONPATH": searched}
    command = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode in allowed, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
