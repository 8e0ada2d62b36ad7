"""The tutorials' commands, run literally, one after the other, in an empty folder."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

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
def test_tutorial(tutorial: Path, tmp_path: Path) -> None:
    text = tutorial.read_text(encoding="utf-8")
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
            _run([sys.executable, "-c", body], {0}, tmp_path)
        elif language == "console":
            for line in body.splitlines():
                assert line.startswith("$ "), line
                commands += 1
                allowed = {int(code) for found in EXITS.findall(line) for code in found if code} or {0}
                words = shlex.split(line.removeprefix("$ ").split("#")[0])
                if words[:2] == ["pip", "install"]:
                    words[2:2] = ["--no-deps", "--no-build-isolation", "--target", INSTALLED]
                _run([str(Path(sys.executable).with_name(words[0])), *words[1:]], allowed, tmp_path)
    assert commands >= 3
    for name in PROMISED.get(tutorial.stem, ()):
        assert (tmp_path / name).stat().st_size > 0


def _run(command: list[str], allowed: set[int], folder: Path) -> None:
    # what a tutorial installs does not go into the environment that runs the tests
    searched = os.pathsep.join((str(Path(__file__).parents[2]), str(folder / INSTALLED)))
    environment = {**os.environ, "PYTHONPATH": searched}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode in allowed, f"{command}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
